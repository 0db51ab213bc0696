//! The kernels: convolution of each channel with its own window, over channels that lie side by side.
//!
//! They work on [`Rows`], one row a pixel, so that a range of channels of a wider tensor (the values among queries, keys
//! and values) is convolved where it lies. Channels go in blocks of one vector register, the last one perhaps in part.

use pulp::{Simd, WithSimd};

use crate::ops::linear::sum_into;
use crate::tensor::gemm::{Rows, RowsMut};
use crate::tensor::pool::Buffer;
use crate::tensor::simd::dispatch_vector;
use crate::tensor::{Accum, Float, Tensor, parallel};

/// The images and the window that is moved over them. Pixels outside the image are 0.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Window {
    /// Images.
    pub batch: usize,
    /// Height of the input.
    pub height: usize,
    /// Width of the input.
    pub width: usize,
    /// Height and width of the window.
    pub kernel: [usize; 2],
    /// Pixels from one position of the window to the next.
    pub stride: usize,
    /// Rows and columns of zeros on each side.
    pub padding: usize,
}

impl Window {
    /// Height and width of the output; `None` if the window does not fit.
    pub fn output(&self) -> Option<[usize; 2]> {
        let extent = |n: usize, k: usize| Some((n + 2 * self.padding).checked_sub(k)?.checked_div(self.stride)? + 1);
        Some([extent(self.height, self.kernel[0])?, extent(self.width, self.kernel[1])?])
    }

    fn out(&self) -> [usize; 2] {
        self.output().expect("a window that fits, by the shape rule of the op")
    }

    fn pixels(&self) -> usize {
        self.batch * self.height * self.width
    }

    /// The taps of the window's position `at` that meet one of `n` pixels, of `k`.
    #[inline(always)]
    fn taps(&self, at: usize, n: usize, k: usize) -> (usize, usize) {
        let start = at * self.stride;
        (self.padding.saturating_sub(start).min(k), (n + self.padding).saturating_sub(start).min(k))
    }

    /// The columns of the output whose windows lie inside the image, `width` of them in all.
    #[inline(always)]
    fn interior(&self, width: usize) -> (usize, usize) {
        let from = self.padding.div_ceil(self.stride).min(width);
        let to = (self.width + self.padding).checked_sub(self.kernel[1]).map_or(0, |room| room / self.stride + 1);
        (from, to.clamp(from, width))
    }
}

/// Neighbouring outputs computed together, which share the weights and most of the pixels that they read.
const TILE: usize = 4;

/// Rows of pixels handed to a thread at a time: about 2^17 multiplications.
fn band(row: usize) -> usize {
    ((1 << 17) / row.max(1)).clamp(1, 64)
}

/// `y = bias + w * x` (cross-correlation) or `y += ...`: x has `batch * height * width` rows, w `kernel` rows, all with
/// the same number of columns.
///
/// `tile`: rows of the output handed to a thread at a time, chosen by shape if 0.
pub(crate) fn forward<T: Float>(
    window: &Window,
    x: Rows<T>,
    w: &[T],
    bias: Option<&[T]>,
    y: RowsMut<T>,
    accum: Accum,
    tile: usize,
) {
    let ([height, width], c, stride) = (window.out(), x.cols, y.row_stride);
    let taps = window.kernel[0] * window.kernel[1];
    assert!(x.rows == window.pixels() && y.rows == window.batch * height * width, "depthwise: rows of the images");
    assert!(y.cols == c && w.len() == taps * c && bias.is_none_or(|b| b.len() == c), "depthwise: {c} channels");
    if y.rows * c == 0 {
        return;
    }
    let zeros = Buffer::filled(if bias.is_some() { 0 } else { c }, T::ZERO);
    let bias = bias.unwrap_or(&zeros);
    let tile = if tile > 0 { tile } else { band(width * c * taps) };
    parallel::for_each_chunk(y.data, tile * width * stride, 2 * y.rows * c * taps, |i, out| {
        let pass = Pass { window: *window, height, width, first_row: i * tile, w };
        dispatch_vector(Convolve { pass, x, bias, out, stride, accum });
    });
}

/// What the three kernels share: the window, the extents of the output, the row they begin at, and the weight.
#[derive(Clone, Copy)]
struct Pass<'a, T> {
    window: Window,
    height: usize,
    width: usize,
    first_row: usize,
    w: &'a [T],
}

