//! The kernels: convolution of each channel with its own window, over channels that lie side by side.
//!
//! They work on [`Rows`], one row a pixel, so that a range of channels of a wider tensor (the values among queries,
//! keys and values) is convolved where it lies. Channels go in blocks of one vector register; the last block overlaps
//! the one before it where the count is no multiple, and only its new channels are written.

use std::ops::Range;

use pulp::{Simd, WithSimd};

use crate::ops::Tile;
use crate::ops::support::sums::sum_into;
use crate::tensor::gemm::{Rows, RowsMut};
use crate::tensor::pool::Buffer;
use crate::tensor::{Accum, Float, Tensor, parallel};

/// Kernel path: the windows whose size is known to the compiler, and any other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Path {
    ThreeByThree,
    ThreeByThreeStrided,
    FiveByFive,
    SevenBySeven,
    Any,
}

impl Path {
    /// The one place where it is chosen.
    pub fn of(kernel: [usize; 2], stride: usize) -> Self {
        match (kernel, stride) {
            ([3, 3], 1) => Path::ThreeByThree,
            ([3, 3], 2) => Path::ThreeByThreeStrided,
            ([5, 5], 1) => Path::FiveByFive,
            ([7, 7], 1) => Path::SevenBySeven,
            _ => Path::Any,
        }
    }
}

/// The images and the window that is moved over them. Pixels outside the image are 0.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Window {
    /// Number of images.
    pub batch: usize,
    /// Height of the input.
    pub height: usize,
    /// Width of the input.
    pub width: usize,
    /// Height and width of the window.
    pub kernel: [usize; 2],
    /// Stride: pixels from one window to the next.
    pub stride: usize,
    /// Zero padding: rows and columns added on each side.
    pub padding: usize,
}

impl Window {
    /// Height and width of the output; `None` if the window does not fit.
    pub fn output(&self) -> Option<[usize; 2]> {
        let extent = |n: usize, k: usize| Some((n + 2 * self.padding).checked_sub(k)?.checked_div(self.stride)? + 1);
        Some([extent(self.height, self.kernel[0])?, extent(self.width, self.kernel[1])?])
    }

