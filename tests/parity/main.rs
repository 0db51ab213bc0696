//! Against numbers from an independent PyTorch implementation of the same network.

mod ops;
mod pico;
mod published;
mod reference;
