//! QMIX (docs/model.md, "QMIX"), E = 32, s the flat state:
//!
//! ```text
//! W1 = |Linear(64, M E)(relu(Linear(S, 64)(s)))|   b1 = Linear(S, E)(s)
//! w2 = |Linear(64, E)(relu(Linear(S, 64)(s)))|     b2 = Linear(E, 1)(relu(Linear(S, E)(s)))
//! Q_tot = w2 . ELU(q W1 + b1) + b2
//! ```

use super::hyper_net::{HyperNet, HyperNetCache};
use super::mixing::{E, mix, mix_back};
use crate::nn::{Batch, HIDDEN, Linear, ParameterLayout, Real, Rows, Weights, simd};
use crate::policy::agent::Dims;

#[derive(Clone, Copy, Debug)]
pub(super) struct Qmix {
    w1: HyperNet,
    b1: Linear,
    w2: HyperNet,
    b2: HyperNet,
}

#[derive(Debug, Default)]
pub(super) struct QmixCache<T: Real> {
    w1: HyperNetCache<T>,
    w2: HyperNetCache<T>,
    b2: HyperNetCache<T>,
    /// b1, then ELU(q W1 + b1).
    mixed: Batch<T>,
}

impl Qmix {
    pub(super) fn new(layout: &mut ParameterLayout, dims: &Dims) -> Self {
        let states = 2 * dims.uavs + 3 * dims.users;
        Self {
            w1: HyperNet::new(layout, "mixer.w1", [states, HIDDEN, dims.uavs * E]),
            b1: Linear::new(layout, "mixer.b1", states, E),
            w2: HyperNet::new(layout, "mixer.w2", [states, HIDDEN, E]),
            b2: HyperNet::new(layout, "mixer.b2", [states, E, 1]),
        }
    }

    pub(super) fn prepare<T: Real>(&self, params: &[T], prepared: &mut [T]) {
        [&self.w1, &self.w2, &self.b2].iter().for_each(|net| net.prepare(params, prepared));
        self.b1.prepare(params, prepared);
    }

    pub(super) fn forward<T: Real>(
        &self,
        w: Weights<'_, T>,
        states: Rows<'_, T>,
        q: Rows<'_, T>,
        c: &mut QmixCache<T>,
        total: &mut [T],
    ) {
        self.w1.forward(w, states, &mut c.w1);
        self.w2.forward(w, states, &mut c.w2);
        self.b2.forward(w, states, &mut c.b2);
        c.mixed.resize(E, states.len);
        self.b1.forward(w, states, c.mixed.rows_mut());
        let parts = (c.w1.output_or_grad.as_slice(), c.w2.output_or_grad.as_slice(), c.b2.output_or_grad.as_slice());
        simd(
            #[inline(always)]
            || mix(parts, (q.data, q.stride), c.mixed.as_mut_slice(), total),
        );
    }

    pub(super) fn backward<T: Real>(
        &self,
        w: Weights<'_, T>,
        (states, q): (Rows<'_, T>, Rows<'_, T>),
        c: &mut QmixCache<T>,
        d_total: &[T],
        (grads, dq): (&mut [T], &mut Batch<T>),
    ) {
        let (w1, w2) = (c.w1.output_or_grad.as_mut_slice(), c.w2.output_or_grad.as_mut_slice());
        simd(
            #[inline(always)]
            || mix_back((w1, w2, c.mixed.as_mut_slice()), (q.data, q.stride), d_total, dq.as_mut_slice()),
        );
        c.b2.output_or_grad.as_mut_slice().copy_from_slice(d_total);
        self.b1.backward(w.params, states, c.mixed.rows(), grads, None);
        self.w1.backward(w.params, states, &mut c.w1, grads);
        self.w2.backward(w.params, states, &mut c.w2, grads);
        self.b2.backward(w.params, states, &mut c.b2, grads);
    }
}