/// Some rows of the output.
struct Convolve<'a, T> {
    pass: Pass<'a, T>,
    x: Rows<'a, T>,
    bias: &'a [T],
    out: &'a mut [T],
    stride: usize,
    accum: Accum,
}

impl<T: Float> WithSimd for Convolve<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Convolve { pass, x, bias, out, stride, accum } = self;
        for (i, out) in out.chunks_mut(pass.width * stride).enumerate() {
            let at = pass.first_row + i;
            let line = Line { pass, x, bias, image: at / pass.height, row: at % pass.height, stride, accum };
            let full = x.cols / T::lanes::<S>() * T::lanes::<S>();
            for first in (0..full).step_by(T::lanes::<S>()) {
                line.block(simd, Block::<false> { first, end: first + T::lanes::<S>() }, out);
            }
            if full < x.cols {
                line.block(simd, Block::<true> { first: full, end: x.cols }, out);
            }
        }
    }
}

/// A block of channels: those of a vector, or (`PART`) fewer.
#[derive(Clone, Copy)]
struct Block<const PART: bool> {
    first: usize,
    end: usize,
}

impl<const PART: bool> Block<PART> {
    /// The block of the pixel or tap that begins at `at`.
    #[inline(always)]
    fn load<T: Float, S: Simd>(self, simd: S, x: &[T], at: usize) -> T::V<S> {
        let x = &x[at + self.first..at + self.end];
        if PART { T::load_part(simd, x) } else { T::load(simd, x) }
    }

    #[inline(always)]
    fn store<T: Float, S: Simd>(self, simd: S, out: &mut [T], at: usize, v: T::V<S>, accum: Accum) {
        let v = match accum {
            Accum::Replace => v,
            Accum::Add => T::vector_add(simd, self.load(simd, out, at), v),
        };
        let out = &mut out[at + self.first..at + self.end];
        if PART { T::store_part(simd, out, v) } else { T::store(simd, out, v) }
    }
}

/// One row of the output of one image.
#[derive(Clone, Copy)]
struct Line<'a, T> {
    pass: Pass<'a, T>,
    x: Rows<'a, T>,
    bias: &'a [T],
    image: usize,
    row: usize,
    stride: usize,
    accum: Accum,
}

impl<T: Float> Line<'_, T> {
    /// One block of channels of the row.
    #[inline(always)]
    fn block<S: Simd, const PART: bool>(&self, simd: S, block: Block<PART>, out: &mut [T]) {
        match (self.pass.window.kernel, self.pass.window.stride) {
            ([3, 3], 1) => self.tiles::<S, PART, 3, 1>(simd, block, out),
            ([3, 3], 2) => self.tiles::<S, PART, 3, 2>(simd, block, out),
            ([5, 5], 1) => self.tiles::<S, PART, 5, 1>(simd, block, out),
            ([7, 7], 1) => self.tiles::<S, PART, 7, 1>(simd, block, out),
            _ => self.singles(simd, block, out, 0, self.pass.width),
        }
    }

    /// The row for a window of known size: tiles of outputs, and single ones at the edges.
    #[inline(always)]
    fn tiles<S: Simd, const PART: bool, const K: usize, const STRIDE: usize>(
        &self,
        simd: S,
        block: Block<PART>,
        out: &mut [T],
    ) {
        let width = self.pass.width;
        let (from, to) = self.pass.window.interior(width);
        let tiled = from + (to - from) / TILE * TILE;
        self.singles(simd, block, out, 0, from);
        for ox in (from..tiled).step_by(TILE) {
            let sums = self.tile::<S, PART, K, STRIDE>(simd, block, ox);
            for (p, &sum) in sums.iter().enumerate() {
                block.store(simd, out, (ox + p) * self.stride, sum, self.accum);
            }
        }
        self.singles(simd, block, out, tiled, width);
    }

    /// [`TILE`] neighbouring outputs whose windows lie inside the image.
    #[inline(always)]
    fn tile<S: Simd, const PART: bool, const K: usize, const STRIDE: usize>(
        &self,
        simd: S,
        block: Block<PART>,
        ox: usize,
    ) -> [T::V<S>; TILE] {
        let Window { height, width, padding, .. } = self.pass.window;
        let (c, step) = (self.x.cols, self.x.row_stride);
        let (ky_from, ky_to) = self.pass.window.taps(self.row, height, K);
        let mut sums = [block.load(simd, self.bias, 0); TILE];
        for ky in ky_from..ky_to {
            let pixel = (self.image * height + self.row * STRIDE + ky - padding) * width + ox * STRIDE - padding;
            let x = &self.x.data[pixel * step..];
            let w = &self.pass.w[ky * K * c..(ky + 1) * K * c];
            for kx in 0..K {
                let w = block.load(simd, w, kx * c);
                for (p, sum) in sums.iter_mut().enumerate() {
                    *sum = T::fma(simd, block.load(simd, x, (p * STRIDE + kx) * step), w, *sum);
                }
            }
        }
        sums
    }

    /// Outputs one by one, each with only those taps that meet the image.
    #[inline(always)]
    fn singles<S: Simd, const PART: bool>(&self, simd: S, block: Block<PART>, out: &mut [T], from: usize, to: usize) {
        let Window { height, width, padding, stride, kernel: [kh, kw], .. } = self.pass.window;
        let (c, step) = (self.x.cols, self.x.row_stride);
        let (ky_from, ky_to) = self.pass.window.taps(self.row, height, kh);
        for ox in from..to {
            let (kx_from, kx_to) = self.pass.window.taps(ox, width, kw);
            let mut sum = block.load(simd, self.bias, 0);
            for ky in ky_from..ky_to {
                let row = (self.image * height + self.row * stride + ky - padding) * width;
                for kx in kx_from..kx_to {
                    let x = block.load(simd, self.x.data, (row + ox * stride + kx - padding) * step);
                    sum = T::fma(simd, x, block.load(simd, self.pass.w, (ky * kw + kx) * c), sum);
                }
            }
            block.store(simd, out, ox * self.stride, sum, self.accum);
        }
    }
}

