//! How a convolution's input, window and output lie.

use super::Conv2d;
use crate::ops::ShapeError;
use crate::ops::Tile;
use crate::tensor::Shape;

/// Padding mode: what a window sees beyond the edge of the image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Beyond {
    /// Zero padding.
    Zero,
    /// Reflection padding, without repeating the edge.
    Mirrored,
    /// Replication padding: the nearest pixel of the edge.
    Nearest,
}

/// Kernel path of a convolution.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Path {
    /// A 1x1 window: one product of matrices.
    Pointwise,
    /// im2col: patches are copied, then multiplied. For groups and for dilations along the row.
    Im2col,
    /// Products that read the image's rows in place.
    Direct,
    /// [`Direct`](Path::Direct), with this many neighbouring outputs of a row computed as one pixel.
    SideBySide(usize),
}

/// Sizes and attributes of a convolution. Pairs are (height, width).
#[derive(Clone, Copy, Debug)]
pub struct Geometry {
    pub(in crate::ops) batch: usize,
    pub(in crate::ops) size: [usize; 2],
    pub(in crate::ops) channels: usize,
    pub(in crate::ops) out: [usize; 2],
    pub(in crate::ops) out_channels: usize,
    pub(in crate::ops) kernel: [usize; 2],
    pub(in crate::ops) stride: [usize; 2],
    pub(in crate::ops) padding: [usize; 2],
    pub(in crate::ops) dilation: [usize; 2],
    pub(in crate::ops) groups: usize,
    pub(in crate::ops) beyond: Beyond,
    pub(in crate::ops) tile: Tile,
}

impl Geometry {
    pub(super) fn new(op: &Conv2d, x: &Shape, w: &Shape) -> Result<Self, ShapeError> {
        let (Some([batch, h, wd, channels]), Some([kh, kw, per_group, out_channels])) = (x.nhwc(), w.nhwc()) else {
            return Err(ShapeError::new("expected x [batch, height, width, in] and w [kh, kw, in / groups, out]"));
        };
        if op.groups == 0 || per_group * op.groups != channels || out_channels % op.groups != 0 {
            return Err(ShapeError::new(format!("{channels} channels in {} groups do not fit the weights", op.groups)));
        }
        let mut out = [0; 2];
        for d in 0..2 {
            let (size, kernel) = ([h, wd][d], [kh, kw][d]);
            if kernel == 0 || op.stride[d] == 0 || op.dilation[d] == 0 {
                return Err(ShapeError::new("window, stride and dilation are at least 1"));
            }
            if op.reflect && op.padding[d] >= size {
                return Err(ShapeError::new(format!(
                    "a padding of {} cannot mirror an extent of {size}",
                    op.padding[d]
                )));
            }
            let reach = op.dilation[d] * (kernel - 1) + 1;
            let room = (size + 2 * op.padding[d]).checked_sub(reach);
            out[d] =
                room.ok_or_else(|| ShapeError::new("the window is larger than the padded image"))? / op.stride[d] + 1;
        }
        Ok(Geometry {
            batch,
            size: [h, wd],
            channels,
            out,
            out_channels,
            kernel: [kh, kw],
            stride: op.stride,
            padding: op.padding,
            dilation: op.dilation,
            groups: op.groups,
            beyond: if op.reflect { Beyond::Mirrored } else { Beyond::Zero },
            tile: op.tile,
        })
    }

    /// The input row or column under window position `k` of output row or column `o`; `None` in zero padding.
    #[inline(always)]
    pub(super) fn source(&self, d: usize, o: usize, k: usize) -> Option<usize> {
        self.padded(d, o * self.stride[d] + k * self.dilation[d])
    }

    /// The input row or column at a position of the padded image; `None` in zero padding.
    #[inline(always)]
    pub(in crate::ops) fn padded(&self, d: usize, at: usize) -> Option<usize> {
        let i = at as isize - self.padding[d] as isize;
        let n = self.size[d] as isize;
        if (0..n).contains(&i) {
            return Some(i as usize);
        }
        match self.beyond {
            Beyond::Zero => None,
            Beyond::Mirrored => Some(if i < 0 { -i } else { 2 * (n - 1) - i } as usize),
            Beyond::Nearest => Some(i.clamp(0, n - 1) as usize),
        }
    }

