//! The hypernetworks of the mixers: Linear, ReLU, Linear.

use crate::nn::{Batch, Linear, ParameterLayout, Real, Rows, Weights, matmul::Accumulate, relu, relu_back};

#[derive(Clone, Copy, Debug)]
pub(super) struct HyperNet {
    pub(super) first: Linear,
    pub(super) last: Linear,
}

#[derive(Debug, Default)]
pub(super) struct HyperNetCache<T: Real> {
    pub(super) hidden: Batch<T>,
    /// The output; before backward the caller replaces it by its gradient.
    pub(super) out: Batch<T>,
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

    pub(super) fn prepare<T: Real>(&self, flat: &[T], transposed: &mut [T]) {
        self.first.prepare(flat, transposed);
        self.last.prepare(flat, transposed);
    }

    pub(super) fn forward<T: Real>(&self, w: Weights<'_, T>, x: Rows<'_, T>, c: &mut HyperNetCache<T>) {
        c.hidden.reset(self.first.outputs, x.len);
        self.first.forward(w, x, c.hidden.rows_mut());
        self.finish(w, c);
    }

    /// The rest of the forward pass, from the output of the first layer in `hidden`.
    pub(super) fn finish<T: Real>(&self, w: Weights<'_, T>, c: &mut HyperNetCache<T>) {
        relu(c.hidden.as_mut_slice());
        c.out.reset(self.last.outputs, c.hidden.len());
        self.last.forward(w, c.hidden.rows(), c.out.rows_mut());
    }

    pub(super) fn backward<T: Real>(&self, flat: &[T], x: Rows<'_, T>, c: &mut HyperNetCache<T>, grads: &mut [T]) {
        self.backward_last(flat, c, grads);
        self.first.backward(flat, x, c.d_first.rows(), grads, None);
    }

    /// Backward up to the output of the first layer.
    pub(super) fn backward_last<T: Real>(&self, flat: &[T], c: &mut HyperNetCache<T>, grads: &mut [T]) {
        c.d_first.reset(self.first.outputs, c.hidden.len());
        self.last.backward(flat, c.hidden.rows(), c.out.rows(), grads, Some(c.d_first.rows_mut()));
        relu_back(c.hidden.as_slice(), c.d_first.as_mut_slice());
    }

    /// After backward: adds the gradient of the input to `dx`.
    pub(super) fn backward_input<T: Real>(&self, flat: &[T], c: &HyperNetCache<T>, dx: &mut Batch<T>) {
        self.first.backward_input(flat, (0, self.first.inputs), c.d_first.rows(), dx.rows_mut(), Accumulate::Add);
    }
}