/// `dx = ` the gradient of the input, or `dx += ...`: g has a row for each pixel of the output.
///
/// `tile`: rows of the input handed to a thread at a time, chosen by shape if 0.
pub(crate) fn input_gradient<T: Float>(
    window: &Window,
    g: Rows<T>,
    w: &[T],
    dx: RowsMut<T>,
    accum: Accum,
    tile: usize,
) {
    let ([height, width], c, stride) = (window.out(), g.cols, dx.row_stride);
    let [kh, kw] = window.kernel;
    assert!(g.rows == window.batch * height * width && dx.rows == window.pixels(), "depthwise: rows of the images");
    assert!(dx.cols == c && w.len() == kh * kw * c, "depthwise: {c} channels");
    if dx.rows * c == 0 {
        return;
    }
    if window.stride == 1 && kh == kw && window.padding < kh {
        // The transpose of a correlation with stride 1 is the correlation with the window turned by half a circle.
        let mut turned = Buffer::stale(w.len());
        for (to, from) in turned.chunks_exact_mut(c).zip(w.chunks_exact(c).rev()) {
            to.copy_from_slice(from);
        }
        let window = Window { height, width, padding: kh - 1 - window.padding, ..*window };
        return forward(&window, g, &turned, None, dx, accum, tile);
    }
    let tile = if tile > 0 { tile } else { band(window.width * c * kh * kw) };
    parallel::for_each_chunk(dx.data, tile * window.width * stride, 2 * g.rows * c * kh * kw, |i, out| {
        let pass = Pass { window: *window, height, width, first_row: i * tile, w };
        dispatch_vector(Gather { pass, g, out, stride, accum });
    });
}

/// Some rows of the input's gradient: each pixel gathers from the outputs whose windows met it.
struct Gather<'a, T> {
    pass: Pass<'a, T>,
    g: Rows<'a, T>,
    out: &'a mut [T],
    stride: usize,
    accum: Accum,
}

impl<T: Float> WithSimd for Gather<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Gather { pass, g, out, stride, accum } = self;
        let (lanes, c, window) = (T::lanes::<S>(), g.cols, pass.window);
        let full = c / lanes * lanes;
        for (i, out) in out.chunks_mut(window.width * stride).enumerate() {
            let at = pass.first_row + i;
            let (image, y) = (at / window.height, at % window.height + window.padding);
            for (ix, out) in out.chunks_mut(stride).enumerate() {
                let x = ix + window.padding;
                for first in (0..full).step_by(lanes) {
                    let block = Block::<false> { first, end: first + lanes };
                    block.store(simd, out, 0, pass.gather(simd, block, g, [image, y, x]), accum);
                }
                if full < c {
                    let block = Block::<true> { first: full, end: c };
                    block.store(simd, out, 0, pass.gather(simd, block, g, [image, y, x]), accum);
                }
            }
        }
    }
}