    /// Output columns whose whole window lies inside the image.
    pub(super) fn inside(&self) -> std::ops::Range<usize> {
        let first = self.padding[1].div_ceil(self.stride[1]);
        let reach = self.dilation[1] * (self.kernel[1] - 1) + 1;
        let last = (self.size[1] + self.padding[1]).checked_sub(reach).map_or(0, |room| room / self.stride[1] + 1);
        first..last.clamp(first, self.out[1].max(first))
    }

    /// Channels of the input that one group sees.
    pub(super) fn group_in(&self) -> usize {
        self.channels / self.groups
    }

    /// Channels of the output that one group makes.
    pub(super) fn group_out(&self) -> usize {
        self.out_channels / self.groups
    }

    /// Numbers in one patch of one group: the columns of the im2col matrix.
    pub(in crate::ops) fn patch(&self) -> usize {
        self.kernel[0] * self.kernel[1] * self.group_in()
    }

    /// Rows of output pixels, over the whole batch.
    pub(in crate::ops) fn rows(&self) -> usize {
        self.batch * self.out[0]
    }

    /// The one place where a path is chosen.
    pub(in crate::ops) fn path(&self) -> Path {
        let pointwise = self.kernel == [1; 2] && self.stride == [1; 2] && self.padding == [0; 2] && self.groups == 1;
        match self.side_by_side() {
            _ if pointwise => Path::Pointwise,
            _ if !self.is_direct() => Path::Im2col,
            1 => Path::Direct,
            s => Path::SideBySide(s),
        }
    }

    /// Whether the windows of neighbouring pixels are runs of one padded row, a step apart.
    pub(in crate::ops) fn is_direct(&self) -> bool {
        self.groups == 1 && self.dilation[1] == 1
    }

    /// Output rows a tile, at least four tiles where there are four rows: an im2col matrix of some 256 KiB; or half of
    /// that in rows of the image, or of the output.
    pub(in crate::ops) fn tile(&self) -> usize {
        let fitting = if self.is_direct() {
            let pixel = (self.channels * self.stride[0] * self.stride[1]).max(self.out_channels);
            (1 << 15) / (pixel * self.out[1]).max(1)
        } else {
            (1 << 16) / (self.patch() * self.out[1]).max(1)
        };
        self.tile.or(fitting.clamp(1, self.rows().div_ceil(4).max(1)))
    }

    /// How many neighbouring outputs of a row are best computed as one pixel with as many times the channels; 1 if each
    /// by itself.
    ///
    /// A product fills vector registers along the output's channels. Where these are few, `s` pixels side by side fill
    /// them better: they share a window that is `s - 1` strides wider, whose weights are zero where a pixel does not
    /// look. That is more arithmetic, but at the full width of the registers.
    fn side_by_side(&self) -> usize {
        if !self.is_direct() || self.kernel[1] == 1 {
            return 1;
        }
        let fits = [1, 2, 4, 8, 16].into_iter().filter(|s| self.out[1].is_multiple_of(*s) && self.out[1] > 0);
        let costs = fits.map(|s| (self.cost(s), s));
        costs.min_by(|a, b| a.0.total_cmp(&b.0)).map_or(1, |(_, s)| s)
    }

    /// Registers of 16 numbers multiplied for an output pixel, for each row and channel of the window, with `s` side by
    /// side.
    fn cost(&self, s: usize) -> f64 {
        let window = self.kernel[1] + (s - 1) * self.stride[1];
        (window * (s * self.out_channels).div_ceil(16)) as f64 / s as f64
    }

    /// The same convolution with `s` outputs of a row as one pixel.
    pub(super) fn widened(&self, s: usize) -> Geometry {
        Geometry {
            out: [self.out[0], self.out[1] / s],
            out_channels: s * self.out_channels,
            kernel: [self.kernel[0], self.kernel[1] + (s - 1) * self.stride[1]],
            stride: [self.stride[0], s * self.stride[1]],
            ..*self
        }
    }

    /// The convolution of dy that gives dx, if it is one: stride 1, and a window that reaches beyond the padding.
    pub(in crate::ops) fn transposed(&self) -> Option<Geometry> {
        let mut padding = [0; 2];
        for (d, p) in padding.iter_mut().enumerate() {
            *p = (self.dilation[d] * (self.kernel[d] - 1)).checked_sub(self.padding[d])?;
        }
        (self.stride == [1; 2]).then_some(Geometry {
            size: self.out,
            channels: self.out_channels,
            out: self.size,
            out_channels: self.channels,
            padding,
            beyond: Beyond::Zero,
            ..*self
        })
    }
}
