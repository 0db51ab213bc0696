//! An image in parts: what concatenation along the channels would copy together, read where it lies.

use super::geometry::Geometry;
use crate::tensor::Float;
use crate::tensor::pool::Buffer;
use crate::tensor::simd::copy_run;

/// Some channels of an image of the batch, `[batch, height, width, channels]`.
#[derive(Clone, Copy)]
pub(in crate::ops) struct Part<'a, T> {
    pub(in crate::ops) data: &'a [T],
    pub(in crate::ops) channels: usize,
}

/// An image in one piece.
pub(in crate::ops) fn whole<'a, T>(g: &Geometry, data: &'a [T]) -> [Part<'a, T>; 1] {
    [Part { data, channels: g.channels }]
}

/// Copies `pixels` pixels from pixel `first` of all the parts to `out`, their channels side by side.
#[inline(always)]
pub(super) fn copy_pixels<T: Float>(out: &mut [T], parts: &[Part<T>], first: usize, pixels: usize) {
    if let [part] = parts {
        let c = part.channels;
        return copy_run(&mut out[..pixels * c], &part.data[first * c..(first + pixels) * c]);
    }
    let channels: usize = parts.iter().map(|part| part.channels).sum();
    let mut from = 0;
    for &Part { data, channels: c } in parts.iter().filter(|part| part.channels > 0) {
        let pixels = data[first * c..(first + pixels) * c].chunks_exact(c);
        for (out, pixel) in out.chunks_exact_mut(channels).zip(pixels) {
            copy_run(&mut out[from..from + c], pixel);
        }
        from += c;
    }
}

/// The image in one piece, copied if it is in several: for the paths that cannot do without.
pub(super) fn in_one_piece<'a, T: Float>(
    g: &Geometry,
    parts: &[Part<'a, T>],
    room: &'a mut Option<Buffer<T>>,
) -> &'a [T] {
    if let [part] = parts {
        return part.data;
    }
    let pixels = g.batch * g.size[0] * g.size[1];
    let room = room.insert(Buffer::stale(pixels * g.channels));
    T::dispatch(
        #[inline(always)]
        || copy_pixels(room, parts, 0, pixels),
    );
    room
}
