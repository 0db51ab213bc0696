//! Normalisations over a batch or over channels.
//!
//! | op family | idea |
//! |---|---|
//! | [`batch_norm`] | over a batch, and with running statistics |
//! | [`layer_norm`] | over the channels of each token |

pub mod batch_norm;
pub mod layer_norm;
