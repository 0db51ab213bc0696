//! Parameters and buffers by path, with the names, shapes and layouts of the public checkpoints.

use std::collections::{BTreeMap, HashMap};
use std::hash::{DefaultHasher, Hash, Hasher};
use std::sync::{Arc, Mutex, PoisonError};

use super::BatchNorm;
use super::init::{Init, Start};
use crate::random::Random;
use crate::tensor::{Float, Shape, Tensor};

/// Identifier of a parameter: its index in [`Params`], and its name and shape.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct ParamId {
    index: usize,
    identity: Identity,
}

impl ParamId {
    /// The index.
    pub(crate) fn index(self) -> usize {
        self.index
    }

    /// Makes sure that what stands in some parameters at this index is what this stands for.
    ///
    /// # Panics
    /// If it is another one: names both.
    #[inline]
    #[track_caller]
    pub(crate) fn check(self, there: Option<&Identity>) {
        if there != Some(&self.identity) {
            let there = there.map_or_else(|| "nothing".to_owned(), |other| other.name());
            panic!(
                "{} is looked for in the parameters of another model, which have {there} in its place: use a module with \
                 the parameters that its builder made, or with those of the same model",
                self.identity.name()
            );
        }
    }
}

/// What a parameter is: its name and shape. Modules keep no numbers, so that one can be used with several sets of
/// parameters (trained ones, averaged ones); they only have to be of the same model.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) struct Identity(u64);

/// The names behind identities, for messages: one entry for each name and shape that this process has seen.
static IDENTITIES: Mutex<BTreeMap<u64, String>> = Mutex::new(BTreeMap::new());

impl Identity {
    fn of(name: &str, shape: &Shape) -> Self {
        let mut hasher = DefaultHasher::new();
        (name, shape.dims()).hash(&mut hasher);
        let identity = hasher.finish();
        let mut known = IDENTITIES.lock().unwrap_or_else(PoisonError::into_inner);
        known.entry(identity).or_insert_with(|| format!("{name} {shape}"));
        Identity(identity)
    }

    /// Name and shape.
    pub(crate) fn name(self) -> String {
        let known = IDENTITIES.lock().unwrap_or_else(PoisonError::into_inner);
        known.get(&self.0).cloned().unwrap_or_default()
    }
}

/// Makes sure that `who` is used with the parameters of the model that it was made for.
///
/// # Panics
/// If not: names the first parameter that differs.
#[track_caller]
pub(crate) fn same_model(who: &str, made_for: &[Identity], given: &[Identity]) {
    if made_for == given {
        return;
    }
    let at = made_for.iter().zip(given).position(|(a, b)| a != b).unwrap_or(made_for.len().min(given.len()));
    let name = |of: &[Identity]| of.get(at).map_or_else(|| "nothing".to_owned(), |identity| identity.name());
    panic!("{who} was made for other parameters: number {at} was {}, and is {} here", name(made_for), name(given));
}

/// Memory layout of a parameter in a PyTorch checkpoint, relative to this crate's.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layout {
    /// The same.
    Same,
    /// `[out, in / groups, kh, kw]` there, `[kh, kw, in / groups, out]` here.
    Conv,
    /// `[channels, 1, kh, kw]` there, `[kh, kw, channels]` here.
    Depthwise,
    /// `[out, in]` there, `[in, out]` here.
    Linear,
}

impl Layout {
    /// A tensor in this crate's layout from one in PyTorch's; `None` if its rank is wrong.
    pub fn import<T: Float>(self, theirs: &Tensor<T>) -> Option<Tensor<T>> {
        Some(match (self, theirs.dims()) {
            (Layout::Same, _) => theirs.clone(),
            (Layout::Conv, [_, _, _, _]) => theirs.permute(&[2, 3, 1, 0]),
            (Layout::Depthwise, &[c, 1, kh, kw]) => theirs.reshape([c, kh, kw]).permute(&[1, 2, 0]),
            (Layout::Linear, [_, _]) => theirs.permute(&[1, 0]),
            _ => return None,
        })
    }

