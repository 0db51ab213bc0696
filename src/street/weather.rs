//! What weather leaves on everything that stands outside: dust that settles and rain that washes it off in places.
//!
//! A plain wall or a car's clean door shows nothing that could be found again in the next picture, so a photometric
//! loss learns no depth from it. Real surfaces are rarely plain; these patches are their dirt, at sizes from some
//! metres to a hand's width.

use super::texture::{Colour, Patch, mix, scale};

const DUST: Colour = [0.52, 0.49, 0.44];
/// Cells a metre and amplitudes.
const PATCHES: [(f32, f32); 5] = [(0.35, 0.7), (0.9, 0.85), (2.2, 0.9), (5.5, 0.85), (13.0, 0.6)];

/// A colour under the dust of its place: paler where it is dark, darker where it is pale.
pub(super) fn weathered(colour: Colour, patch: &Patch, seed: u32) -> Colour {
    let wear = patch.octaves(&PATCHES, seed);
    let worn = scale(colour, (1.0 - 0.9 * wear).max(0.1));
    mix(worn, DUST, (0.15 + 0.8 * wear).clamp(0.0, 0.75))
}

/// A colour under a share `wear` of that dust.
pub(super) fn faintly_weathered(colour: Colour, patch: &Patch, seed: u32, wear: f32) -> Colour {
    if wear <= 0.0 { colour } else { mix(colour, weathered(colour, patch, seed), wear) }
}
