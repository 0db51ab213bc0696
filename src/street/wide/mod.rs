//! `street-2`: a wider world than the embedded street's, for networks that are to see real pictures.
//!
//! Every sequence draws a kind of road (residential, city, country, motorway), a camera and a light of its own. It is made
//! of the same solids and rendered by the same code; `street-1`, the embedded street, stays as it is. `build` lays the
//! sequence out, `vehicles`, `roadside` and `people` make what stands and drives there, `look` says what it looks like,
//! `ride` how the camera moves.

mod build;
mod look;
mod people;
mod ride;
mod roadside;
mod vehicles;

pub(crate) use build::wide_street;
pub(crate) use look::Look;
pub(crate) use ride::{camera, ride};

#[cfg(test)]
mod tests;