    /// The dimensions in PyTorch's layout of a tensor that has these in this crate's.
    pub fn exported(self, ours: &[usize]) -> Vec<usize> {
        match (self, ours) {
            (Layout::Conv, &[kh, kw, inputs, out]) => vec![out, inputs, kh, kw],
            (Layout::Depthwise, &[kh, kw, c]) => vec![c, 1, kh, kw],
            (Layout::Linear, &[inputs, out]) => vec![out, inputs],
            _ => ours.to_vec(),
        }
    }

    /// A tensor in PyTorch's layout from one in this crate's.
    pub fn export<T: Float>(self, ours: &Tensor<T>) -> Tensor<T> {
        match (self, ours.dims()) {
            (Layout::Conv, _) => ours.permute(&[3, 2, 0, 1]),
            (Layout::Depthwise, &[kh, kw, c]) => ours.permute(&[2, 0, 1]).reshape([c, 1, kh, kw]),
            (Layout::Linear, _) => ours.permute(&[1, 0]),
            _ => ours.clone(),
        }
    }
}

/// One named tensor of a model.
#[derive(Clone, Debug)]
pub struct Param<T: Float> {
    /// Its names in a checkpoint: several where modules share it, the first one its own.
    pub names: Vec<String>,
    /// The numbers, in this crate's layout.
    pub value: Tensor<T>,
    /// How it lies in a PyTorch checkpoint.
    pub layout: Layout,
    /// Whether it is learnt (a weight), or kept (a running statistic).
    pub learnt: bool,
}

impl<T: Float> Param<T> {
    /// Its own name.
    pub fn name(&self) -> &str {
        &self.names[0]
    }
}

/// Parameters of a model: learnt weights and running statistics, by name.
#[derive(Clone, Debug, Default)]
pub struct Params<T: Float> {
    all: Vec<Param<T>>,
    identities: Arc<Vec<Identity>>,
    by_name: HashMap<String, ParamId>,
    /// The convolutions with a normalisation directly behind them.
    pub(super) normalised: Vec<(ParamId, BatchNorm)>,
}

impl<T: Float> Params<T> {
    /// Parameters of an empty model.
    pub fn new() -> Self {
        Params { all: Vec::new(), identities: Arc::default(), by_name: HashMap::new(), normalised: Vec::new() }
    }

    /// Every tensor, in the order in which modules asked for them.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = (ParamId, &Param<T>)> {
        let of = |(index, param)| (ParamId { index, identity: self.identities[index] }, param);
        self.all.iter().enumerate().map(of)
    }

    /// Number of parameters.
    pub fn len(&self) -> usize {
        self.all.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.all.is_empty()
    }

    /// A parameter.
    pub fn get(&self, id: ParamId) -> &Param<T> {
        self.check(id);
        &self.all[id.index]
    }

    /// What the parameters are, in their order.
    pub(crate) fn identities(&self) -> Arc<Vec<Identity>> {
        self.identities.clone()
    }

    #[track_caller]
    fn check(&self, id: ParamId) {
        id.check(self.identities.get(id.index));
    }

    /// The value of a parameter, mutable.
    pub fn value_mut(&mut self, id: ParamId) -> &mut Tensor<T> {
        self.check(id);
        &mut self.all[id.index].value
    }

    /// Replaces the value of a parameter.
    ///
    /// # Panics
    /// If the shape differs.
    #[track_caller]
    pub fn set(&mut self, id: ParamId, value: Tensor<T>) {
        self.check(id);
        let param = &mut self.all[id.index];
        assert_eq!(param.value.shape(), value.shape(), "{}", param.name());
        param.value = value;
    }

    /// The tensor with this name (any of its names).
    pub fn find(&self, name: &str) -> Option<ParamId> {
        self.by_name.get(name).copied()
    }

    /// Number of learnt scalars in the parameters whose names begin with `prefix`.
    pub fn count(&self, prefix: &str) -> usize {
        self.all.iter().filter(|p| p.learnt && p.name().starts_with(prefix)).map(|p| p.value.len()).sum()
    }

    /// Every tensor under its own name, in PyTorch's layout.
    pub fn export(&self) -> BTreeMap<String, Tensor<T>> {
        self.all.iter().map(|p| (p.name().to_owned(), p.layout.export(&p.value))).collect()
    }

    /// The same model in the other element type.
    pub fn cast<U: Float>(&self) -> Params<U> {
        let all = self.all.iter().map(|p| Param {
            names: p.names.clone(),
            value: p.value.cast(),
            layout: p.layout,
            learnt: p.learnt,
        });
        Params {
            all: all.collect(),
            identities: self.identities.clone(),
            by_name: self.by_name.clone(),
            normalised: self.normalised.clone(),
        }
    }

    #[track_caller]
    fn add(&mut self, param: Param<T>) -> ParamId {
        let identity = Identity::of(param.name(), param.value.shape());
        let id = ParamId { index: self.all.len(), identity };
        Arc::make_mut(&mut self.identities).push(identity);
        let before = self.by_name.insert(param.name().to_owned(), id);
        assert!(before.is_none(), "two parameters are called {}", param.name());
        self.all.push(param);
        id
    }

    #[track_caller]
    fn alias(&mut self, id: ParamId, name: String) {
        let before = self.by_name.insert(name.clone(), id);
        assert!(before.is_none(), "two parameters are called {name}");
        self.all[id.index].names.push(name);
    }
}

