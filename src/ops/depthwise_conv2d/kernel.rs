//! The kernels: convolution of each channel with its own window, over channels that lie side by side.
//!
//! They work on [`Rows`], one row a pixel, so that a range of channels of a wider tensor (the values among queries, keys
//! and values) is convolved where it lies. Channels go in blocks of 16 or 8 that stay in registers; where the count is no
//! multiple, the last block overlaps the one before and only its new channels are written.

use crate::ops::linear::sum_into;
use crate::tensor::gemm::{Rows, RowsMut};
use crate::tensor::pool::Buffer;
use crate::tensor::{Accum, Float, Tensor, parallel, simd};

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

/// Lanes of the widest block.
const WIDE: usize = 16;
/// Lanes of the narrower one.
const NARROW: usize = 8;
/// Neighbouring outputs computed together, which share the pixels that they read.
const TILE: usize = 4;

/// Rows of pixels handed to a thread at a time: about 2^16 multiplications.
fn band(row: usize) -> usize {
    ((1 << 16) / row.max(1)).clamp(1, 64)
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
    let (window, [height, width], c) = (*window, window.out(), x.cols);
    let taps = window.kernel[0] * window.kernel[1];
    assert!(x.rows == window.pixels() && y.rows == window.batch * height * width, "depthwise: rows of the images");
    assert!(y.cols == c && w.len() == taps * c && bias.is_none_or(|b| b.len() == c), "depthwise: {c} channels");
    if y.rows * c == 0 {
        return;
    }
    let zeros = Buffer::filled(if bias.is_some() { 0 } else { c }, T::ZERO);
    let bias = bias.unwrap_or(&zeros);
    let row = width * y.row_stride;
    let tile = if tile > 0 { tile } else { band(width * c * taps) };
    parallel::for_each_chunk(y.data, tile * row, 2 * y.rows * c * taps, |i, y| {
        simd::dispatch(
            #[inline(always)]
            || {
                for (j, out) in y.chunks_mut(row).enumerate() {
                    let at = i * tile + j;
                    let line = Line { window, x, w, bias, image: at / height, row: at % height };
                    match c {
                        WIDE.. => line.convolve::<WIDE>(out, y_stride(row, width), accum),
                        NARROW.. => line.convolve::<NARROW>(out, y_stride(row, width), accum),
                        _ => line.convolve::<1>(out, y_stride(row, width), accum),
                    }
                }
            },
        );
    });
}

#[inline(always)]
fn y_stride(row: usize, width: usize) -> usize {
    row / width
}

/// One row of the output of one image.
#[derive(Clone, Copy)]
struct Line<'a, T> {
    window: Window,
    x: Rows<'a, T>,
    w: &'a [T],
    bias: &'a [T],
    image: usize,
    row: usize,
}

