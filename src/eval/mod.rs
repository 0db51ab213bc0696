//! Depth of pictures, and how good it is: prediction, protocols and metrics, scale from the camera's height, attention maps.

pub mod alignment;
pub mod attention;
pub mod bootstrap;
pub mod breakdown;
pub mod camera_height;
pub mod compare;
pub mod csv;
pub mod evaluate;
pub mod flip;
pub mod folder;
pub mod mean_map;
pub mod metrics;
pub mod odometry;
pub mod predictions;
pub mod predictor;
pub mod projected;
pub mod protocol;
pub mod scale;
pub mod shipping;
pub mod statistics;
pub mod study;
pub mod trajectory;
