//! The two main jobs in a program of one's own: train on the street, and predict the depth of a picture.
//!
//! Two steps of the smallest network teach it nothing; with the default recipe (`RunConfig::usual()`) this is the run of
//! the command line.

use parallax::eval::predictor::Predictor;
use parallax::monovit::Preset;
use parallax::train::{RunConfig, train};

pub fn main() -> parallax::Result<()> {
    let folder = std::env::temp_dir().join(format!("parallax-example-{}", std::process::id()));
    let config = RunConfig { height: 64, width: 96, batch: 2, ..RunConfig::new(Preset::Pico, 2) };
    let metrics = train(config, &folder, |_| ())?;
    println!("{} steps; Abs Rel {:.3}", metrics.steps, metrics.after.map_or(f64::NAN, |m| m.abs_rel));

    let picture = image::RgbImage::from_fn(320, 200, |x, y| image::Rgb([x as u8, y as u8, 90]));
    let prediction = Predictor::load(&folder)?.depth_of(&picture)?;
    let depth = prediction.inverse_depth.depth();
    println!(
        "a map of {}x{}, {:?} depth {:.2} in the middle",
        depth.width,
        depth.height,
        prediction.inverse_depth.unit,
        depth.values[100 * 320 + 160]
    );
    std::fs::remove_dir_all(&folder).map_err(|e| parallax::Error::io(&folder, e))
}