impl<T: Float> Line<'_, T> {
    /// Computes the row, block by block.
    #[inline(always)]
    fn convolve<const L: usize>(&self, out: &mut [T], stride: usize, accum: Accum) {
        for (first, skip) in blocks::<L>(self.x.cols) {
            match (L, self.window.kernel, self.window.stride) {
                (WIDE | NARROW, [3, 3], 1) => self.block::<L, 3, 1>(first, skip, out, stride, accum),
                (WIDE | NARROW, [3, 3], 2) => self.block::<L, 3, 2>(first, skip, out, stride, accum),
                (WIDE | NARROW, [5, 5], 1) => self.block::<L, 5, 1>(first, skip, out, stride, accum),
                (WIDE | NARROW, [7, 7], 1) => self.block::<L, 7, 1>(first, skip, out, stride, accum),
                _ => {
                    for (ox, out) in out.chunks_mut(stride).enumerate() {
                        store(&mut out[first..], skip, &self.pixel::<L>(ox, first), accum);
                    }
                }
            }
        }
    }

    /// One block of channels of the row, for a window of known size: tiles of outputs, and single ones at the edges.
    #[inline(always)]
    fn block<const L: usize, const K: usize, const S: usize>(
        &self,
        first: usize,
        skip: usize,
        out: &mut [T],
        stride: usize,
        accum: Accum,
    ) {
        let width = out.len().div_ceil(stride);
        let (from, to) = self.window.interior(width);
        let tiled = from + (to - from) / TILE * TILE;
        for ox in (from..tiled).step_by(TILE) {
            let sums = self.tile::<L, K, S>(ox, first);
            for (p, sums) in sums.iter().enumerate() {
                store(&mut out[(ox + p) * stride + first..], skip, sums, accum);
            }
        }
        for ox in (0..from).chain(tiled..width) {
            store(&mut out[ox * stride + first..], skip, &self.pixel::<L>(ox, first), accum);
        }
    }

    /// [`TILE`] neighbouring outputs whose windows lie inside the image.
    #[inline(always)]
    fn tile<const L: usize, const K: usize, const S: usize>(&self, ox: usize, first: usize) -> [[T; L]; TILE] {
        let Window { height, width, padding, .. } = self.window;
        let (c, step) = (self.x.cols, self.x.row_stride);
        let (ky_from, ky_to) = self.window.taps(self.row, height, K);
        let mut sums = [*load::<T, L>(self.bias, first); TILE];
        for ky in ky_from..ky_to {
            let pixel = (self.image * height + self.row * S + ky - padding) * width + ox * S - padding;
            let x = &self.x.data[pixel * step + first..];
            let w = &self.w[ky * K * c + first..];
            for kx in 0..K {
                let w = load::<T, L>(w, kx * c);
                for (p, sum) in sums.iter_mut().enumerate() {
                    fma(sum, load(x, (p * S + kx) * step), w);
                }
            }
        }
        sums
    }

    /// One output, with only those taps that meet the image.
    #[inline(always)]
    fn pixel<const L: usize>(&self, ox: usize, first: usize) -> [T; L] {
        let Window { height, width, padding, stride, kernel: [kh, kw], .. } = self.window;
        let (c, step) = (self.x.cols, self.x.row_stride);
        let (ky_from, ky_to) = self.window.taps(self.row, height, kh);
        let (kx_from, kx_to) = self.window.taps(ox, width, kw);
        let mut sum = *load::<T, L>(self.bias, first);
        for ky in ky_from..ky_to {
            let row = (self.image * height + self.row * stride + ky - padding) * width;
            for kx in kx_from..kx_to {
                let x = load(self.x.data, (row + ox * stride + kx - padding) * step + first);
                fma(&mut sum, x, load(self.w, (ky * kw + kx) * c + first));
            }
        }
        sum
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
    let (window, [height, width], c) = (*window, window.out(), g.cols);
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
        let window = Window { height, width, padding: kh - 1 - window.padding, ..window };
        return forward(&window, g, &turned, None, dx, accum, tile);
    }
    let (stride, row) = (dx.row_stride, window.width * dx.row_stride);
    let tile = if tile > 0 { tile } else { band(window.width * c * kh * kw) };
    parallel::for_each_chunk(dx.data, tile * row, 2 * g.rows * c * kh * kw, |i, dx| {
        simd::dispatch(
            #[inline(always)]
            || {
                for (j, out) in dx.chunks_mut(row).enumerate() {
                    let at = i * tile + j;
                    match c {
                        WIDE.. => gather_row::<T, WIDE>(&window, [height, width], at, g, w, out, stride, accum),
                        NARROW.. => gather_row::<T, NARROW>(&window, [height, width], at, g, w, out, stride, accum),
                        _ => gather_row::<T, 1>(&window, [height, width], at, g, w, out, stride, accum),
                    }
                }
            },
        );
    });
}

