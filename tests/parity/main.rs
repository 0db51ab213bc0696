//! Against numbers from an independent PyTorch implementation of the same network.

mod pico;
mod published;