    fn path(&self) -> Path {
        Path::of(self.kernel, self.stride)
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
/// `tile`: rows of the output handed to a thread at a time, `done` is called with each of them.
pub(crate) fn forward<T: Float>(
    window: &Window,
    x: Rows<T>,
    (w, bias): (&[T], Option<&[T]>),
    y: RowsMut<T>,
    accum: Accum,
    tile: Tile,
    done: &(dyn Fn(&mut [T]) + Sync),
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
    let tile = tile.or(band(width * c * taps));
    parallel::for_each_chunk(y.data, tile * width * stride, 2 * y.rows * c * taps, |i, out| {
        let pass = Pass { window: *window, height, width, first_row: i * tile, w };
        T::dispatch_vector(Convolve { pass, x, bias, out: &mut *out, stride, accum });
        done(out);
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
            if x.cols < T::lanes::<S>() {
                line.block(simd, Block::<true> { first: 0, end: x.cols, skip: 0 }, out);
                continue;
            }
            for block in blocks(x.cols, T::lanes::<S>()) {
                line.block(simd, block, out);
            }
        }
    }
}

/// A block of channels: those of a vector, or (`PART`) all there are, fewer than that.
#[derive(Clone, Copy)]
struct Block<const PART: bool> {
    first: usize,
    end: usize,
    /// How many of its channels the block before has done already.
    skip: usize,
}

/// The most elements in a vector.
const MAX_LANES: usize = 16;
/// The most pixels loaded for a tile: `(TILE - 1) * 2 + 3` or `TILE - 1 + 7`.
const SPAN: usize = 10;

/// The blocks of `c` channels, at least a vector of them.
#[inline(always)]
fn blocks(c: usize, lanes: usize) -> impl Iterator<Item = Block<false>> {
    (0..c).step_by(lanes).map(move |from| {
        let first = from.min(c - lanes);
        Block { first, end: first + lanes, skip: from - first }
    })
}

impl<const PART: bool> Block<PART> {
    /// The block of the pixel or tap that begins at `at`.
    #[inline(always)]
    fn load<T: Float, S: Simd>(self, simd: S, x: &[T], at: usize) -> T::V<S> {
        let x = &x[at + self.first..];
        if PART { T::load_part(simd, &x[..self.end]) } else { T::load(simd, x) }
    }

    /// The block of the first `count` pixels, `step` apart.
    #[inline(always)]
    fn load_row<T: Float, S: Simd>(self, simd: S, x: &[T], count: usize, step: usize) -> [T::V<S>; SPAN] {
        let mut row = [T::splat(simd, T::ZERO); SPAN];
        let mut x = &x[self.first..];
        for v in &mut row[..count] {
            *v = if PART { T::load_part(simd, &x[..self.end]) } else { T::load(simd, x) };
            // Only the last pixel of a tensor has nothing after it.
            x = x.get(step..).unwrap_or_default();
        }
        row
    }

    #[inline(always)]
    fn store<T: Float, S: Simd>(self, simd: S, out: &mut [T], at: usize, v: T::V<S>, accum: Accum) {
        let v = match accum {
            Accum::Replace => v,
            Accum::Add => T::vector_add(simd, self.load(simd, out, at), v),
        };
        let out = &mut out[at + self.first..];
        if PART {
            T::store_part(simd, &mut out[..self.end], v);
        } else if self.skip == 0 {
            T::store(simd, out, v);
        } else {
            let mut block = [T::ZERO; MAX_LANES];
            T::store(simd, &mut block, v);
            let new = self.skip..self.end - self.first;
            out[new.clone()].iter_mut().zip(&block[new]).for_each(|(o, &b)| *o = b);
        }
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
        match self.pass.window.path() {
            Path::ThreeByThree => self.tiles::<S, PART, 3, 1>(simd, block, out),
            Path::ThreeByThreeStrided => self.tiles::<S, PART, 3, 2>(simd, block, out),
            Path::FiveByFive => self.tiles::<S, PART, 5, 1>(simd, block, out),
            Path::SevenBySeven => self.tiles::<S, PART, 7, 1>(simd, block, out),
            Path::Any => self.singles(simd, block, out, 0, self.pass.width),
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
            let x = block.load_row(simd, &self.x.data[pixel * step..], (TILE - 1) * STRIDE + K, step);
            let w = &self.pass.w[ky * K * c..(ky + 1) * K * c];
            for kx in 0..K {
                let w = block.load(simd, w, kx * c);
                for (p, sum) in sums.iter_mut().enumerate() {
                    *sum = T::fma(simd, x[p * STRIDE + kx], w, *sum);
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
/// `tile`: rows of the input handed to a thread at a time.
pub(crate) fn input_gradient<T: Float>(window: &Window, g: Rows<T>, w: &[T], dx: RowsMut<T>, accum: Accum, tile: Tile) {
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
        return forward(&window, g, (&turned, None), dx, accum, tile, &|_| ());
    }
    let tile = tile.or(band(window.width * c * kh * kw));
    parallel::for_each_chunk(dx.data, tile * window.width * stride, 2 * g.rows * c * kh * kw, |i, out| {
        let pass = Pass { window: *window, height, width, first_row: i * tile, w };
        T::dispatch_vector(Gather { pass, g, out, stride, accum });
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
        let (c, window) = (g.cols, pass.window);
        for (i, out) in out.chunks_mut(window.width * stride).enumerate() {
            let at = pass.first_row + i;
            let (image, y) = (at / window.height, at % window.height + window.padding);
            let line = GatherLine { pass, g, image, y, stride, accum };
            if c < T::lanes::<S>() {
                line.block(simd, Block::<true> { first: 0, end: c, skip: 0 }, out);
                continue;
            }
            for block in blocks(c, T::lanes::<S>()) {
                line.block(simd, block, out);
            }
        }
    }
}

/// One row of the input's gradient: row `y`, counted with the padding.
#[derive(Clone, Copy)]
struct GatherLine<'a, T> {
    pass: Pass<'a, T>,
    g: Rows<'a, T>,
    image: usize,
    y: usize,
    stride: usize,
    accum: Accum,
}

impl<T: Float> GatherLine<'_, T> {
    /// One block of channels of the row.
    #[inline(always)]
    fn block<S: Simd, const PART: bool>(&self, simd: S, block: Block<PART>, out: &mut [T]) {
        let (window, width) = (self.pass.window, self.pass.window.width);
        let (mut from, mut to) = (0, 0);
        if window.path() == Path::ThreeByThreeStrided {
            // Columns 2m and 2m + 1, counted with the padding, of those m where outputs m and m - 1 both exist.
            let first = window.padding.div_ceil(2).max(1);
            let last = ((width + window.padding) / 2).min(self.pass.width).max(first);
            (from, to) = (2 * first - window.padding, 2 * last - window.padding);
            let (row, lines) = (self.y / 2, [self.y / 2, (self.y / 2).wrapping_sub(1)]);
            match (self.y % 2, lines.map(|line| line < self.pass.height)) {
                (1, [true, _]) => self.pairs(simd, block, out, [(row, 1)], first, last),
                (0, [true, true]) => self.pairs(simd, block, out, [(row, 0), (row - 1, 2)], first, last),
                (0, [true, false]) => self.pairs(simd, block, out, [(row, 0)], first, last),
                (0, [false, true]) => self.pairs(simd, block, out, [(row - 1, 2)], first, last),
                _ => self.pairs(simd, block, out, [], first, last),
            }
        }
        for ix in (0..from.min(width)).chain(to..width) {
            let sum = self.pixel(simd, block, ix + window.padding);
            block.store(simd, out, ix * self.stride, sum, self.accum);
        }
    }

    /// A window of 3 x 3 with stride 2: of each pair of columns the even one meets the outer taps of two outputs, the
    /// odd one the middle tap of one. `rows`: the rows of the output that meet this one, each with its row of taps.
    #[inline(always)]
    fn pairs<S: Simd, const PART: bool, const R: usize>(
        &self,
        simd: S,
        block: Block<PART>,
        out: &mut [T],
        rows: [(usize, usize); R],
        first: usize,
        last: usize,
    ) {
        let (c, step) = (self.g.cols, self.g.row_stride);
        let taps = rows.map(|(_, ky)| [0, 1, 2].map(|kx| block.load(simd, self.pass.w, (ky * 3 + kx) * c)));
        let lines = rows.map(|(oy, _)| (self.image * self.pass.height + oy) * self.pass.width);
        let load = |line: usize, ox: usize| block.load(simd, self.g.data, (line + ox) * step);
        let mut before = lines.map(|line| if first < last { load(line, first - 1) } else { T::splat(simd, T::ZERO) });
        for m in first..last {
            let mut sums = [T::splat(simd, T::ZERO); 2];
            for ((&line, before), w) in lines.iter().zip(&mut before).zip(&taps) {
                let here = load(line, m);
                sums[0] = T::fma(simd, *before, w[2], T::fma(simd, here, w[0], sums[0]));
                sums[1] = T::fma(simd, here, w[1], sums[1]);
                *before = here;
            }
            let at = (2 * m - self.pass.window.padding) * self.stride;
            block.store(simd, out, at, sums[0], self.accum);
            block.store(simd, out, at + self.stride, sums[1], self.accum);
        }
    }

    /// The gradient of the pixel in column `x`, counted with the padding. Tap k of output o reads pixel o stride + k:
    /// every stride-th tap meets this one.
    #[inline(always)]
    fn pixel<S: Simd, const PART: bool>(&self, simd: S, block: Block<PART>, x: usize) -> T::V<S> {
        let Pass { window: Window { stride, kernel: [kh, kw], .. }, height, width, w, .. } = self.pass;
        let mut sum = T::splat(simd, T::ZERO);
        for (back, ky) in (self.y % stride..kh).step_by(stride).enumerate() {
            // Below 0 this wraps to beyond the height, and stays out; so for the columns.
            let oy = (self.y / stride).wrapping_sub(back);
            if oy >= height {
                continue;
            }
            for (back, kx) in (x % stride..kw).step_by(stride).enumerate() {
                let ox = (x / stride).wrapping_sub(back);
                if ox < width {
                    let at = (self.image * height + oy) * width + ox;
                    let g = block.load(simd, self.g.data, at * self.g.row_stride);
                    sum = T::fma(simd, g, block.load(simd, w, (ky * kw + kx) * self.g.cols), sum);
                }
            }
        }
        sum
    }
}

/// `dw = ` the gradient of the weight, or `dw += ...`, in a fixed number of partial sums over bands of rows, added up
/// in order: the same bits for any number of threads.
///
/// `tile`: rows of the output in a partial sum.
pub(crate) fn weight_gradient<T: Float>(
    window: &Window,
    x: Rows<T>,
    g: Rows<T>,
    dw: &mut [T],
    accum: Accum,
    tile: Tile,
) {
    let ([height, width], c) = (window.out(), g.cols);
    let [kh, kw] = window.kernel;
    assert!(x.rows == window.pixels() && g.rows == window.batch * height * width, "depthwise: rows of the images");
    assert!(x.cols == c && dw.len() == kh * kw * c, "depthwise: {c} channels");
    if dw.is_empty() {
        return;
    }
    let rows = window.batch * height;
    let tile = tile.or(rows.div_ceil(16).max(band(width * c * kh * kw) / 4).max(1));
    let sums = parallel::map(rows.div_ceil(tile), 2 * g.rows * c * kh * kw, |i| {
        Tensor::build([kh * kw, c], |dw| {
            dw.fill(T::ZERO);
            let pass = Pass { window: *window, height, width, first_row: i * tile, w: &[] };
            T::dispatch_vector(Weigh { pass, rows: tile.min(rows - i * tile), x, g, dw });
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
        let c = self.x.cols;
        for at in self.pass.first_row..self.pass.first_row + self.rows {
            if c < T::lanes::<S>() {
                self.row(simd, Block::<true> { first: 0, end: c, skip: 0 }, at);
                continue;
            }
            for block in blocks(c, T::lanes::<S>()) {
                self.row(simd, block, at);
            }
        }
    }
}

impl<T: Float> Weigh<'_, T> {
    /// One block of channels of one row.
    #[inline(always)]
    fn row<S: Simd, const PART: bool>(&mut self, simd: S, block: Block<PART>, at: usize) {
        let Window { stride, kernel: [kh, _], height, width, padding, .. } = self.pass.window;
        let (image, row) = (at / self.pass.height, at % self.pass.height);
        let (ky_from, ky_to) = self.pass.window.taps(row, height, kh);
        let line = |ky: usize| (image * height + row * stride + ky - padding) * width;
        // All nine taps at once where they meet the image: three sums alone would wait for one another.
        let path = self.pass.window.path();
        let square = matches!(path, Path::ThreeByThree | Path::ThreeByThreeStrided);
        let rows = if square && (ky_from, ky_to) == (0, 3) { 3 } else { 1 };
        for ky in (ky_from..ky_to).step_by(rows) {
            let tiled = match (path, rows) {
                (Path::ThreeByThree, 3) => self.taps::<S, PART, 3, 3, 1>(simd, block, at, ky, [0, 1, 2].map(line)),
                (Path::ThreeByThreeStrided, 3) => {
                    self.taps::<S, PART, 3, 3, 2>(simd, block, at, ky, [0, 1, 2].map(line))
                }
                (Path::ThreeByThree, _) => self.taps::<S, PART, 1, 3, 1>(simd, block, at, ky, [line(ky)]),
                (Path::ThreeByThreeStrided, _) => self.taps::<S, PART, 1, 3, 2>(simd, block, at, ky, [line(ky)]),
                (Path::FiveByFive, _) => self.taps::<S, PART, 1, 5, 1>(simd, block, at, ky, [line(ky)]),
                (Path::SevenBySeven, _) => self.taps::<S, PART, 1, 7, 1>(simd, block, at, ky, [line(ky)]),
                (Path::Any, _) => 0..0,
            };
            // What the tiles leave: the borders, or everything.
            for ky in ky..ky + rows {
                for columns in [0..tiled.start, tiled.end..self.pass.width] {
                    self.singles(simd, block, at, ky, line(ky), columns);
                }
            }
        }
    }

    /// `R` rows of taps from `ky` on over a row of the output, one sum in a register for each tap; `lines` are the
    /// first pixels of the rows of x that they meet. Returns the columns of the output that this covers.
    #[inline(always)]
    fn taps<S: Simd, const PART: bool, const R: usize, const K: usize, const STRIDE: usize>(
        &mut self,
        simd: S,
        block: Block<PART>,
        at: usize,
        ky: usize,
        lines: [usize; R],
    ) -> Range<usize> {
        let (c, step, width, padding) = (self.x.cols, self.x.row_stride, self.pass.width, self.pass.window.padding);
        let (from, to) = self.pass.window.interior(width);
        let mut sums = [[T::splat(simd, T::ZERO); K]; R];
        let tiled = from + (to - from) / TILE * TILE;
        for ox in (from..tiled).step_by(TILE) {
            let g_step = self.g.row_stride;
            let g = block.load_row(simd, &self.g.data[(at * width + ox) * g_step..], TILE, g_step);
            for (sums, line) in sums.iter_mut().zip(lines) {
                let x = &self.x.data[(line + ox * STRIDE - padding) * step..];
                let x = block.load_row(simd, x, (TILE - 1) * STRIDE + K, step);
                for p in 0..TILE {
                    for (kx, sum) in sums.iter_mut().enumerate() {
                        *sum = T::fma(simd, x[p * STRIDE + kx], g[p], *sum);
                    }
                }
            }
        }
        for (r, sums) in sums.iter().enumerate() {
            for (kx, &sum) in sums.iter().enumerate() {
                block.store(simd, self.dw, ((ky + r) * K + kx) * c, sum, Accum::Add);
            }
        }
        from..tiled
    }

    /// A row of taps at single outputs, those taps that meet the image.
    #[inline(always)]
    fn singles<S: Simd, const PART: bool>(
        &mut self,
        simd: S,
        block: Block<PART>,
        at: usize,
        ky: usize,
        line: usize,
        columns: Range<usize>,
    ) {
        let Window { stride, kernel: [_, kw], width, padding, .. } = self.pass.window;
        let c = self.x.cols;
        for ox in columns {
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
