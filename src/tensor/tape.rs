//! The tape: ops in the order in which they ran, which is a topological order already.
//!
//! `backward` pops nodes from the end, so what a node saved is freed the moment it was used, and neither running nor
//! dropping a long chain recurses.

use std::cell::RefCell;
use std::rc::Rc;

use super::data::Tensor;
use super::float::Float;
use super::gradients::{GradSink, Gradients, Upstream};
use super::profile;
use super::shape::Shape;
use super::var::Var;

/// What a node does in the backward pass: turns the gradients of its outputs into those of its inputs.
pub(crate) type Backward<T> = Box<dyn FnOnce(Upstream<T>, &mut GradSink<T>)>;

/// One op that ran, with what it saved.
struct Node<T: Float> {
    /// The slots of its inputs; `None` where an input is not tracked.
    inputs: Vec<Option<usize>>,
    /// The slots of its outputs.
    outputs: Vec<usize>,
    backward: Backward<T>,
}

struct Record<T: Float> {
    nodes: Vec<Node<T>>,
    /// One slot for every tracked value: its shape.
    shapes: Vec<Shape>,
    reversed: bool,
}

/// Tape: the record of a computation, which is differentiated in reverse once.
///
/// ```
/// use parallax::tensor::{Tape, Tensor};
/// let tape = Tape::new();
/// let x = tape.leaf(Tensor::from_vec([3], vec![1.0f64, 2.0, 3.0]));
/// let y = (&x * &x).sum_all();
/// let gradients = y.backward();
/// assert_eq!(gradients.get(&x).unwrap().data(), [2.0, 4.0, 6.0]);
/// ```
pub struct Tape<T: Float>(Rc<RefCell<Record<T>>>);

impl<T: Float> Clone for Tape<T> {
    fn clone(&self) -> Self {
        Tape(self.0.clone())
    }
}

impl<T: Float> Default for Tape<T> {
    fn default() -> Self {
        Self::new()
    }
}

impl<T: Float> Tape<T> {
    /// An empty tape.
    pub fn new() -> Self {
        Tape(Rc::new(RefCell::new(Record { nodes: Vec::new(), shapes: Vec::new(), reversed: false })))
    }

    /// A leaf: a variable whose gradient is wanted.
    ///
    /// # Panics
    /// If the tape was already reversed.
    #[track_caller]
    pub fn leaf(&self, value: Tensor<T>) -> Var<T> {
        let slot = self.slot(*value.shape());
        Var::tracked(value, self.clone(), slot)
    }

    #[track_caller]
    fn slot(&self, shape: Shape) -> usize {
        let mut record = self.0.borrow_mut();
        assert!(!record.reversed, "this tape was already reversed: start a new one for the next forward pass");
        record.shapes.push(shape);
        record.shapes.len() - 1
    }

    /// Number of recorded ops.
    pub fn len(&self) -> usize {
        self.0.borrow().nodes.len()
    }

    /// Whether nothing is recorded.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Whether two handles are of one tape.
    pub(crate) fn is(&self, other: &Tape<T>) -> bool {
        Rc::ptr_eq(&self.0, &other.0)
    }

    /// Adds an op that ran, or a part that runs again. Called by `ops::apply` and `recompute` alone.
    #[track_caller]
    pub(crate) fn record(
        &self,
        inputs: Vec<Option<usize>>,
        outputs: Vec<Tensor<T>>,
        backward: Backward<T>,
    ) -> Vec<Var<T>> {
        let vars: Vec<Var<T>> = outputs.into_iter().map(|value| self.leaf(value)).collect();
        let outputs = vars.iter().map(|v| v.slot().expect("just made")).collect();
        self.0.borrow_mut().nodes.push(Node { inputs, outputs, backward });
        vars
    }

    /// Reverses the computation from `outputs`, each with its cotangent (the gradient of a final scalar by it).
    ///
    /// # Panics
    /// If the tape was already reversed, an output is not on it, or a cotangent has another shape.
    #[track_caller]
    pub fn backward(&self, outputs: &[(&Var<T>, Tensor<T>)]) -> Gradients<T> {
        let mut record = self.0.borrow_mut();
        assert!(!record.reversed, "this tape was already reversed: what it saved is gone");
        record.reversed = true;
        let shapes = std::mem::take(&mut record.shapes);
        let mut nodes = std::mem::take(&mut record.nodes);
        drop(record);
        let mut slots: Vec<Option<Tensor<T>>> = vec![None; shapes.len()];
        for (var, cotangent) in outputs {
            let slot = var.slot_on(self).expect("backward from a value that this tape does not track");
            assert_eq!(cotangent.shape(), var.shape(), "the cotangent has the shape of its output");
            match &mut slots[slot] {
                Some(sum) => sum.add_assign(cotangent),
                empty => *empty = Some(cotangent.clone()),
            }
        }
        profile::phase("tape", || {
            while let Some(node) = nodes.pop() {
                let upstream: Vec<_> = node.outputs.iter().map(|&slot| slots[slot].take()).collect();
                if upstream.iter().any(Option::is_some) {
                    let mut sink = GradSink::new(&node.inputs, &mut slots, &shapes);
                    (node.backward)(Upstream(upstream), &mut sink);
                }
            }
        });
        Gradients::new(self.clone(), slots)
    }
}