impl<T: Float> Pass<'_, T> {
    /// The gradient of pixel (y, x), counted with the padding. Tap k of output o reads pixel o stride + k: every
    /// stride-th tap meets this one.
    #[inline(always)]
    fn gather<S: Simd, const PART: bool>(
        &self,
        simd: S,
        block: Block<PART>,
        g: Rows<T>,
        [image, y, x]: [usize; 3],
    ) -> T::V<S> {
        let Window { stride, kernel: [kh, kw], .. } = self.window;
        // The division by a stride of 2 must not cost one.
        let (oy, ox, ky, kx) = match stride {
            2 => (y / 2, x / 2, y % 2, x % 2),
            s => (y / s, x / s, y % s, x % s),
        };
        let mut sum = T::splat(simd, T::ZERO);
        let mut row = oy;
        let mut ky = ky;
        while ky < kh {
            if row < self.height {
                let (mut column, mut kx) = (ox, kx);
                while kx < kw {
                    if column < self.width {
                        let at = (image * self.height + row) * self.width + column;
                        let d = block.load(simd, g.data, at * g.row_stride);
                        sum = T::fma(simd, d, block.load(simd, self.w, (ky * kw + kx) * g.cols), sum);
                    }
                    // Below 0 this wraps to beyond the width, and stays out.
                    column = column.wrapping_sub(1);
                    kx += stride;
                }
            }
            row = row.wrapping_sub(1);
            ky += stride;
        }
        sum
    }
}

/// `dw = ` the gradient of the weight, or `dw += ...`, in a fixed number of partial sums over bands of rows, added up in
/// order: the same bits for any number of threads.
///
/// `tile`: rows of the output in a partial sum, chosen by shape if 0.
pub(crate) fn weight_gradient<T: Float>(
    window: &Window,
    x: Rows<T>,
    g: Rows<T>,
    dw: &mut [T],
    accum: Accum,
    tile: usize,
) {
    let ([height, width], c) = (window.out(), g.cols);
    let [kh, kw] = window.kernel;
    assert!(x.rows == window.pixels() && g.rows == window.batch * height * width, "depthwise: rows of the images");
    assert!(x.cols == c && dw.len() == kh * kw * c, "depthwise: {c} channels");
    if dw.is_empty() {
        return;
    }
    let rows = window.batch * height;
    let tile = if tile > 0 { tile } else { rows.div_ceil(16).max(band(width * c * kh * kw) / 4).max(1) };
    let sums = parallel::map(rows.div_ceil(tile), 2 * g.rows * c * kh * kw, |i| {
        Tensor::build([kh * kw, c], |dw| {
            dw.fill(T::ZERO);
            let pass = Pass { window: *window, height, width, first_row: i * tile, w: &[] };
            dispatch_vector(Weigh { pass, rows: tile.min(rows - i * tile), x, g, dw });
        })
    });
    sum_into(dw, accum, &sums);
}

/// What some rows of the output add to the weight's gradient.
struct Weigh<'a, T> {
    pass: Pass<'a, T>,
    rows: usize,
    x: Rows<'a, T>,
    g: Rows<'a, T>,
    dw: &'a mut [T],
}

impl<T: Float> WithSimd for Weigh<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let (lanes, c) = (T::lanes::<S>(), self.x.cols);
        let full = c / lanes * lanes;
        for at in self.pass.first_row..self.pass.first_row + self.rows {
            for first in (0..full).step_by(lanes) {
                self.row(simd, Block::<false> { first, end: first + lanes }, at);
            }
            if full < c {
                self.row(simd, Block::<true> { first: full, end: c }, at);
            }
        }
    }
}

