//! Along dimensions: sums, extremes, running sums, variances, and the softmax family.
//!
//! | op family | idea |
//! |---|---|
//! | [`sum`] | sums, means, maxima and minima |
//! | [`prod`] | products |
//! | [`cumulative`] | running sums and products |
//! | [`norm`] | Euclidean lengths, and vectors brought to length 1 |
//! | [`variance`] | variances and standard deviations |
//! | [`softmax`] | softmax |
//! | [`log_softmax`] | its logarithm |
//! | [`log_sum_exp`] | the logarithm of a sum of exponentials |
//! | [`cross_entropy`] | cross-entropy between logits and class numbers |

pub(in crate::ops) mod axis_loops;
pub mod cross_entropy;
pub mod cumulative;
pub mod log_softmax;
pub mod log_sum_exp;
pub mod norm;
pub mod prod;
pub mod softmax;
pub mod sum;
pub mod variance;
