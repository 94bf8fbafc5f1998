//! y = W x + b with W (out, in), as in `PyTorch`. The forward product uses W transposed (in, out).

use super::batch::add_rows;
use super::batch::{Rows, RowsMut};
use super::matmul::{InitialValue, Lhs, Out, Rhs, matmul};
use super::params::{Init, ParameterLayout, Weights};
use super::real::Real;

/// A linear layer: the offsets of its weight and bias in the flat vector.
#[derive(Clone, Copy, Debug)]
pub struct Linear {
    weight: usize,
    bias: usize,
    /// Width of x.
    pub inputs: usize,
    /// Width of y.
    pub outputs: usize,
}

impl Linear {
    /// Adds the parameters `name.weight` and `name.bias`, uniform in +-1/sqrt(inputs).
    pub fn new(layout: &mut ParameterLayout, name: &str, inputs: usize, outputs: usize) -> Self {
        let init = Init::Uniform(1.0 / (inputs as f64).sqrt());
        let weight = layout.add(format!("{name}.weight"), &[outputs, inputs], init);
        let bias = layout.add(format!("{name}.bias"), &[outputs], init);
        Self { weight, bias, inputs, outputs }
    }

    /// Writes the transposed weight to `prepared`.
    pub fn prepare<T: Real>(&self, params: &[T], prepared: &mut [T]) {
        let n = self.inputs * self.outputs;
        transpose(&params[self.weight..][..n], self.inputs, &mut prepared[self.weight..][..n]);
    }

    /// The matrix product of a forward pass over `rows` samples, as (rows, k, columns).
    pub fn product(&self, rows: usize) -> [usize; 3] {
        [rows, self.inputs, self.outputs]
    }

    /// W, (outputs, inputs).
    pub fn weight<'a, T>(&self, params: &'a [T]) -> &'a [T] {
        &params[self.weight..][..self.inputs * self.outputs]
    }

    /// W transposed, (inputs, outputs).
    pub fn weight_transposed<'a, T>(&self, w: Weights<'a, T>) -> &'a [T] {
        &w.prepared[self.weight..][..self.inputs * self.outputs]
    }

    /// b.
    pub fn bias<'a, T>(&self, w: Weights<'a, T>) -> &'a [T] {
        &w.params[self.bias..][..self.outputs]
    }

    /// The place of W, (outputs, inputs), in a vector of parameters, prepared forms or gradients.
    pub fn weight_mut<'a, T>(&self, vector: &'a mut [T]) -> &'a mut [T] {
        &mut vector[self.weight..][..self.inputs * self.outputs]
    }

    /// The place of b in a vector of parameters or gradients.
    pub fn bias_mut<'a, T>(&self, vector: &'a mut [T]) -> &'a mut [T] {
        &mut vector[self.bias..][..self.outputs]
    }

    /// y = W x + b.
    pub fn forward<T: Real>(&self, w: Weights<'_, T>, x: Rows<'_, T>, y: RowsMut<'_, T>) {
        self.forward_part(w, (0, self.inputs), x, y, InitialValue::Bias(self.bias(w)));
    }

    /// y = start + W[:, from..from + width] x, with start from `initial`: the contribution of some inputs.
    pub fn forward_part<T: Real>(
        &self,
        w: Weights<'_, T>,
        (from, width): (usize, usize),
        x: Rows<'_, T>,
        y: RowsMut<'_, T>,
        initial: InitialValue<'_, T>,
    ) {
        debug_assert_eq!(x.len, y.len);
        let b = Rhs { data: &self.weight_transposed(w)[from * self.outputs..], stride: self.outputs };
        let c = Out { data: y.data, stride: y.stride };
        matmul((x.len, width, self.outputs), Lhs::rows(x.data, x.stride), b, c, initial);
    }

    /// Adds the gradients of W and b. Writes dx if it is given.
    pub fn backward<T: Real>(&self, params: &[T], x: Rows<'_, T>, dy: Rows<'_, T>, grads: &mut [T], dx: Option<RowsMut<'_, T>>) {
        self.backward_bias(dy, grads);
        self.backward_part((0, self.inputs), x, dy, grads);
        if let Some(dx) = dx {
            self.backward_input(params, (0, self.inputs), dy, dx, InitialValue::Zero);
        }
    }

    /// Adds the gradient of b.
    pub fn backward_bias<T: Real>(&self, dy: Rows<'_, T>, grads: &mut [T]) {
        add_rows(dy, self.bias_mut(grads));
    }

    /// Adds the gradient of W[:, from..from + width], for as many samples as `dy` has.
    pub fn backward_part<T: Real>(&self, (from, width): (usize, usize), x: Rows<'_, T>, dy: Rows<'_, T>, grads: &mut [T]) {
        debug_assert!(x.len >= dy.len);
        let stride = self.inputs;
        let c = Out { data: &mut self.weight_mut(grads)[from..], stride };
        let b = Rhs { data: x.data, stride: x.stride };
        matmul((self.outputs, dy.len, width), Lhs::transposed(dy.data, dy.stride), b, c, InitialValue::Previous);
    }

    /// dx = start + dy W[:, from..from + width], with start from `initial`.
    pub fn backward_input<T: Real>(
        &self,
        params: &[T],
        (from, width): (usize, usize),
        dy: Rows<'_, T>,
        dx: RowsMut<'_, T>,
        initial: InitialValue<'_, T>,
    ) {
        let b = Rhs { data: &self.weight(params)[from..], stride: self.inputs };
        let c = Out { data: dx.data, stride: dx.stride };
        matmul((dy.len, self.outputs, width), Lhs::rows(dy.data, dy.stride), b, c, initial);
    }
}

/// `to` (columns, rows) = transpose of `from` (rows, columns).
pub(super) fn transpose<T: Real>(from: &[T], columns: usize, to: &mut [T]) {
    let rows = from.len() / columns;
    for (i, row) in from.chunks_exact(columns).enumerate() {
        for (j, &x) in row.iter().enumerate() {
            to[j * rows + i] = x;
        }
    }
}
