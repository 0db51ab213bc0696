//! Against numbers from an independent PyTorch implementation of the same network.

mod networks;
mod ops;
mod pico;
mod published;
mod reference;
