//! Elements brought elsewhere, unchanged: reshaping, joining, picking, sorting.
//!
//! | op family | idea |
//! |---|---|
//! | [`shape_ops`] | reshape and permute |
//! | [`mod@concat`] | tensors one after the other |
//! | [`mod@slice`] | a range along an axis |
//! | [`repeat`] | copies along an axis |
//! | [`flip`] | reversed order along an axis |
//! | [`index_select`] | whole slices by index |
//! | [`gather`] | single elements by index |
//! | [`scatter_add`] | elements added to indexed places |
//! | [`sort`] | sorted order |
//! | [`top_k`] | the largest |

pub mod concat;
pub mod flip;
pub mod gather;
pub mod index_select;
pub mod repeat;
pub mod scatter_add;
pub mod shape_ops;
pub mod slice;
pub mod sort;
pub mod top_k;
