//! What is computed for the page: maps, and what a pixel looks at. One question after the other, because each takes all
//! cores.

use std::collections::VecDeque;
use std::path::Path;
use std::sync::Arc;
use std::sync::mpsc::Sender;

use image::RgbImage;
use parallax::data::batch::to_tensor;
use parallax::data::resize::lanczos;
use parallax::eval::attention::attention;
use parallax::eval::predictor::Predictor;
use parallax::report::colormap::magma;
use parallax::tensor::Tensor;
use parallax::weights::{Metres, Weights};
use parallax::{Error, Result};
use serde::Serialize;

use super::gallery::{Gallery, Picture};
use super::reply::Reply;
use crate::cli::lens::Told;
use crate::cli::predict::doubt;
use crate::cli::weights::WeightsArgs;

/// A picture is shown with at most so many pixels along its longer side.
const SHOWN: u32 = 1280;

/// Maps and attentions that are kept for when they are asked for again: a film that plays a second time.
const KEPT: usize = 64;

/// What the page asks for. Pictures and weights by number; a place in shares of the picture's width and height.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Ask {
    /// The picture, as it is shown.
    Picture(usize),
    /// Inverse depth at the size of the shown picture.
    Depth { picture: usize, weights: usize },
    /// What a place looks at, layer by layer.
    Attention { picture: usize, weights: usize, at: [f64; 2] },
}

/// A question, and where the reply goes.
pub struct Question {
    pub ask: Ask,
    pub reply: Sender<Reply>,
}

/// Weights that pictures are seen with.
pub struct Network {
    name: String,
    weights: Weights,
    predictor: Predictor,
    /// How its depths become metres, if it knows.
    metres: Option<Metres>,
}

/// What the page is told at the beginning.
#[derive(Clone, Serialize)]
pub struct State {
    weights: Vec<About>,
    pictures: Vec<String>,
    /// 256 colours, red, green and blue, from far to near.
    palette: Vec<[u8; 3]>,
}

#[derive(Clone, Serialize)]
struct About {
    name: String,
    trained_on: Option<String>,
    unit: &'static str,
    /// Above the road, in metres, where depth is in metres.
    camera_height: Option<f64>,
    /// At which the network sees pictures.
    width: usize,
    height: usize,
}

/// In front of a map's numbers.
#[derive(Serialize)]
struct MapHeader {
    width: usize,
    height: usize,
    unit: &'static str,
    /// In pixels of the map.
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    view: f64,
    view_by: Told,
    doubt: Option<String>,
}

/// In front of the numbers of all layers, one layer's after the other's.
#[derive(Serialize)]
struct AttentionHeader {
    layers: Vec<Layer>,
}

#[derive(Serialize)]
struct Layer {
    /// As the paper counts them.
    stage: usize,
    path: usize,
    layer: usize,
    width: usize,
    height: usize,
    /// The token that looks: its column and row.
    token: [usize; 2],
}

impl Network {
    /// Reads weights.
    pub fn load(args: &WeightsArgs) -> Result<Network> {
        let weights = args.load()?;
        let predictor = Predictor::new(&weights.model, &weights.params, &weights.setup);
        let metres = weights.origin.as_ref().filter(|_| !args.resized()).map(|origin| origin.metres);
        Ok(Network { name: args.name(), weights, predictor, metres })
    }

