//! The hypernetworks of the mixers: Linear, ReLU, Linear.

use crate::nn::{Batch, Linear, ParameterLayout, Real, Rows, Weights, matmul::InitialValue, relu, relu_back};

#[derive(Clone, Copy, Debug)]
pub(super) struct HyperNet {
    pub(super) first: Linear,
    pub(super) last: Linear,
}

#[derive(Debug, Default)]
pub(super) struct HyperNetCache<T: Real> {
    pub(super) hidden: Batch<T>,
    /// The output. Before backward, the caller replaces it by its gradient.
    pub(super) output_or_grad: Batch<T>,
    /// After backward: the gradient at the output of the first layer.
    pub(super) d_first: Batch<T>,
}

impl HyperNet {
    pub(super) fn new(layout: &mut ParameterLayout, name: &str, [inputs, hidden, outputs]: [usize; 3]) -> Self {
        Self {
            first: Linear::new(layout, &format!("{name}.0"), inputs, hidden),
            last: Linear::new(layout, &format!("{name}.2"), hidden, outputs),
        }
    }

    pub(super) fn prepare<T: Real>(&self, params: &[T], prepared: &mut [T]) {
        self.first.prepare(params, prepared);
        self.last.prepare(params, prepared);
    }

    pub(super) fn forward<T: Real>(&self, w: Weights<'_, T>, x: Rows<'_, T>, c: &mut HyperNetCache<T>) {
        c.hidden.resize(self.first.outputs, x.len);
        self.first.forward(w, x, c.hidden.rows_mut());
        self.finish(w, c);
    }

    /// The rest of the forward pass, from the output of the first layer in `hidden`.
    pub(super) fn finish<T: Real>(&self, w: Weights<'_, T>, c: &mut HyperNetCache<T>) {
        relu(c.hidden.as_mut_slice());
        c.output_or_grad.resize(self.last.outputs, c.hidden.len());
        self.last.forward(w, c.hidden.rows(), c.output_or_grad.rows_mut());
    }

    pub(super) fn backward<T: Real>(&self, params: &[T], x: Rows<'_, T>, c: &mut HyperNetCache<T>, grads: &mut [T]) {
        self.backward_last(params, c, grads);
        self.first.backward(params, x, c.d_first.rows(), grads, None);
    }

    /// Backward up to the output of the first layer.
    pub(super) fn backward_last<T: Real>(&self, params: &[T], c: &mut HyperNetCache<T>, grads: &mut [T]) {
        c.d_first.resize(self.first.outputs, c.hidden.len());
        self.last.backward(params, c.hidden.rows(), c.output_or_grad.rows(), grads, Some(c.d_first.rows_mut()));
        relu_back(c.hidden.as_slice(), c.d_first.as_mut_slice());
    }

    /// After backward: adds the gradient of the input to `dx`.
    pub(super) fn backward_input<T: Real>(&self, params: &[T], c: &HyperNetCache<T>, dx: &mut Batch<T>) {
        self.first.backward_input(params, (0, self.first.inputs), c.d_first.rows(), dx.rows_mut(), InitialValue::Previous);
    }
}
