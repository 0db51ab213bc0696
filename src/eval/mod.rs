//! Depth of pictures, and how good it is: prediction, metrics, scale from the camera's height, attention maps.

pub mod attention;
pub mod camera_height;
pub mod metrics;
pub mod predictions;
pub mod predictor;