    fn unit(&self) -> &'static str {
        if self.metres.is_some() { "metres" } else { "relative" }
    }

    fn about(&self) -> About {
        let setup = self.predictor.setup();
        About {
            name: self.name.clone(),
            trained_on: self.weights.origin.as_ref().map(|origin| origin.in_words()),
            unit: self.unit(),
            camera_height: self.metres.map(|metres| metres.camera_height),
            width: setup.width,
            height: setup.height,
        }
    }

    /// A picture as the network sees it.
    fn seen(&self, picture: &RgbImage) -> RgbImage {
        let setup = self.predictor.setup();
        lanczos(picture, setup.width as u32, setup.height as u32)
    }

    fn map(&self, Picture { image, lens }: &Picture) -> Result<Reply> {
        let (setup, seen) = (self.predictor.setup(), self.seen(image));
        let map = self.predictor.inverse_depth(&seen, false);
        if !map.is_whole() {
            return Err(Error::Failed(self.predictor.why_not_finite(&seen)));
        }
        let factor = self.metres.map_or(1.0, |metres| metres.factor_for(lens.intrinsics));
        let (width, height) = shown_size(image);
        let map = map.resized(height as usize, width as usize, factor);
        let size = (image.width() as usize, image.height() as usize);
        let camera = lens.intrinsics;
        let (w, h) = (f64::from(width), f64::from(height));
        let header = MapHeader {
            width: width as usize,
            height: height as usize,
            unit: self.unit(),
            fx: camera.fx * w,
            fy: camera.fy * h,
            cx: camera.cx * w,
            cy: camera.cy * h,
            view: lens.view(),
            view_by: lens.told,
            doubt: doubt(size, (setup.width, setup.height)),
        };
        Ok(Reply::numbers(&header, &map.values))
    }

    fn attention(&self, picture: &RgbImage, at: [f64; 2]) -> Result<Reply> {
        let seen = self.seen(picture);
        let place = |share: f64, size: u32| ((share * f64::from(size)) as usize).min(size as usize - 1);
        let pixel = [place(at[1], seen.height()), place(at[0], seen.width())];
        let Weights { model, params, .. } = &self.weights;
        let found = attention(model, params, &to_tensor(&[&seen]), pixel);
        if !found.disparities.iter().all(Tensor::is_finite) {
            return Err(Error::Failed(self.predictor.why_not_finite(&seen)));
        }
        let mut numbers = Vec::new();
        let layers = found.rows.iter().map(|row| {
            let mean = row.mean();
            let &[height, width] = mean.dims() else { unreachable!("maps have two dimensions") };
            numbers.extend_from_slice(mean.data());
            let [y, x] = row.token;
            Layer { stage: row.stage + 2, path: row.path + 1, layer: row.layer + 1, width, height, token: [x, y] }
        });
        let header = AttentionHeader { layers: layers.collect() };
        Ok(Reply::numbers(&header, &numbers))
    }
}

/// The size at which a picture is shown.
fn shown_size(picture: &RgbImage) -> (u32, u32) {
    let (width, height) = picture.dimensions();
    let longest = width.max(height);
    if longest <= SHOWN {
        return (width, height);
    }
    let smaller = |side: u32| ((f64::from(side) * f64::from(SHOWN) / f64::from(longest)).round() as u32).max(1);
    (smaller(width), smaller(height))
}

/// Answers questions, and remembers its answers.
pub struct Worker {
    networks: Vec<Network>,
    gallery: Arc<Gallery>,
    answered: VecDeque<(Ask, Reply)>,
}

impl Worker {
    pub fn new(networks: Vec<Network>, gallery: Arc<Gallery>) -> Worker {
        Worker { networks, gallery, answered: VecDeque::new() }
    }

    /// What the page is told at the beginning.
    pub fn state(&self) -> State {
        State {
            weights: self.networks.iter().map(Network::about).collect(),
            pictures: self.gallery.names(),
            palette: (0..256).map(|i| magma(i as f32 / 255.0).0).collect(),
        }
    }

    /// The reply to a question; a word on what went wrong, if something did.
    pub fn answer(&mut self, ask: &Ask) -> Reply {
        if let Some((_, reply)) = self.answered.iter().find(|(answered, _)| answered == ask) {
            return reply.clone();
        }
        let reply = match self.compute(ask) {
            Ok(reply) => reply,
            Err(error) => return Reply::error(400, &parallax::printable(&error.to_string())),
        };
        self.answered.push_back((*ask, reply.clone()));
        if self.answered.len() > KEPT {
            self.answered.pop_front();
        }
        reply
    }

    fn compute(&self, ask: &Ask) -> Result<Reply> {
        let network = |weights: usize| {
            self.networks.get(weights).ok_or_else(|| Error::Failed(format!("there are no weights {weights}")))
        };
        match *ask {
            Ask::Picture(picture) => jpeg(&self.gallery.read(picture)?.image),
            Ask::Depth { picture, weights } => network(weights)?.map(&self.gallery.read(picture)?),
            Ask::Attention { picture, weights, at } => {
                network(weights)?.attention(&self.gallery.read(picture)?.image, at)
            }
        }
    }
}

/// A picture as it is shown.
fn jpeg(picture: &RgbImage) -> Result<Reply> {
    let (width, height) = shown_size(picture);
    let shown = if (width, height) == picture.dimensions() { picture.clone() } else { lanczos(picture, width, height) };
    let mut bytes = Vec::new();
    image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, 92)
        .encode_image(&shown)
        .map_err(|e| Error::file(Path::new("the picture"), e.to_string()))?;
    Ok(Reply::new("image/jpeg", bytes))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn large_pictures_are_shown_smaller_in_their_aspect() {
        for (size, shown) in [((1242, 375), (1242, 375)), ((4000, 3000), (1280, 960)), ((100_000, 10), (1280, 1))] {
            let found = shown_size(&RgbImage::new(size.0, size.1));
            assert_eq!(found, shown, "{size:?}");
        }
    }
}
