//! The parameters of a network in one flat vector: name, shape, range and initial distribution of each.

use std::ops::Range;

use rand::{Rng, RngExt};

use super::real::Real;

/// Initial distribution of a parameter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Init {
    /// All equal.
    Constant(f64),
    /// Uniform in [-bound, bound].
    Uniform(f64),
    /// Normal with mean 0 and this standard deviation.
    Normal(f64),
}

/// One named tensor.
#[derive(Clone, Debug, PartialEq)]
pub struct Parameter {
    /// `PyTorch`'s name, as in the golden files: `agent.fc.weight`.
    pub name: String,
    /// `PyTorch`'s shape; row-major.
    pub shape: Vec<usize>,
    /// Range in the flat vector.
    pub range: Range<usize>,
    init: Init,
}

/// The parameters of a network, in the order of its flat vector.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ParameterLayout {
    parameters: Vec<Parameter>,
}

/// The parameters of a network, and the forms derived from them that products use. Each layer's `prepare` writes its own forms.
#[derive(Clone, Copy, Debug)]
pub struct Weights<'a, T> {
    /// The parameters, as one flat vector.
    pub params: &'a [T],
    /// Transposed weights, differences of weights and sums of biases, each at the range of a parameter in `params`.
    pub prepared: &'a [T],
}

impl ParameterLayout {
    /// Appends a parameter and returns its offset.
    pub fn add(&mut self, name: impl Into<String>, shape: &[usize], init: Init) -> usize {
        let start = self.len();
        let range = start..start + shape.iter().product::<usize>();
        self.parameters.push(Parameter { name: name.into(), shape: shape.to_vec(), range, init });
        start
    }

    /// Multiplies the initial values of the parameters whose names begin with `prefix` by `factor`.
    pub fn scale_init(&mut self, prefix: &str, factor: f64) {
        for p in self.parameters.iter_mut().filter(|p| p.name.starts_with(prefix)) {
            let (Init::Constant(x) | Init::Uniform(x) | Init::Normal(x)) = &mut p.init;
            *x *= factor;
        }
    }

    /// Length of the flat vector.
    pub fn len(&self) -> usize {
        self.parameters.last().map_or(0, |p| p.range.end)
    }

    /// Whether there is no parameter.
    pub fn is_empty(&self) -> bool {
        self.parameters.is_empty()
    }

    /// All parameters, in order.
    pub fn parameters(&self) -> &[Parameter] {
        &self.parameters
    }

    /// Draws every parameter, in order.
    pub fn initialise<T: Real>(&self, rng: &mut impl Rng) -> Vec<T> {
        let mut params = Vec::with_capacity(self.len());
        for p in &self.parameters {
            for _ in p.range.clone() {
                params.push(T::from_f64(match p.init {
                    Init::Constant(x) => x,
                    Init::Uniform(bound) => bound * (2.0 * rng.random::<f64>() - 1.0),
                    Init::Normal(deviation) => {
                        // Box-Muller transform; 1 - u is never 0.
                        let (u, angle) = (1.0 - rng.random::<f64>(), std::f64::consts::TAU * rng.random::<f64>());
                        deviation * (-2.0 * u.ln()).sqrt() * angle.cos()
                    }
                }));
            }
        }
        params
    }
}
