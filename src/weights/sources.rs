//! The files that weights come from, together.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::names::{NETWORKS, Place, nested, place, resnet_network, unwrapped, wrappers};
use super::shipped::{self, Origin, SHIPPED};
use super::sizes::Sizes;
use crate::error::{Error, Result};
use crate::formats::TensorFile;
use crate::formats::pth::shown;
use crate::monovit::Ablation;
use crate::networks::setup::check_size;
use crate::networks::{Architecture, Setup};
use crate::nn::{Named, Params, Report, Skipped, fit};

/// Which of the four networks have to be there. One that is there at all has to be there whole.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Need {
    /// Encoder and decoder, to predict depth; the pose networks may be absent.
    Depth,
    /// All four, to go on training.
    All,
    /// Any of them.
    Any,
    /// One of them; what the files hold of others is passed over.
    Only(&'static str),
}

impl Need {
    /// Whether this network has to be there.
    pub fn requires(self, network: &str) -> bool {
        match self {
            Need::Depth => matches!(network, "encoder" | "depth"),
            Need::All => true,
            Need::Any => false,
            Need::Only(one) => network == one,
        }
    }
}

/// Opened files, their tensors under the model's names.
#[derive(Clone, Debug)]
pub struct Sources {
    paths: Vec<PathBuf>,
    pub(super) tensors: Vec<Named>,
    unexpected: Vec<String>,
    skipped: Vec<Skipped>,
    /// `height` and `width`, where a file says them.
    size: [Option<usize>; 2],
    setup: Option<Setup>,
    origin: Option<Origin>,
}

impl Sources {
    /// Opens files, or folders: a run's, which means its `best.safetensors`, or one with `encoder.pth`, `depth.pth`,
    /// `pose_encoder.pth`, `pose.pth` (or some of them, or with other endings). The path [`SHIPPED`] means the weights
    /// inside the program.
    ///
    /// # Errors
    /// Names the file that cannot be read, or the folder without weights; if there are no weights inside the program.
    pub fn open(paths: &[PathBuf]) -> Result<Self> {
        Self::open_either(paths, false)
    }

    /// [`open`](Sources::open), for files that hold weights twice, as they are and averaged over steps: the averaged ones.
    ///
    /// # Errors
    /// As [`open`](Sources::open).
    pub fn open_averaged(paths: &[PathBuf]) -> Result<Self> {
        Self::open_either(paths, true)
    }

    fn open_either(paths: &[PathBuf], averaged: bool) -> Result<Self> {
        let mut sources = Sources {
            paths: paths.to_vec(),
            tensors: Vec::new(),
            unexpected: Vec::new(),
            skipped: Vec::new(),
            size: [None, None],
            setup: None,
            origin: None,
        };
        for path in paths {
            if path.as_os_str() == SHIPPED {
                sources.add(shipped::open()?, averaged)?;
                continue;
            }
            let files = if path.is_dir() { files_of(path)? } else { vec![path.clone()] };
            for file in files {
                sources.add(TensorFile::open(&file)?, averaged)?;
            }
        }
        Ok(sources)
    }

