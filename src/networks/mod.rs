//! The depth networks of the paper's tables, each an encoder and a decoder by name, and the pose network beside them.
//!
//! | | what it is | file |
//! |---|---|---|
//! | network `monovit` | nested decoder with channel attention (Zhao et al., 2208.03543) | `nested.rs`, [`crate::monovit::decoder`] |
//! | network `monodepth2` | U-Net decoder (Godard et al., 1806.01260) | [`monodepth2`] |
//! | encoder `mpvit` | MPViT, of a size for each preset (Lee et al., 2112.11010) | `mpvit.rs`, [`crate::monovit::encoder`] |
//! | encoders `resnet18`, `resnet34`, `resnet50` | residual networks (He et al., 1512.03385) | [`resnet`] |
//!
//! An [`Encoder`] turns a picture into maps, a [`Decoder`] maps into disparities at four scales; any pair that fits is an
//! [`Architecture`], and a [`DepthNetwork`] is made of its [`Config`]. What there is stands in `registry.rs`: a new encoder
//! or decoder is one file here and one line there.

mod architecture;
mod config;
mod decoder;
mod encoder;
mod model;
pub mod monodepth2;
mod mpvit;
mod nested;
mod registry;
pub mod resnet;
pub mod setup;

pub use architecture::Architecture;
pub use config::Config;
pub use decoder::{Decoder, Pyramid};
pub use encoder::{Encoder, FeatureMap, InputNorm};
pub use model::DepthNetwork;
pub use nested::Nested;
pub use registry::{AnyDecoder, AnyEncoder, DecoderConfig, EncoderConfig, EncoderKind, Network};
pub use setup::Setup;
