//! Bilinear sampling of an image at given places (Jaderberg et al., 1506.02025).

use crate::ops::support::put::{begin_sum, put_run};
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::tensor::{Float, GradSink, Shape, Tensor, Upstream, Var, parallel};

/// Padding mode of sampling: what lies beyond the edge of an image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum GridPadding {
    /// Nothing: 0.
    Zeros,
    /// The nearest edge pixel.
    Border,
    /// The image mirrored: about the centres of its edge pixels if corners are aligned, else about its edges.
    Reflection,
}

/// Bilinear sampling at given places. `y [batch, h, w, channels]`: `x [batch, height, width, channels]` at the places
/// `grid [batch, h, w, 2]`, each an (x, y) with -1 and 1 at the left and right (top and bottom) of the image: at the
/// centres of the outermost pixels if corners are aligned, else at their outer edges.
///
/// Any coordinate is safe. An infinite one lies outside (reflected, it has no place and gives NaN); a NaN gives NaN.
/// At whole pixels the gradient by the grid is that of the cell to the right (below). With `Border` and `Reflection` a
/// coordinate at or beyond the centre of an outermost pixel, where it is clamped, has gradient 0.
#[derive(Clone, Copy, Debug)]
pub struct GridSample {
    /// Padding mode.
    pub padding: GridPadding,
    /// Whether -1 and 1 are the centres of the corner pixels, or else the edges of the image.
    pub align_corners: bool,
}

/// The two taps along one dimension: where, with which weights, and the derivative of the weights by the grid's number.
struct Taps<T> {
    at: [usize; 2],
    weight: [T; 2],
    slope: [T; 2],
}

/// Held within the centres of the outermost pixels; on them and beyond, the slope is 0.
#[inline(always)]
fn clip<T: Float>((p, slope): (T, T), size: usize) -> (T, T) {
    let last = T::of((size - 1) as f64);
    if p <= T::ZERO {
        (T::ZERO, T::ZERO)
    } else if p >= last {
        (last, T::ZERO)
    } else {
        (p, slope)
    }
}

impl GridSample {
    /// The pixel coordinate of a grid number, reflected if need be, and its derivative.
    #[inline(always)]
    fn pixel<T: Float>(&self, g: T, size: usize) -> (T, T) {
        let (n, half) = (size as f64, T::of(0.5));
        let (p, slope, low, span) = if self.align_corners {
            let slope = half * T::of(n - 1.0);
            // Every place is the centre of a single pixel; that of infinity would be 0 times it.
            let p = if size == 1 && !g.is_nan() { T::ZERO } else { (g + T::ONE) * slope };
            (p, slope, T::ZERO, T::of(n - 1.0))
        } else {
            (((g + T::ONE) * T::of(n) - T::ONE) * half, half * T::of(n), -half, T::of(n))
        };
        match self.padding {
            // Everything two pixels out is equally far out; the cast to whole numbers stays in range.
            GridPadding::Zeros => (p.max(T::of(-2.0)).min(T::of(n + 1.0)), slope),
            GridPadding::Border => clip((p, slope), size),
            GridPadding::Reflection if span == T::ZERO => (T::ZERO, T::ZERO),
            GridPadding::Reflection => {
                let (from, slope) = if p < low { (low - p, -slope) } else { (p - low, slope) };
                let flips = (from / span).floor();
                let rest = from - flips * span;
                let odd = flips - T::of(2.0) * (flips * half).floor() != T::ZERO;
                clip(if odd { (span - rest + low, -slope) } else { (rest + low, slope) }, size)
            }
        }
    }

    #[inline(always)]
    fn taps<T: Float>(&self, g: T, size: usize) -> Taps<T> {
        let (p, slope) = self.pixel(g, size);
        let slope = if p.is_nan() { p } else { slope };
        let floor = p.floor();
        let fraction = p - floor;
        // NaN becomes pixel 0, with a weight that is NaN.
        let first = floor.f64() as isize;
        let mut taps = Taps { at: [0; 2], weight: [T::ONE - fraction, fraction], slope: [-slope, slope] };
        for (i, at) in [first, first + 1].into_iter().enumerate() {
            taps.at[i] = at.clamp(0, size as isize - 1) as usize;
            if at < 0 || at >= size as isize {
                (taps.weight[i], taps.slope[i]) = (T::ZERO, T::ZERO);
            }
        }
        taps
    }
}

