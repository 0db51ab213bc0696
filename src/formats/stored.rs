//! Tensors as they lie in a file, whatever its format: a shape and strides over bytes whose numbers are taken out when
//! they are asked for.

use std::ops::Range;
use std::sync::Arc;

/// The kind of numbers a tensor is stored as.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Dtype {
    /// 64-bit floating point, `torch.float64`.
    F64,
    /// 32-bit floating point, `torch.float32`.
    F32,
    /// 16-bit floating point with 5 bits of exponent, `torch.float16`.
    F16,
    /// 16-bit floating point with 8 bits of exponent, `torch.bfloat16`.
    BF16,
    /// Signed, 64 bits.
    I64,
    /// Signed, 32 bits.
    I32,
    /// Signed, 16 bits.
    I16,
    /// Signed, 8 bits.
    I8,
    /// Unsigned, 8 bits.
    U8,
    /// A byte that is 0 or 1.
    Bool,
}

impl Dtype {
    /// The bytes of one number.
    pub fn size(self) -> usize {
        match self {
            Dtype::F64 | Dtype::I64 => 8,
            Dtype::F32 | Dtype::I32 => 4,
            Dtype::F16 | Dtype::BF16 | Dtype::I16 => 2,
            Dtype::I8 | Dtype::U8 | Dtype::Bool => 1,
        }
    }

    /// Whether this is floating point.
    pub fn is_float(self) -> bool {
        matches!(self, Dtype::F64 | Dtype::F32 | Dtype::F16 | Dtype::BF16)
    }

    /// PyTorch's name, `float32` for example.
    pub fn name(self) -> &'static str {
        match self {
            Dtype::F64 => "float64",
            Dtype::F32 => "float32",
            Dtype::F16 => "float16",
            Dtype::BF16 => "bfloat16",
            Dtype::I64 => "int64",
            Dtype::I32 => "int32",
            Dtype::I16 => "int16",
            Dtype::I8 => "int8",
            Dtype::U8 => "uint8",
            Dtype::Bool => "bool",
        }
    }
}

/// The numbers that one or more tensors share: a part of the file, or what was unpacked from it. Little-endian.
#[derive(Clone)]
pub(crate) struct Storage {
    pub bytes: Arc<Vec<u8>>,
    pub range: Range<usize>,
}

impl Storage {
    fn get(&self) -> &[u8] {
        self.bytes.get(self.range.clone()).unwrap_or(&[])
    }
}

/// A tensor of a file: a shape and strides over numbers in the file.
///
/// It costs nothing until its numbers are asked for; compare [`StoredTensor::shape`] with what is expected before that.
#[derive(Clone)]
pub struct StoredTensor {
    storage: Storage,
    dtype: Dtype,
    offset: usize,
    shape: Vec<usize>,
    strides: Vec<usize>,
}

impl std::fmt::Debug for StoredTensor {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}{:?}", self.dtype.name(), self.shape)
    }
}

impl StoredTensor {
    /// A view that the reader has checked against the storage's length.
    pub(crate) fn new(storage: Storage, dtype: Dtype, offset: usize, shape: Vec<usize>, strides: Vec<usize>) -> Self {
        StoredTensor { storage, dtype, offset, shape, strides }
    }

    /// Numbers in row-major order over a part of `bytes`; `None` unless that part has the length that `shape` needs.
    pub(crate) fn contiguous(
        bytes: &Arc<Vec<u8>>,
        range: Range<usize>,
        dtype: Dtype,
        shape: Vec<usize>,
    ) -> Option<Self> {
        let needed = shape.iter().try_fold(dtype.size(), |n, &d| n.checked_mul(d))?;
        if range.end > bytes.len() || range.end.checked_sub(range.start)? != needed {
            return None;
        }
        let mut strides = vec![1_usize; shape.len()];
        for axis in (1..shape.len()).rev() {
            strides[axis - 1] = strides[axis].saturating_mul(shape[axis].max(1));
        }
        let storage = Storage { bytes: Arc::clone(bytes), range };
        Some(StoredTensor { storage, dtype, offset: 0, shape, strides })
    }

    /// The same numbers with the dimensions in the opposite order.
    pub(crate) fn transposed(mut self) -> Self {
        self.shape.reverse();
        self.strides.reverse();
        self
    }

    /// The first number as often as this shape has elements.
    #[cfg(test)]
    pub(crate) fn spread(mut self, shape: Vec<usize>) -> Self {
        self.strides = vec![0; shape.len()];
        self.shape = shape;
        self
    }

    /// A tensor as if it had been read: these numbers, in row-major order.
    ///
    /// # Panics
    /// If `shape` asks for another number of them.
    pub fn of_f64(shape: &[usize], numbers: &[f64]) -> Self {
        let bytes: Vec<u8> = numbers.iter().flat_map(|x| x.to_le_bytes()).collect();
        let range = 0..bytes.len();
        Self::contiguous(&Arc::new(bytes), range, Dtype::F64, shape.to_vec())
            .unwrap_or_else(|| panic!("of_f64: {} numbers for the shape {shape:?}", numbers.len()))
    }

    /// How the numbers are stored.
    pub fn dtype(&self) -> Dtype {
        self.dtype
    }

    /// The dimensions, outermost first; none for a single number.
    pub fn shape(&self) -> &[usize] {
        &self.shape
    }

    /// The number of elements. The reader has checked that it does not overflow.
    pub fn len(&self) -> usize {
        self.shape.iter().product()
    }