/// A row of the input's gradient: each pixel gathers from the outputs whose windows met it.
#[inline(always)]
#[expect(clippy::too_many_arguments, reason = "the parts of one loop nest")]
fn gather_row<T: Float, const L: usize>(
    window: &Window,
    [height, width]: [usize; 2],
    at: usize,
    g: Rows<T>,
    w: &[T],
    out: &mut [T],
    stride: usize,
    accum: Accum,
) {
    let Window { padding, stride: s, kernel: [kh, kw], .. } = *window;
    let (image, c) = (at / window.height, g.cols);
    let y = at % window.height + padding;
    for (ix, out) in out.chunks_mut(stride).enumerate() {
        let x = ix + padding;
        // The taps that meet this pixel are every s-th: tap k of output o reads pixel o s + k - padding.
        let (last_x, first_kx) = (x / s, x % s);
        let (last_y, first_ky) = (y / s, y % s);
        for (first, skip) in blocks::<L>(c) {
            let mut sum = [T::ZERO; L];
            for (back, ky) in (first_ky..kh).step_by(s).enumerate().take(last_y + 1) {
                let oy = last_y - back;
                if oy >= height {
                    continue;
                }
                let row = (image * height + oy) * width;
                for (back, kx) in (first_kx..kw).step_by(s).enumerate().take(last_x + 1) {
                    let ox = last_x - back;
                    if ox < width {
                        let g = load(g.data, (row + ox) * g.row_stride + first);
                        fma(&mut sum, g, load(w, (ky * kw + kx) * c + first));
                    }
                }
            }
            store(&mut out[first..], skip, &sum, accum);
        }
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
    let (window, [height, width], c) = (*window, window.out(), g.cols);
    let [kh, kw] = window.kernel;
    assert!(x.rows == window.pixels() && g.rows == window.batch * height * width, "depthwise: rows of the images");
    assert!(x.cols == c && dw.len() == kh * kw * c, "depthwise: {c} channels");
    if dw.is_empty() {
        return;
    }
    let rows = window.batch * height;
    let tile = if tile > 0 { tile } else { rows.div_ceil(16).max(band(width * c * kh * kw) / 2).max(1) };
    let sums = parallel::map(rows.div_ceil(tile), 2 * g.rows * c * kh * kw, |i| {
        Tensor::build([kh * kw, c], |dw| {
            dw.fill(T::ZERO);
            simd::dispatch(
                #[inline(always)]
                || {
                    for at in i * tile..((i + 1) * tile).min(rows) {
                        match c {
                            WIDE.. => weight_row::<T, WIDE>(&window, [height, width], at, x, g, dw),
                            NARROW.. => weight_row::<T, NARROW>(&window, [height, width], at, x, g, dw),
                            _ => weight_row::<T, 1>(&window, [height, width], at, x, g, dw),
                        }
                    }
                },
            );
        })
    });
    sum_into(dw, accum, &sums);
}

/// What one row of the output adds to the weight's gradient.
#[inline(always)]
fn weight_row<T: Float, const L: usize>(
    window: &Window,
    [height, width]: [usize; 2],
    at: usize,
    x: Rows<T>,
    g: Rows<T>,
    dw: &mut [T],
) {
    let (image, row) = (at / height, at % height);
    let [kh, kw] = window.kernel;
    let (ky_from, ky_to) = window.taps(row, window.height, kh);
    let g = &g.data[at * width * g.row_stride..].chunks(g.row_stride);
    for (first, skip) in blocks::<L>(x.cols) {
        for ky in ky_from..ky_to {
            let pixel = (image * window.height + row * window.stride + ky - window.padding) * window.width;
            let x = Rows { data: &x.data[pixel * x.row_stride + first..], ..x };
            let dw = &mut dw[ky * kw * x.cols + first..];
            let g = g.clone().take(width).map(|g| load::<T, L>(g, first));
            match (L, kw, window.stride) {
                (WIDE | NARROW, 3, 1) => weight_taps::<T, L, 3, 1>(window, width, x, g, skip, dw),
                (WIDE | NARROW, 3, 2) => weight_taps::<T, L, 3, 2>(window, width, x, g, skip, dw),
                (WIDE | NARROW, 5, 1) => weight_taps::<T, L, 5, 1>(window, width, x, g, skip, dw),
                (WIDE | NARROW, 7, 1) => weight_taps::<T, L, 7, 1>(window, width, x, g, skip, dw),
                _ => g.enumerate().for_each(|(ox, g)| weight_pixel(window, ox, x, g, skip, dw)),
            }
        }
    }
}

/// A row of taps over a row of the output: one sum in registers for each tap.
#[inline(always)]
fn weight_taps<'a, T: Float, const L: usize, const K: usize, const S: usize>(
    window: &Window,
    width: usize,
    x: Rows<T>,
    g: impl Iterator<Item = &'a [T; L]>,
    skip: usize,
    dw: &mut [T],
) {
    let (from, to) = window.interior(width);
    let mut sums = [[T::ZERO; L]; K];
    let mut g = g.enumerate();
    for (ox, g) in g.by_ref().take(from) {
        weight_pixel(window, ox, x, g, skip, dw);
    }
    for (ox, g) in g.by_ref().take(to - from) {
        let x_row = &x.data[(ox * S - window.padding) * x.row_stride..];
        for (kx, sum) in sums.iter_mut().enumerate() {
            fma(sum, load(x_row, kx * x.row_stride), g);
        }
    }
    for (ox, g) in g {
        weight_pixel(window, ox, x, g, skip, dw);
    }
    for (kx, sum) in sums.iter().enumerate() {
        store(&mut dw[kx * x.cols..], skip, sum, Accum::Add);
    }
}