/// Calls `f` for the four pixels of a sample: the offset, the weights along x and y, and their slopes.
#[inline(always)]
fn corners<T: Float>(
    x: &Taps<T>,
    y: &Taps<T>,
    width: usize,
    channels: usize,
    mut f: impl FnMut(usize, [T; 2], [T; 2]),
) {
    for j in 0..2 {
        for i in 0..2 {
            let offset = (y.at[j] * width + x.at[i]) * channels;
            f(offset, [x.weight[i], y.weight[j]], [x.slope[i], y.slope[j]]);
        }
    }
}

impl<T: Float> Op<T> for GridSample {
    /// The image and the grid.
    type Saved = (Tensor<T>, Tensor<T>);

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        match (inputs[0].nhwc(), inputs[1].nhwc()) {
            (Some([b, h, w, c]), Some([batch, gh, gw, 2])) if b == batch && h * w * c > 0 => {
                Ok(vec![[b, gh, gw, c].into()])
            }
            _ => Err(ShapeError::new("expected an image [batch, height, width, channels] and a grid [batch, h, w, 2]")),
        }
    }

    fn algo(&self, _: &[Shape]) -> &'static str {
        match self.padding {
            GridPadding::Zeros => "zeros",
            GridPadding::Border => "border",
            GridPadding::Reflection => "reflection",
        }
    }

    fn flops(&self, inputs: &[Shape]) -> u64 {
        (inputs[1].rows() * (8 * inputs[0].last() + 20)) as u64
    }

    fn forward(&self, inputs: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let (x, grid) = (inputs[0], inputs[1]);
        let [batch, height, width, channels] = x.shape().nhwc().expect("checked by the shape rule");
        let [_, rows, cols, _] = grid.shape().nhwc().expect("checked by the shape rule");
        let y = Tensor::build([batch, rows, cols, channels], |out| {
            let work = 16 * out.len();
            parallel::for_each_unit(out, cols * channels, work, |i, out| {
                let image = &x.data()[i / rows * height * width * channels..][..height * width * channels];
                let grid = &grid.data()[i * cols * 2..][..cols * 2];
                for (out, g) in out.chunks_exact_mut(channels).zip(grid.chunks_exact(2)) {
                    let (tx, ty) = (self.taps(g[0], width), self.taps(g[1], height));
                    out.fill(T::ZERO);
                    corners(&tx, &ty, width, channels, |offset, weight, _| {
                        let weight = weight[0] * weight[1];
                        let pixel = &image[offset..][..channels];
                        out.iter_mut().zip(pixel).for_each(|(y, &x)| *y = x.mul_add(weight, *y));
                    });
                }
            });
        });
        (vec![y], (x.clone(), grid.clone()))
    }

    /// A sample is a sum over four pixels of x w_x w_y. So dx is scattered with the same weights (sample by sample of
    /// the batch, in order), and the grid's two numbers get `sum_c dy_c x_c` times w_x' w_y and w_x w_y'.
    fn backward(&self, (x, grid): Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let g = upstream.only();
        let [_, height, width, channels] = x.shape().nhwc().expect("checked by the shape rule");
        let [_, rows, cols, _] = grid.shape().nhwc().expect("checked by the shape rule");
        let (size, places) = (height * width * channels, rows * cols);
        sink.accumulate(0, |out, accum| {
            let work = 16 * g.len() + out.len();
            parallel::for_each_unit(out, size, work, |b, out| {
                begin_sum(out, accum);
                let g = &g.data()[b * places * channels..][..places * channels];
                let grid = &grid.data()[b * places * 2..][..places * 2];
                for (g, place) in g.chunks_exact(channels).zip(grid.chunks_exact(2)) {
                    let (tx, ty) = (self.taps(place[0], width), self.taps(place[1], height));
                    corners(&tx, &ty, width, channels, |offset, weight, _| {
                        let weight = weight[0] * weight[1];
                        let pixel = &mut out[offset..][..channels];
                        pixel.iter_mut().zip(g).for_each(|(x, &g)| *x = g.mul_add(weight, *x));
                    });
                }
            });
        });
        sink.accumulate(1, |out, accum| {
            let work = 8 * g.len();
            parallel::for_each_unit(out, cols * 2, work, |i, out| {
                let image = &x.data()[i / rows * size..][..size];
                let grid = &grid.data()[i * cols * 2..][..cols * 2];
                let g = &g.data()[i * cols * channels..][..cols * channels];
                for (k, (out, place)) in out.chunks_exact_mut(2).zip(grid.chunks_exact(2)).enumerate() {
                    let g = &g[k * channels..][..channels];
                    let (tx, ty) = (self.taps(place[0], width), self.taps(place[1], height));
                    let mut sums = [T::ZERO; 2];
                    corners(&tx, &ty, width, channels, |offset, weight, slope| {
                        let pixel = &image[offset..][..channels];
                        let dot = g.iter().zip(pixel).fold(T::ZERO, |sum, (&g, &x)| g.mul_add(x, sum));
                        sums[0] = dot.mul_add(slope[0] * weight[1], sums[0]);
                        sums[1] = dot.mul_add(weight[0] * slope[1], sums[1]);
                    });
                    put_run(accum, out, &sums);
                }
            });
        });
    }
}

