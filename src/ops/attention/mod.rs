//! Factorised attention (MPViT; Xu et al., CoaT, 2104.06399).
//!
//! | op family | idea |
//! |---|---|
//! | [`factorised`] | softmax of the keys over tokens, times values, times queries |
//! | [`relative_position`] | convolutional relative position encoding |

pub mod factorised;
pub(in crate::ops) mod head_products;
pub mod relative_position;
