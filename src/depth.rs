//! Depth in its units: sigmoid disparity, inverse depth, depth, each a type of its own, so that none is taken for another.

/// Sigmoid disparity of every pixel, in (0, 1), row-major: what the network says.
#[derive(Clone, Debug, PartialEq)]
pub struct Disparity {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// `height * width` disparities.
    pub values: Vec<f32>,
}

/// What sigmoid disparity means: inverse depth is `a + b disparity` with `[a, b] = [1/max, 1/min - 1/max]`, so that
/// disparity 0 is the greatest depth and 1 the least (Monodepth2, section 3.2).
pub fn inverse_depth_of_disparity(min_depth: f64, max_depth: f64) -> [f64; 2] {
    [1.0 / max_depth, 1.0 / min_depth - 1.0 / max_depth]
}

/// Where the centre of pixel `i` of `to` lies among `from` pixels, in pixels from the centre of the first, and at least
/// 0: `(i + 1/2) from/to - 1/2`, as centres are at halves.
pub fn half_pixel(i: usize, from: usize, to: usize) -> f64 {
    ((i as f64 + 0.5) * from as f64 / to as f64 - 0.5).max(0.0)
}

impl Disparity {
    /// Inverse depth up to scale, for the depths that disparity 1 and 0 stand for: see [`inverse_depth_of_disparity`].
    pub fn inverse_depth(&self, min_depth: f64, max_depth: f64) -> InverseDepth {
        let [a, b] = inverse_depth_of_disparity(min_depth, max_depth).map(|x| x as f32);
        let values = self.values.iter().map(|d| d.mul_add(b, a)).collect();
        InverseDepth { width: self.width, height: self.height, values, unit: Unit::Relative }
    }
}

/// The unit of depth.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unit {
    /// None: all depths of a picture share one unknown factor.
    Relative,
    /// Metres.
    Metres,
}

/// Inverse depth of every pixel, row-major: 1 over [`Unit`].
#[derive(Clone, Debug, PartialEq)]
pub struct InverseDepth {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// `height * width` inverse depths.
    pub values: Vec<f32>,
    /// The unit of their inverses.
    pub unit: Unit,
}

impl InverseDepth {
    /// Rows and columns.
    pub fn size(&self) -> (usize, usize) {
        (self.height, self.width)
    }

    /// Whether every value is the inverse of a depth: finite, and above 0.
    pub fn is_whole(&self) -> bool {
        self.values.iter().all(|d| d.is_finite() && *d > 0.0)
    }

    /// The map at another size (bilinear, pixel centres at halves), all depths times `factor`.
    ///
    /// # Panics
    /// If a size is empty.
    pub fn resized(&self, height: usize, width: usize, factor: f64) -> InverseDepth {
        let values = resize_bilinear(&self.values, self.size(), (height, width));
        let values = values.into_iter().map(|d| (d / factor) as f32).collect();
        InverseDepth { width, height, values, unit: self.unit }
    }

    /// Its inverses.
    pub fn depth(&self) -> Depth {
        let values = self.values.iter().map(|d| 1.0 / d).collect();
        Depth { width: self.width, height: self.height, values, unit: self.unit }
    }
}

/// Predicted depth (camera z) of every pixel, row-major.
#[derive(Clone, Debug, PartialEq)]
pub struct Depth {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// `height * width` depths.
    pub values: Vec<f32>,
    /// Their unit.
    pub unit: Unit,
}

impl Depth {
    /// The same in metres; nothing if the unit is not known.
    pub fn metric(self) -> Option<DepthMap> {
        (self.unit == Unit::Metres).then(|| self.as_if_metres())
    }

    /// The numbers as though they were metres, for file formats that have no other unit.
    pub fn as_if_metres(self) -> DepthMap {
        DepthMap { width: self.width, height: self.height, metres: self.values }
    }
}

/// A map of depth (camera z) in metres, row-major, 0 where nothing is known.
#[derive(Clone, Debug, PartialEq)]
pub struct DepthMap {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// `height * width` depths in metres; 0 means unknown.
    pub metres: Vec<f32>,
}

/// Bilinear resize of a row-major map from `(h, w)` to `(h, w)`, without antialiasing, in f64. Pixel centres are at
/// halves ([`half_pixel`]; align_corners false), positions cut to the map.
///
/// # Panics
/// If `map` does not hold `from.0 * from.1` values or a size is empty.
pub fn resize_bilinear(map: &[f32], from: (usize, usize), to: (usize, usize)) -> Vec<f64> {
    assert_eq!(map.len(), from.0 * from.1, "resize_bilinear: a map of {from:?} expected");
    let taps = |input: usize, output: usize| -> Vec<(usize, usize, f64)> {
        assert!(input > 0 && output > 0, "resize_bilinear: {from:?} to {to:?}");
        let tap = |i: usize| {
            let x = half_pixel(i, input, output);
            let below = (x as usize).min(input - 1);
            (below, (below + 1).min(input - 1), x - below as f64)
        };
        (0..output).map(tap).collect()
    };
    let columns = taps(from.1, to.1);
    let mut out = Vec::with_capacity(to.0 * to.1);
    for (above, below, t) in taps(from.0, to.0) {
        let (above, below) = (&map[above * from.1..], &map[below * from.1..]);
        out.extend(columns.iter().map(|&(left, right, s)| {
            let along = |row: &[f32]| (1.0 - s) * f64::from(row[left]) + s * f64::from(row[right]);
            (1.0 - t) * along(above) + t * along(below)
        }));
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn disparity_spans_the_range_of_depths() {
        let disparity = Disparity { width: 3, height: 1, values: vec![0.0, 0.5, 1.0] };
        let depth = disparity.inverse_depth(0.1, 100.0).depth().values;
        for (found, expected) in depth.iter().zip([100.0, 1.0 / 5.005, 0.1]) {
            assert!((found / expected - 1.0).abs() < 1e-6, "{depth:?}");
        }
    }

    #[test]
    fn a_factor_multiplies_depths_and_not_their_inverses() {
        let map = InverseDepth { width: 2, height: 1, values: vec![0.5, 0.25], unit: Unit::Relative };
        assert_eq!(map.resized(1, 2, 3.0).depth().values, [6.0, 12.0]);
        assert!(map.is_whole());
        assert_eq!(map.depth().metric(), None);
        let metric = InverseDepth { unit: Unit::Metres, ..map.clone() };
        assert_eq!(metric.depth().metric().unwrap().metres, [2.0, 4.0]);
        for broken in [f32::NAN, f32::INFINITY, 0.0, -1.0] {
            assert!(!InverseDepth { values: vec![0.5, broken], ..map.clone() }.is_whole(), "{broken}");
        }
    }
}