    fn add(&mut self, file: TensorFile, averaged: bool) -> Result<()> {
        let path = Arc::new(file.path);
        let unknown: Vec<&str> =
            file.tensors.iter().map(|(n, _)| n.as_str()).filter(|n| place(n) == Place::Unknown).collect();
        let wrappers: Vec<String> = wrappers(&unknown).into_iter().map(str::to_owned).collect();
        // The tensors of the networks, plain and averaged.
        let mut both: [Vec<Named>; 2] = [Vec::new(), Vec::new()];
        let placed = |origin: &str| match place(origin) {
            Place::Unknown => wrappers.iter().find_map(|w| origin.strip_prefix(w.as_str())).map(place),
            known => Some(known),
        };
        let first = Some(Place::ResNet("conv1.weight".into()));
        let first = file.tensors.iter().find(|(origin, _)| placed(origin) == first);
        let resnet = resnet_network(&path, first.map(|(_, tensor)| tensor.shape()));
        for (origin, tensor) in file.tensors {
            let known = match placed(&origin) {
                Some(Place::ResNet(name)) => Some(Place::Model(format!("{resnet}.encoder.{name}"))),
                known => known,
            };
            match known {
                Some(Place::Model(name)) => {
                    let of = usize::from(unwrapped(&origin).1);
                    both[of].push(Named { name, origin, file: path.clone(), tensor });
                }
                Some(Place::Useless(what)) => self.skipped.push(Skipped { name: shown(&origin), what }),
                Some(Place::Unknown | Place::ResNet(_)) | None => self.unexpected.push(shown(&origin)),
            }
        }
        // Modules of the nested decoder stand under their numbers once more, which alone would mean Monodepth2's.
        if both.iter().flatten().any(|t| t.name.starts_with("depth.convs.")) {
            for tensor in both.iter_mut().flatten() {
                tensor.name = nested(&tensor.name).unwrap_or_else(|| std::mem::take(&mut tensor.name));
            }
        }
        let [plain, average] = both;
        if plain.is_empty() || average.is_empty() {
            self.tensors.extend(plain);
            self.tensors.extend(average);
        } else {
            let (taken, left, what) = match averaged {
                true => (average, plain, "plain weights: the averaged ones are taken"),
                false => {
                    (plain, average, "averaged weights: the plain ones are taken (convert --averaged takes these)")
                }
            };
            self.tensors.extend(taken);
            self.skipped.extend(left.into_iter().map(|t| Skipped { name: shown(&t.origin), what }));
        }
        for (slot, what) in self.size.iter_mut().zip(["height", "width"]) {
            let said = file.integers.iter().find(|(name, _)| unwrapped(name).0 == what);
            if let (None, Some((_, pixels))) = (*slot, said) {
                let pixels = usize::try_from(*pixels).unwrap_or(0);
                check_size(what, pixels).map_err(|e| Error::file(&*path, e.to_string()))?;
                *slot = Some(pixels);
            }
        }
        let said =
            Setup::from_metadata(&file.metadata).map_err(|e| Error::file(&*path, format!("its metadata: {e}")))?;
        self.setup = self.setup.or(said);
        let said =
            Origin::from_metadata(&file.metadata).map_err(|e| Error::file(&*path, format!("its metadata: {e}")))?;
        if let (None, Some(origin)) = (&self.origin, said) {
            self.origin = Some(origin);
        }
        Ok(())
    }

    /// The same, with the tensors of one network alone.
    pub(super) fn only(&self, network: &str) -> Self {
        let of_it = |t: &&Named| t.name.split('.').next() == Some(network);
        Sources { tensors: self.tensors.iter().filter(of_it).cloned().collect(), ..self.clone() }
    }