/// Builder that creates a module's parameters under a path, which grows with [`Builder::at`].
pub struct Builder<'a, T: Float> {
    params: &'a mut Params<T>,
    random: &'a mut Random,
    path: String,
    start: Start,
}

impl<'a, T: Float> Builder<'a, T> {
    /// A builder at the root.
    pub fn new(params: &'a mut Params<T>, random: &'a mut Random) -> Self {
        Builder { params, random, path: String::new(), start: Start::Published }
    }

    /// The same builder with other starting values.
    pub fn starting(self, start: Start) -> Self {
        Builder { start, ..self }
    }

    /// How a weight with `fan_in` inputs starts, whose published start is given.
    pub fn start(&self, published: Init, fan_in: usize) -> Init {
        match self.start {
            Start::Published => published,
            Start::Uniform => Init::FanIn(fan_in),
        }
    }

    /// The same builder one level deeper.
    pub fn at(&mut self, name: impl std::fmt::Display) -> Builder<'_, T> {
        let path = self.join(name);
        Builder { params: self.params, random: self.random, path, start: self.start }
    }

    /// Where the builder stands: what the names of its parameters begin with.
    pub fn path(&self) -> &str {
        &self.path
    }

    fn join(&self, name: impl std::fmt::Display) -> String {
        if self.path.is_empty() { name.to_string() } else { format!("{}.{name}", self.path) }
    }

    /// A tensor that is learnt, filled by `init`.
    #[track_caller]
    pub fn param(&mut self, name: &str, shape: impl Into<Shape>, layout: Layout, init: Init) -> ParamId {
        let names = vec![self.join(name)];
        let value = init.tensor(shape.into(), self.random);
        self.params.add(Param { names, value, layout, learnt: true })
    }

    /// A tensor that is kept but not learnt.
    #[track_caller]
    pub fn buffer(&mut self, name: &str, shape: impl Into<Shape>, value: f64) -> ParamId {
        let names = vec![self.join(name)];
        let value = Tensor::full(shape, T::of(value));
        self.params.add(Param { names, value, layout: Layout::Same, learnt: false })
    }

    /// The last dimension of a tensor.
    pub(super) fn channels(&self, id: ParamId) -> usize {
        self.params.get(id).value.shape().last()
    }

    /// Notes that `bn` stands directly behind the convolution with this weight, whose last dimension is the channels.
    pub fn normalised(&mut self, weight: ParamId, bn: &BatchNorm) {
        self.params.normalised.push((weight, bn.clone()));
    }

    /// One more name for a tensor that modules share.
    #[track_caller]
    pub fn alias(&mut self, name: &str, id: ParamId) {
        let name = self.join(name);
        self.params.alias(id, name);
    }
}
