//! Warped neighbours of a sample, and the pixels that auto-masking leaves in.

use image::RgbImage;

use super::place::Place;
use super::{Group, Shown};
use crate::data::batch::{Batch, to_images};
use crate::error::Result;
use crate::monovit::loss::{LossConfig, Reprojection, photometric};
use crate::nn::Context;
use crate::report::map::{UNKNOWN, draw_map};
use crate::tensor::{Tensor, Var};
use crate::train::trainer::transforms;

/// The neighbours of a batch's first sample, warped into its target, and the pixels that auto-masking leaves in.
pub(super) fn warps(place: &Place, shown: &Shown, config: LossConfig, batch: &Batch) -> Result<Option<Group>> {
    let c = Context::inference(shown.params);
    let target = Var::constant(batch.target.clone());
    let disparity = shown.model.disparities(&c, &target).swap_remove(0);
    let depth = disparity.disparity_to_depth(config.min_depth, config.max_depth);
    let plain = Var::constant(batch.pyramid[0].clone());
    let mut views = vec![place.photo("warp-target", "Target", &to_images(&batch.pyramid[0])[0])?];
    let (mut moved, mut still) = (Vec::new(), Vec::new());
    for (i, transform) in transforms(shown.model, &c, batch, &target).iter().enumerate() {
        let source = Var::constant(batch.sources[i].clone());
        let warped = source.warp(&depth, transform, &batch.intrinsics, config.consistent_grid);
        let title = format!("Source {}", i + 1);
        views.push(place.photo(&format!("warp-source{i}"), &title, &to_images(&batch.sources[i])[0])?);
        let picture = &to_images(warped.value())[0];
        views.push(place.photo(&format!("warp-warped{i}"), &format!("{title}, warped"), picture)?);
        moved.push(photometric(&warped, &plain, &config).into_value());
        still.push(photometric(&source, &plain, &config).into_value());
    }
    let picture = &to_images(&batch.pyramid[0])[0];
    let (w, h) = picture.dimensions();
    let pixels = (w * h) as usize;
    let least = |maps: &[Tensor<f32>], i: usize| {
        let errors = maps.iter().map(|map| map.data()[i]);
        if config.reprojection == Reprojection::Minimum {
            errors.fold(f32::INFINITY, f32::min)
        } else {
            errors.sum::<f32>() / maps.len().max(1) as f32
        }
    };
    if moved.is_empty() {
        return Ok(None);
    }
    let errors: Vec<f64> = (0..pixels).map(|i| f64::from(least(&moved, i))).collect();
    let map = draw_map(&errors, (h as usize, w as usize), (w, h), [0.0, 0.3]);
    views.push(place.map("warp-error", "Photometric error, warped", &map, ["0".into(), "0.3".into()])?);
    let kept: Vec<bool> = (0..pixels).map(|i| least(&moved, i) < least(&still, i)).collect();
    let share = kept.iter().filter(|kept| **kept).count() as f64 / pixels as f64;
    let mask = RgbImage::from_fn(w, h, |x, y| match kept[(y * w + x) as usize] {
        true => *picture.get_pixel(x, y),
        false => UNKNOWN,
    });
    let title = format!("Auto-mask: {:.0} % of the pixels are left in, the others grey", 100.0 * share);
    views.push(place.picture("warp-mask", &title, &mask)?);
    Ok(Some(Group { kind: "Warped neighbours and auto-mask".into(), about: "a validation sample".into(), views }))
}
