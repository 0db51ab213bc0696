//! Views that need the weights and a data set alone: errors, attention.

use super::place::Place;
use super::{Group, Shown};
use crate::data::DataSource;
use crate::data::batch::to_tensor;
use crate::error::Result;
use crate::eval::attention::{attention, saliency};
use crate::eval::predictor::Predictor;
use crate::report::map::{draw_map, draw_values};
use crate::report::overlay::{Overlay, mark};

/// The error, as a share of the true depth, that is brightest.
const WORST: f64 = 0.5;
/// Half the width of the square around a query pixel whose disparity's gradient is shown, in pixels.
const RADIUS: usize = 1;
/// Query pixels of attention: row and column, as shares of the picture.
const QUERIES: [[f64; 2]; 3] = [[0.8, 0.5], [0.55, 0.2], [0.5, 0.75]];

/// A frame, its predicted depth, the true one, and the error as a share of it; nothing where there is no truth.
pub(super) fn error_group(
    place: &Place,
    predictor: &Predictor,
    data: &dyn DataSource,
    sample: usize,
    name: &str,
    kind: &str,
) -> Result<Option<Group>> {
    let Some(truth) = data.depth(sample)? else { return Ok(None) };
    let image = data.image(sample, 0)?;
    let size = image.dimensions();
    let found = predictor.inverse_depth(&image, false).resized(truth.height, truth.width, 1.0);
    let known: Vec<usize> = (0..truth.metres.len()).filter(|&i| (1e-3..=80.0).contains(&truth.metres[i])).collect();
    if known.is_empty() || !found.is_whole() {
        return Ok(None);
    }
    let scale = median(known.iter().map(|&i| f64::from(truth.metres[i])))
        / median(known.iter().map(|&i| 1.0 / f64::from(found.values[i])));
    let depth = |i: usize| scale / f64::from(found.values[i]);
    let error = |i: usize| (depth(i) - f64::from(truth.metres[i])).abs() / f64::from(truth.metres[i]);
    let dims = (truth.height, truth.width);
    let near = known.iter().map(|&i| truth.metres[i]).fold(f32::INFINITY, f32::min).max(1.0);
    let range = [0.0, 1.0 / f64::from(near)];
    let bar = || ["far".to_owned(), format!("{near:.1} m")];
    let reach = if known.len() * 3 < truth.metres.len() { 2 } else { 0 };
    let draw = |of: &dyn Fn(usize) -> f64, range| {
        draw_values(known.iter().map(|&i| (i / dims.1, i % dims.1, of(i))), dims, size, range, reach)
    };
    let whole: Vec<f64> = (0..truth.metres.len()).map(|i| 1.0 / depth(i)).collect();
    let mean = known.iter().map(|&i| error(i)).sum::<f64>() / known.len() as f64;
    let views = vec![
        place.photo(&format!("{name}-frame"), "Frame", &image)?,
        place.map(
            &format!("{name}-depth"),
            "Predicted depth, at the truth's median",
            &draw_map(&whole, dims, size, range),
            bar(),
        )?,
        place.map(
            &format!("{name}-truth"),
            "True depth",
            &draw(&|i| 1.0 / f64::from(truth.metres[i]), range),
            bar(),
        )?,
        place.map(
            &format!("{name}-error"),
            "Error over true depth",
            &draw(&error, [0.0, WORST]),
            ["0".into(), format!("{:.0} % and more", 100.0 * WORST)],
        )?,
    ];
    Ok(Some(Group { kind: kind.into(), about: format!("{}, Abs Rel {mean:.3}", data.name(sample)), views }))
}

/// The places that a few pixels of the first sample look at; in networks without attention, what their disparities depend on.
pub(super) fn attention_group(place: &Place, shown: &Shown) -> Result<Option<Group>> {
    let image = shown.data.image(0, 0)?;
    let (w, h) = image.dimensions();
    let (seen, overlay) = (to_tensor(&[&image]), Overlay::new(&image));
    let (mut views, mut looks) = (Vec::new(), false);
    for (i, [y, x]) in QUERIES.into_iter().enumerate() {
        let pixel = [(y * f64::from(h)) as usize, (x * f64::from(w)) as usize];
        let found = attention(shown.model, shown.params, &seen, pixel);
        // The last layer of the first path, at 1/8 of the picture: fine enough to be seen.
        let rows = found.rows.iter().rfind(|rows| rows.stage == 1 && rows.path == 0);
        looks |= rows.is_some();
        let map = match rows {
            Some(rows) => rows.mean(),
            // Gradients fall off steeply: their square root shows what lies beside the pixel too.
            None => saliency(shown.model, shown.params, &seen, pixel, RADIUS).map(f32::sqrt),
        };
        let &[rows, columns] = map.dims() else { unreachable!("maps have two dimensions") };
        let mut made = overlay.signed(map.data(), (rows, columns));
        mark(&mut made, pixel[1] as f32, pixel[0] as f32);
        views.push(place.photo(
            &format!("attention{i}"),
            &format!("Pixel {}, {} (ring)", pixel[1], pixel[0]),
            &made,
        )?);
    }
    let (kind, about) = match looks {
        true => ("Attention", "warm is looked at, cold is looked away from (last layer at 1/8 of the size)"),
        false => ("Saliency", "warm is what the disparity around the pixel depends on (the gradient by the picture)"),
    };
    let about = format!("{}: {about}", shown.data.name(0));
    Ok((!views.is_empty()).then(|| Group { kind: format!("{kind} of query pixels"), about, views }))
}

/// The middle of some numbers.
fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_unstable_by(f64::total_cmp);
    values[values.len() / 2]
}