impl<T: Float> Weigh<'_, T> {
    /// One block of channels of one row.
    #[inline(always)]
    fn row<S: Simd, const PART: bool>(&mut self, simd: S, block: Block<PART>, at: usize) {
        let Window { stride, kernel: [kh, kw], height, width, padding, .. } = self.pass.window;
        let (image, row) = (at / self.pass.height, at % self.pass.height);
        let (ky_from, ky_to) = self.pass.window.taps(row, height, kh);
        let line = |ky: usize| (image * height + row * stride + ky - padding) * width;
        if ([kh, kw], ky_from, ky_to) == ([3, 3], 0, 3) {
            // All nine taps at once: three sums alone would wait for one another.
            let lines = [line(0), line(1), line(2)];
            return match stride {
                1 => self.taps::<S, PART, 3, 3, 1>(simd, block, at, 0, lines),
                2 => self.taps::<S, PART, 3, 3, 2>(simd, block, at, 0, lines),
                _ => lines.into_iter().enumerate().for_each(|(ky, line)| {
                    self.singles(simd, block, at, ky, line, 0, self.pass.width);
                }),
            };
        }
        for ky in ky_from..ky_to {
            match (kw, stride) {
                (3, 1) => self.taps::<S, PART, 1, 3, 1>(simd, block, at, ky, [line(ky)]),
                (3, 2) => self.taps::<S, PART, 1, 3, 2>(simd, block, at, ky, [line(ky)]),
                (5, 1) => self.taps::<S, PART, 1, 5, 1>(simd, block, at, ky, [line(ky)]),
                (7, 1) => self.taps::<S, PART, 1, 7, 1>(simd, block, at, ky, [line(ky)]),
                _ => self.singles(simd, block, at, ky, line(ky), 0, self.pass.width),
            }
        }
    }

    /// `R` rows of taps from `ky` on over a row of the output, one sum in a register for each tap; `lines` are the
    /// first pixels of the rows of x that they meet.
    #[inline(always)]
    fn taps<S: Simd, const PART: bool, const R: usize, const K: usize, const STRIDE: usize>(
        &mut self,
        simd: S,
        block: Block<PART>,
        at: usize,
        ky: usize,
        lines: [usize; R],
    ) {
        let (c, step, width, padding) = (self.x.cols, self.x.row_stride, self.pass.width, self.pass.window.padding);
        let (from, to) = self.pass.window.interior(width);
        let mut sums = [[T::splat(simd, T::ZERO); K]; R];
        for ox in from..to {
            let g = block.load(simd, self.g.data, (at * width + ox) * self.g.row_stride);
            for (sums, line) in sums.iter_mut().zip(lines) {
                let x = &self.x.data[(line + ox * STRIDE - padding) * step..];
                for (kx, sum) in sums.iter_mut().enumerate() {
                    *sum = T::fma(simd, block.load(simd, x, kx * step), g, *sum);
                }
            }
        }
        for (r, sums) in sums.iter().enumerate() {
            for (kx, &sum) in sums.iter().enumerate() {
                block.store(simd, self.dw, ((ky + r) * K + kx) * c, sum, Accum::Add);
            }
        }
        for (r, line) in lines.into_iter().enumerate() {
            self.singles(simd, block, at, ky + r, line, 0, from);
            self.singles(simd, block, at, ky + r, line, to, width);
        }
    }

    /// A row of taps at single outputs, those taps that meet the image.
    #[inline(always)]
    #[expect(clippy::too_many_arguments, reason = "the parts of one loop nest")]
    fn singles<S: Simd, const PART: bool>(
        &mut self,
        simd: S,
        block: Block<PART>,
        at: usize,
        ky: usize,
        line: usize,
        from: usize,
        to: usize,
    ) {
        let Window { stride, kernel: [_, kw], width, padding, .. } = self.pass.window;
        let c = self.x.cols;
        for ox in from..to {
            let g = block.load(simd, self.g.data, (at * self.pass.width + ox) * self.g.row_stride);
            let (kx_from, kx_to) = self.pass.window.taps(ox, width, kw);
            for kx in kx_from..kx_to {
                let x = block.load(simd, self.x.data, (line + ox * stride + kx - padding) * self.x.row_stride);
                let tap = (ky * kw + kx) * c;
                let sum = T::fma(simd, x, g, block.load(simd, self.dw, tap));
                block.store(simd, self.dw, tap, sum, Accum::Replace);
            }
        }
    }
}

/// The sum of the rows of g, in blocks: the same bits for any number of threads.
pub(crate) fn bias_gradient<T: Float>(g: Rows<T>, db: &mut [T], accum: Accum) {
    const BLOCK: usize = 256;
    let (c, step) = (g.cols, g.row_stride);
    assert_eq!(db.len(), c, "depthwise: a bias for each channel");
    if c == 0 {
        return;
    }
    let sums = parallel::map(g.rows.div_ceil(BLOCK), g.rows * c, |i| {
        Tensor::build([c], |sum| {
            sum.fill(T::ZERO);
            let rows = BLOCK.min(g.rows - i * BLOCK);
            for row in g.data[i * BLOCK * step..].chunks(step).take(rows) {
                sum.iter_mut().zip(&row[..c]).for_each(|(s, &g)| *s += g);
            }
        })
    });
    sum_into(db, accum, &sums);
}