/// A row of taps at one position of the window, those that meet the image.
#[inline(always)]
fn weight_pixel<T: Float, const L: usize>(
    window: &Window,
    ox: usize,
    x: Rows<T>,
    g: &[T; L],
    skip: usize,
    dw: &mut [T],
) {
    let (from, to) = window.taps(ox, window.width, window.kernel[1]);
    for kx in from..to {
        let x_at = load::<T, L>(x.data, (ox * window.stride + kx - window.padding) * x.row_stride);
        let dw = &mut dw[kx * x.cols..][..L];
        dw.iter_mut().zip(x_at.iter().zip(g)).skip(skip).for_each(|(d, (&x, &g))| *d = x.mul_add(g, *d));
    }
}

/// The first channel of each block, and how many of its channels the block before has done already.
#[inline(always)]
fn blocks<const L: usize>(c: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..c).step_by(L).map(move |from| {
        let first = from.min(c - L);
        (first, from - first)
    })
}

#[inline(always)]
fn load<T, const L: usize>(x: &[T], at: usize) -> &[T; L] {
    x[at..].first_chunk().expect("a block of channels")
}

#[inline(always)]
fn fma<T: Float, const L: usize>(sum: &mut [T; L], a: &[T; L], b: &[T; L]) {
    for ((s, &a), &b) in sum.iter_mut().zip(a).zip(b) {
        *s = a.mul_add(b, *s);
    }
}

/// Writes a block but for its first `skip` channels.
#[inline(always)]
fn store<T: Float, const L: usize>(out: &mut [T], skip: usize, block: &[T; L], accum: Accum) {
    let out: &mut [T; L] = out.first_chunk_mut().expect("a block of channels");
    match (accum, skip) {
        (Accum::Replace, 0) => *out = *block,
        (Accum::Add, 0) => out.iter_mut().zip(block).for_each(|(o, &b)| *o += b),
        (Accum::Replace, _) => out.iter_mut().zip(block).skip(skip).for_each(|(o, &b)| *o = b),
        (Accum::Add, _) => out.iter_mut().zip(block).skip(skip).for_each(|(o, &b)| *o += b),
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
