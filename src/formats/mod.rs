//! Files: whole or not at all, never larger in memory than they are, never run.
//!
//! | module | format |
//! |---|---|
//! | [`atomic`] | how every file is written: aside, then renamed |
//! | [`bounded`] | how whole files are read: never more than such a file may have |
//! | [`safetensors`] | named tensors, the crate's own checkpoints |
//! | [`pth`] | named tensors in PyTorch's pickles, read as data |
//! | [`npz`], [`npy`] | NumPy's archives and arrays |
//! | [`picture`] | reading pictures: PNG, JPEG, WebP |
//! | [`exif`] | how a picture's camera was held, and its focal length |
//! | [`png`] | writing them |
//! | [`depth_png`] | depth as KITTI stores it |
//! | [`pfm`] | reading disparity as Middlebury stores it |
//! | [`mat`] | reading an array of a MATLAB 5 file |
//! | [`ply`] | coloured point clouds |
//! | [`tensorboard`] | TensorBoard's event files |
//!
//! [`TensorFile`] opens any file of named tensors.

pub mod atomic;
pub mod bounded;
pub mod depth_png;
pub mod exif;
mod jpeg_scans;
pub mod mat;
pub mod npy;
pub mod npz;
pub mod pfm;
pub mod picture;
mod picture_structure;
pub mod ply;
pub mod png;
pub mod pth;
pub mod safetensors;
mod source;
mod stored;
mod tensor_file;
pub mod tensorboard;

pub use stored::{Dtype, StoredTensor};
pub use tensor_file::TensorFile;
