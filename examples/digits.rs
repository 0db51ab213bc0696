//! A small convolutional network learns to read digits: parameters, a forward pass, a loss, its gradient, AdamW.
//!
//! The digits are drawn by the program: a font of 5x7 pixels, anywhere in a picture of 16x16, under noise.

use parallax::nn::{Builder, Context, Conv, ConvStart, Init, Linear, Params};
use parallax::ops::Conv2d;
use parallax::optim::{AdamW, Group};
use parallax::random::Random;
use parallax::tensor::{Tape, Tensor, Var};

/// The rows of each digit, five bits a row.
const FONT: [[u8; 7]; 10] = [
    [14, 17, 19, 21, 25, 17, 14],
    [4, 12, 4, 4, 4, 4, 14],
    [14, 17, 1, 2, 4, 8, 31],
    [31, 2, 4, 2, 1, 17, 14],
    [2, 6, 10, 18, 31, 2, 2],
    [31, 16, 30, 1, 1, 17, 14],
    [6, 8, 16, 30, 17, 17, 14],
    [31, 1, 2, 4, 8, 8, 8],
    [14, 17, 17, 14, 17, 17, 14],
    [14, 17, 17, 15, 1, 2, 12],
];

/// Pictures `[n, 16, 16, 1]` and the digit in each, `[n]`.
fn draw(n: usize, random: &mut Random) -> (Tensor<f32>, Tensor<f32>) {
    let mut pictures = Vec::with_capacity(n * 256);
    let mut digits = Vec::with_capacity(n);
    for _ in 0..n {
        let digit = random.below(10);
        let (top, left) = (random.below(9), random.below(11));
        let ink = |y: usize, x: usize| {
            let (row, column) = (y.wrapping_sub(top), x.wrapping_sub(left));
            row < 7 && column < 5 && FONT[digit][row] >> (4 - column) & 1 == 1
        };
        for pixel in 0..256 {
            pictures.push(f32::from(ink(pixel / 16, pixel % 16)) + 0.2 * random.normal() as f32);
        }
        digits.push(digit as f32);
    }
    (Tensor::from_vec([n, 16, 16, 1], pictures), Tensor::from_vec([n], digits))
}

/// Two convolutions, each followed by pooling, and a linear layer.
struct Network {
    convolutions: [Conv; 2],
    head: Linear,
}

impl Network {
    fn new(b: &mut Builder<f32>) -> Self {
        let mut conv =
            |name: &str, channels| Conv::new(&mut b.at(name), channels, 3, Conv2d::padded(1), ConvStart::FanInWithBias);
        let convolutions = [conv("first", [1, 16]), conv("second", [16, 32])];
        Network { convolutions, head: Linear::new(&mut b.at("head"), [512, 10], Init::FanIn(512), true) }
    }

    /// Logits `[n, 10]` of pictures `[n, 16, 16, 1]`.
    fn forward(&self, c: &Context<f32>, pictures: Tensor<f32>) -> Var<f32> {
        let n = pictures.dims()[0];
        let maps = self
            .convolutions
            .iter()
            .fold(Var::constant(pictures), |x, conv| conv.forward(c, &x).relu().max_pool2d(2, 2, 0));
        self.head.forward(c, &maps.reshape([n, 512]))
    }
}

pub fn main() {
    let mut params = Params::new();
    let network = Network::new(&mut Builder::new(&mut params, &mut Random::new(0, 0)));
    let mut adamw = AdamW::new(&params);
    let mut random = Random::new(0, 1);
    let start = std::time::Instant::now();
    for step in 1..=300 {
        let (pictures, digits) = draw(64, &mut random);
        let tape = Tape::new();
        let c = Context::training(&params, &tape, Random::new(0, 0));
        let loss = network.forward(&c, pictures).cross_entropy(&digits);
        let gradients = c.gradients(&mut loss.backward());
        adamw.step(&mut params, &gradients, |_| Group { learning_rate: 2e-3, decay: 0.0 });
        if step % 50 == 0 {
            println!("step {step}: cross-entropy {:.3}", loss.value().item());
        }
    }
    println!("300 steps in {:.2} seconds", start.elapsed().as_secs_f64());
    let (pictures, digits) = draw(1000, &mut random);
    let logits = network.forward(&Context::inference(&params), pictures);
    let [_, read] = logits.max(1, 1);
    let right = read.value().data().iter().zip(digits.data()).filter(|(a, b)| a == b).count();
    println!("{right} of 1000 new digits are read right");
    assert!(right > 900, "the network did not learn");
}
