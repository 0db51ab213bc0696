//! Convolutions.
//!
//! | op family | idea |
//! |---|---|
//! | [`conv2d`] | general and grouped, of the parts of a concatenation, with bias and activation |
//! | [`depthwise`] | one filter a channel |
//! | [`transpose`] | the transposed convolution |
//! | [`upsampled`] | a convolution of an image that is enlarged twofold, without enlarging it |

pub mod conv2d;
pub mod depthwise;
pub mod transpose;
pub mod upsampled;