    /// Whether there are no elements.
    pub fn is_empty(&self) -> bool {
        self.shape.contains(&0)
    }

    /// The bytes of all the elements.
    pub(crate) fn byte_len(&self) -> usize {
        self.len().saturating_mul(self.dtype.size())
    }

    /// The numbers in row-major order as f32, f64 rounded to nearest; `None` for integers and booleans.
    pub fn to_f32(&self) -> Option<Vec<f32>> {
        Some(match self.dtype {
            Dtype::F32 => self.gather(f32::from_le_bytes),
            Dtype::F64 => self.gather(|b| f64::from_le_bytes(b) as f32),
            Dtype::F16 => self.gather(|b| half_to_f32(u16::from_le_bytes(b))),
            Dtype::BF16 => self.gather(|b| bfloat16_to_f32(u16::from_le_bytes(b))),
            _ => return None,
        })
    }

    /// The numbers in row-major order as f64, exactly as stored; `None` for integers and booleans.
    pub fn to_f64(&self) -> Option<Vec<f64>> {
        Some(match self.dtype {
            Dtype::F64 => self.gather(f64::from_le_bytes),
            Dtype::F32 => self.gather(|b| f64::from(f32::from_le_bytes(b))),
            Dtype::F16 => self.gather(|b| f64::from(half_to_f32(u16::from_le_bytes(b)))),
            Dtype::BF16 => self.gather(|b| f64::from(bfloat16_to_f32(u16::from_le_bytes(b)))),
            _ => return None,
        })
    }

    /// Integers (`num_batches_tracked`) and booleans in row-major order; `None` for floating point.
    pub fn to_i64(&self) -> Option<Vec<i64>> {
        Some(match self.dtype {
            Dtype::I64 => self.gather(i64::from_le_bytes),
            Dtype::I32 => self.gather(|b| i64::from(i32::from_le_bytes(b))),
            Dtype::I16 => self.gather(|b| i64::from(i16::from_le_bytes(b))),
            Dtype::I8 => self.gather(|b| i64::from(i8::from_le_bytes(b))),
            Dtype::U8 => self.gather(|[b]: [u8; 1]| i64::from(b)),
            Dtype::Bool => self.gather(|[b]: [u8; 1]| i64::from(b != 0)),
            _ => return None,
        })
    }

    /// The one number of an integer tensor with one element.
    pub fn as_i64(&self) -> Option<i64> {
        if self.len() != 1 {
            return None;
        }
        self.to_i64()?.first().copied()
    }

    /// The elements' bytes in row-major order.
    #[cfg(test)]
    pub(crate) fn raw_bytes(&self) -> Vec<u8> {
        match self.dtype.size() {
            8 => self.gather(|b: [u8; 8]| b).concat(),
            4 => self.gather(|b: [u8; 4]| b).concat(),
            2 => self.gather(|b: [u8; 2]| b).concat(),
            _ => self.gather(|b: [u8; 1]| b).concat(),
        }
    }

    /// The elements in row-major order. `N` is the element's size.
    fn gather<const N: usize, T>(&self, decode: impl Fn([u8; N]) -> T) -> Vec<T> {
        if self.is_empty() {
            return Vec::new();
        }
        let (numbers, _) = self.storage.get().as_chunks::<N>();
        let numbers = numbers.get(self.offset..).unwrap_or(&[]);
        if self.is_contiguous() {
            return numbers.iter().take(self.len()).map(|b| decode(*b)).collect();
        }
        let mut out = Vec::with_capacity(self.len());
        let mut index = vec![0; self.shape.len()];
        let mut at = 0;
        loop {
            // The reader has checked that the last element is inside.
            out.extend(numbers.get(at).map(|b| decode(*b)));
            // The next index, as an odometer counts.
            let mut axis = self.shape.len();
            loop {
                if axis == 0 {
                    return out;
                }
                axis -= 1;
                index[axis] += 1;
                at += self.strides[axis];
                if index[axis] < self.shape[axis] {
                    break;
                }
                at -= self.strides[axis] * self.shape[axis];
                index[axis] = 0;
            }
        }
    }

    /// Whether the elements follow each other in row-major order. A dimension of 1 may have any stride.
    fn is_contiguous(&self) -> bool {
        let mut expected = 1;
        for (&n, &stride) in self.shape.iter().zip(&self.strides).rev() {
            if n != 1 && stride != expected {
                return false;
            }
            expected *= n;
        }
        true
    }
}

/// IEEE half precision; every value is exact in f32, and the payload of a NaN is kept.
fn half_to_f32(bits: u16) -> f32 {
    let sign = u32::from(bits & 0x8000) << 16;
    let exponent = u32::from(bits >> 10 & 0x1f);
    let mantissa = u32::from(bits & 0x3ff);
    match exponent {
        // Zero and the subnormals: mantissa * 2^-24.
        0 => {
            let magnitude = mantissa as f32 / 16_777_216.0;
            f32::from_bits(sign | magnitude.to_bits())
        }
        0x1f => f32::from_bits(sign | 0x7f80_0000 | mantissa << 13),
        _ => f32::from_bits(sign | (exponent + 127 - 15) << 23 | mantissa << 13),
    }
}

/// bfloat16 is the upper half of an f32.
fn bfloat16_to_f32(bits: u16) -> f32 {
    f32::from_bits(u32::from(bits) << 16)
}