impl Checked for GridSample {
    fn cases() -> Vec<Case<Self>> {
        let mut cases = Vec::new();
        for padding in [GridPadding::Zeros, GridPadding::Border, GridPadding::Reflection] {
            for align_corners in [false, true] {
                let op = GridSample { padding, align_corners };
                let x = |c: usize| Input::random("x", [2, 4, 5, c]);
                let grid = |range: f64| Input::uniform("grid", [2, 3, 4, 2], -range, range);
                cases.extend([
                    Case::new("inside and outside", op, [x(3), grid(1.3)]),
                    Case::new("far outside", op, [x(1), grid(4.0)]),
                ]);
            }
        }
        let op = GridSample { padding: GridPadding::Border, align_corners: true };
        let ramp = Input::values("x", [1, 3, 4, 2], (0..24).map(f64::from).collect::<Vec<_>>());
        let clamped = Input::values("grid", [1, 1, 2, 2], [-1.0, 0.1, 0.3, 1.0]);
        cases.extend([
            Case::new("many channels", op, [Input::random("x", [1, 2, 3, 17]), Input::random("grid", [1, 2, 2, 2])]),
            Case::new("three images", op, [Input::random("x", [3, 2, 3, 2]), Input::random("grid", [3, 2, 2, 2])]),
            Case::new("on the border", op, [ramp, clamped]).kinks(2).promises(1, [0.0, 16.0, 6.0, 0.0]),
            Case::new(
                "a single pixel",
                op,
                [Input::random("x", [2, 1, 1, 2]), Input::random("grid", [2, 2, 1, 2]).ignored()],
            ),
            Case::new("no place", op, [Input::random("x", [2, 2, 2, 2]), Input::random("grid", [2, 0, 3, 2])]).flat(),
        ]);
        cases
    }
}

impl<T: Float> Var<T> {
    /// This image `[batch, height, width, channels]` sampled bilinearly at `grid [batch, h, w, 2]`, (x, y) from -1 to
    /// 1: see [`GridSample`].
    #[track_caller]
    pub fn grid_sample(&self, grid: &Self, padding: GridPadding, align_corners: bool) -> Self {
        apply1(GridSample { padding, align_corners }, &[self, grid])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tensor::Tape;

    #[test]
    fn any_coordinate_is_safe() {
        let wild = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1e30, -1e30, 1e300, f64::MAX, -1e18];
        let numbers: Vec<f64> = wild.iter().flat_map(|&a| [[a, 0.2], [-0.1, a]]).flatten().collect();
        for padding in [GridPadding::Zeros, GridPadding::Border, GridPadding::Reflection] {
            for align_corners in [false, true] {
                let tape = Tape::new();
                let x = tape.leaf(Tensor::full([1, 3, 4, 2], 1.0));
                let grid = tape.leaf(Tensor::from_vec([1, 1, 16, 2], numbers.clone()));
                let y = x.grid_sample(&grid, padding, align_corners);
                let sums = y.value().data();
                assert!(sums[0].is_nan() && sums[2].is_nan(), "NaN stays NaN");
                match padding {
                    GridPadding::Zeros => assert!(sums[4..].iter().all(|&y| y == 0.0)),
                    GridPadding::Border => assert!(sums[4..].iter().all(|&y| (y - 1.0).abs() < 1e-12)),
                    GridPadding::Reflection => assert!(sums[4..12].iter().all(|y| y.is_nan())),
                }
                let gradients = y.sum_all().backward();
                assert!(gradients.get(&grid).expect("a gradient").data()[0].is_nan());
            }
        }
    }

    #[test]
    fn the_identity_grid_gives_the_image_back() {
        let x = Var::constant(Tensor::from_vec([1, 2, 3, 1], vec![1.0f64, 2.0, 3.0, 4.0, 5.0, 6.0]));
        let places = vec![-1.0, -1.0, 0.0, -1.0, 1.0, -1.0, -1.0, 1.0, 0.0, 1.0, 1.0, 1.0];
        let grid = Var::constant(Tensor::from_vec([1, 2, 3, 2], places));
        let y = x.grid_sample(&grid, GridPadding::Zeros, true);
        assert!(y.value().same_bits(x.value()));
    }
}
