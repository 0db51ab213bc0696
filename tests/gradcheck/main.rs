//! The gradient-check suite: loops over the registry, so that nobody has to remember anything.

mod every_op;
mod model_path;
mod modes;
mod whole_model;