    /// Which of the four networks the files hold something of.
    pub fn networks(&self) -> Vec<&'static str> {
        let of = |network: &&str| self.tensors.iter().any(|t| t.name.split('.').next() == Some(*network));
        NETWORKS.into_iter().filter(of).collect()
    }

    /// Every path that was given, for messages.
    fn all_paths(&self) -> PathBuf {
        let all: Vec<String> = self.paths.iter().map(|p| p.display().to_string()).collect();
        all.join(", ").into()
    }

    fn error(&self, message: String) -> Error {
        Error::file(self.all_paths(), message)
    }

    /// The networks that the tensors' names and shapes are those of.
    ///
    /// # Errors
    /// If there is none: names the nearest one and what differs. If there are several, because there are too few tensors
    /// to tell them apart, unless `need` is [`Need::Any`].
    pub fn architecture(&self, need: Need) -> Result<Architecture> {
        let sizes = self.some_sizes()?;
        match sizes.fitting()[..] {
            [one] => Ok(one),
            [first, ..] if need == Need::Any => Ok(first),
            [] => {
                let (nearest, differences) = sizes.nearest();
                let message = format!(
                    "of no known size: the nearest is {}, but these weights have {}",
                    nearest.name(),
                    differences.join(", ")
                );
                Err(self.error(message))
            }
            ref several => {
                let names: Vec<String> = several.iter().map(|a| a.name()).collect();
                let message = format!("could be of the sizes {} alike: the depth encoder is missing", names.join(", "));
                Err(self.error(message))
            }
        }
    }

    fn some_sizes(&self) -> Result<Sizes> {
        let sizes = Sizes::of(&self.tensors);
        if sizes.is_empty() {
            let example = self.unexpected.first().map_or(String::new(), |n| format!(", such as {n}"));
            let others = self.unexpected.len() + self.skipped.len();
            let message = format!("holds no weights of a network of this program, but {others} other tensors{example}");
            return Err(self.error(message));
        }
        Ok(sizes)
    }

    /// Makes sure that the tensors are of this architecture (or, given a preset, of MonoViT in that size).
    ///
    /// # Errors
    /// Says what differs, and which networks they are of.
    pub fn expect(&self, architecture: impl Into<Architecture>) -> Result<()> {
        let architecture = architecture.into();
        let sizes = self.some_sizes()?;
        let (differences, _) = sizes.differences(&architecture.config(&Ablation::default())?);
        if differences.is_empty() {
            return Ok(());
        }
        let advice = match sizes.fitting()[..] {
            [one] => format!("; they are of {}", one.in_words()),
            _ => String::new(),
        };
        let message =
            format!("does not fit {}: these weights have {}{advice}", architecture.in_words(), differences.join(", "));
        Err(self.error(message))
    }

    /// The setup to use the weights with: the one they were trained with, where a file says it; otherwise the usual one of
    /// their size, for pictures of the size that an encoder's file says.
    ///
    /// # Errors
    /// As [`Sources::architecture`].
    pub fn setup(&self, need: Need) -> Result<Setup> {
        if let Some(setup) = self.setup {
            return Ok(setup);
        }
        let usual = Setup::of(self.architecture(need)?);
        let [height, width] = self.size;
        Ok(Setup { height: height.unwrap_or(usual.height), width: width.unwrap_or(usual.width), ..usual })
    }

    /// Where the weights come from, if their file says so. Of weights that several paths give together nobody knows.
    pub fn origin(&self) -> Option<&Origin> {
        self.origin.as_ref().filter(|_| self.paths.len() == 1)
    }

    /// Puts the tensors into a model's parameters: all or none, unless `allow_partial`, which puts in what fits.
    ///
    /// # Errors
    /// If the tensors are not exactly those of the networks that are needed, or there at all; in any case if none fits,
    /// if one is not finite, or if two for one parameter differ. Nothing is changed then.
    pub fn fill(&self, params: &mut Params<f32>, need: Need, allow_partial: bool) -> Result<Report> {
        let network = |name: &str| NETWORKS.into_iter().find(|n| name.split('.').next() == Some(*n));
        let mut skipped = self.skipped.clone();
        let mut unexpected = self.unexpected.clone();
        let mut tensors = self.tensors.clone();
        if let Need::Only(one) = need {
            let (kept, others): (Vec<Named>, Vec<Named>) =
                tensors.into_iter().partition(|t| network(&t.name) == Some(one));
            tensors = kept;
            let what = "tensors of other networks";
            skipped.extend(others.into_iter().map(|t| Skipped { name: shown(&t.origin), what }));
        }
        let fitted = fit(params, &tensors)?;
        let mut report = fitted.report.clone();
        unexpected.append(&mut report.unexpected);
        (report.unexpected, report.skipped) = (unexpected, skipped);
        for one in NETWORKS {
            let there = tensors.iter().any(|t| network(&t.name) == Some(one));
            if !there && !need.requires(one) {
                report.missing.retain(|name| network(name) != Some(one));
                report.absent.push(one.to_owned());
            }
        }
        if report.matched.is_empty() {
            let problem = report.problem().unwrap_or_else(|| "nothing of the network is there".into());
            return Err(self.error(format!("no tensor fits: {problem}")));
        }
        if let (false, Some(problem)) = (allow_partial, report.problem()) {
            let message =
                format!("not exactly the weights of this network: {problem}. --allow-partial takes what fits");
            return Err(self.error(message));
        }
        fitted.put_into(params);
        Ok(report)
    }
}

/// The files of weights in a folder.
fn files_of(folder: &Path) -> Result<Vec<PathBuf>> {
    let best = folder.join("best.safetensors");
    if best.is_file() {
        return Ok(vec![best]);
    }
    let file = |network: &str| {
        let named = |ending: &str| folder.join(format!("{network}.{ending}"));
        ["pth", "pt", "safetensors", "npz"].map(named).into_iter().find(|p| p.is_file())
    };
    let files: Vec<PathBuf> = NETWORKS.into_iter().filter_map(file).collect();
    if files.is_empty() {
        let message = "holds no weights: expected a run's best.safetensors, or encoder.pth, depth.pth, \
                       pose_encoder.pth, pose.pth (also as .pt, .safetensors, .npz)";
        return Err(Error::file(folder, message));
    }
    Ok(files)
}
