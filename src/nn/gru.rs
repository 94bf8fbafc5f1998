//! `PyTorch`'s `GRUCell` over time, gates in the order reset, update, new (docs/model.md, "GRU"):
//!
//! ```text
//! r = sigmoid(Wi_r x + bi_r + Wh_r h + bh_r)      z likewise
//! u = Wh_n h + bh_n        n = tanh(Wi_n x + bi_n + r u)        h' = (1 - z) n + z h
//! ```
//!
//! Only Wh h is computed slot by slot. Wi x and the gradients of all weights are one product over all slots. Rows are
//! time-major: of B samples, slot t has rows t B .. (t + 1) B.

use super::HIDDEN as H;
use super::batch::{Batch, Rows, add_rows};
use super::linear::transpose;
use super::matmul::{InitialValue, Lhs, Out, Rhs, matmul};
use super::params::{Init, ParameterLayout, Weights};
use super::real::Real;
use super::simd::simd;

/// Numbers per row: r, z, n, u; after backward, the gradients of their pre-activations.
const GATES: usize = 4 * H;

/// Offsets of the cell's parameters. Input and state have width H.
#[derive(Clone, Copy, Debug)]
pub struct Gru {
    weight_ih: usize,
    weight_hh: usize,
    bias_ih: usize,
    bias_hh: usize,
}

impl Gru {
    /// Adds the parameters `name.weight_ih`, `weight_hh` (3H, H), `bias_ih`, `bias_hh` (3H), uniform in +-1/sqrt(H).
    pub fn new(layout: &mut ParameterLayout, name: &str) -> Self {
        let init = Init::Uniform(1.0 / (H as f64).sqrt());
        let mut add = |part: &str, shape: &[usize]| layout.add(format!("{name}.{part}"), shape, init);
        Self {
            weight_ih: add("weight_ih", &[3 * H, H]),
            weight_hh: add("weight_hh", &[3 * H, H]),
            bias_ih: add("bias_ih", &[3 * H]),
            bias_hh: add("bias_hh", &[3 * H]),
        }
    }

    /// Writes both weights transposed, and in place of `bias_ih` the sum of the two biases of r and of z and the input bias of n.
    pub fn prepare<T: Real>(&self, params: &[T], prepared: &mut [T]) {
        for weight in [self.weight_ih, self.weight_hh] {
            transpose(&params[weight..][..3 * H * H], H, &mut prepared[weight..][..3 * H * H]);
        }
        for i in 0..3 * H {
            let hidden = if i < 2 * H { params[self.bias_hh + i] } else { T::ZERO };
            prepared[self.bias_ih + i] = params[self.bias_ih + i] + hidden;
        }
    }

    /// Writes the states of all slots to `h`, which has (slots + 1) B rows. Its first B rows are the states before slot 0.
    pub fn forward<T: Real>(&self, w: Weights<'_, T>, x: Rows<'_, T>, slots: usize, gates: &mut Batch<T>, h: &mut Batch<T>) {
        let samples = x.len / slots;
        assert_eq!(h.len(), x.len + samples, "one block of states before the first slot");
        gates.resize(GATES, x.len);
        let weight = Rhs { data: &w.prepared[self.weight_ih..][..3 * H * H], stride: 3 * H };
        let bias = InitialValue::Bias(&w.prepared[self.bias_ih..][..3 * H]);
        let all = Out { data: gates.as_mut_slice(), stride: GATES };
        matmul((x.len, H, 3 * H), Lhs::rows(x.data, x.stride), weight, all, bias);
        let weight = &w.prepared[self.weight_hh..][..3 * H * H];
        let bias = &w.params[self.bias_hh + 2 * H..][..H];
        for (gates, t) in gates.as_mut_slice().chunks_exact_mut(samples * GATES).zip(0..) {
            let (before, after) = h.as_mut_slice()[t * samples * H..].split_at_mut(samples * H);
            let lhs = Lhs::rows(before, H);
            matmul(
                (samples, H, 2 * H),
                lhs,
                Rhs { data: weight, stride: 3 * H },
                Out { data: gates, stride: GATES },
                InitialValue::Previous,
            );
            let u = Out { data: &mut gates[3 * H..], stride: GATES };
            matmul((samples, H, H), lhs, Rhs { data: &weight[2 * H..], stride: 3 * H }, u, InitialValue::Bias(bias));
            simd(
                #[inline(always)]
                || step(gates, before, &mut after[..samples * H]),
            );
        }
    }

    /// Adds the gradients of the weights. `dh` holds the gradient of each slot's state from the layers above on entry, and the
    /// total gradient on return. `gates` holds gradients on return, from which [`Gru::backward_input`] computes dx.
    pub fn backward<T: Real>(
        &self,
        params: &[T],
        (x, slots): (Rows<'_, T>, usize),
        h: &Batch<T>,
        (gates, dh): (&mut Batch<T>, &mut Batch<T>),
        grads: &mut [T],
    ) {
        let samples = x.len / slots;
        let weight = &params[self.weight_hh..][..3 * H * H];
        for t in (0..slots).rev() {
            let gates = &mut gates.as_mut_slice()[t * samples * GATES..][..samples * GATES];
            let (earlier, now) = dh.as_mut_slice().split_at_mut(t * samples * H);
            let now = &now[..samples * H];
            let before = &h.as_slice()[t * samples * H..][..samples * H];
            let first = t == 0;
            let carry = if first { &mut [][..] } else { &mut earlier[(t - 1) * samples * H..] };
            simd(
                #[inline(always)]
                || step_back(gates, before, now, carry),
            );
            if !first {
                let rz_weight = Rhs { data: weight, stride: H };
                matmul(
                    (samples, 2 * H, H),
                    Lhs::rows(gates, GATES),
                    rz_weight,
                    Out { data: carry, stride: H },
                    InitialValue::Previous,
                );
                let u_weight = Rhs { data: &weight[2 * H * H..], stride: H };
                matmul(
                    (samples, H, H),
                    Lhs::rows(&gates[3 * H..], GATES),
                    u_weight,
                    Out { data: carry, stride: H },
                    InitialValue::Previous,
                );
            }
        }
        let d = gates.as_slice();
        let len = x.len;
        let hidden = |d, width, grads: &mut [T]| {
            let before = Rhs { data: h.as_slice(), stride: H };
            matmul((width, len, H), Lhs::transposed(d, GATES), before, Out { data: grads, stride: H }, InitialValue::Previous);
        };
        hidden(d, 2 * H, &mut grads[self.weight_hh..]);
        hidden(&d[3 * H..], H, &mut grads[self.weight_hh + 2 * H * H..]);
        let input = Rhs { data: x.data, stride: x.stride };
        let out = Out { data: &mut grads[self.weight_ih..], stride: H };
        matmul((3 * H, len, H), Lhs::transposed(d, GATES), input, out, InitialValue::Previous);
        let rows = |from: usize| Rows { data: &d[from..], stride: GATES, len };
        add_rows(rows(0), &mut grads[self.bias_ih..][..3 * H]);
        add_rows(rows(0), &mut grads[self.bias_hh..][..2 * H]);
        add_rows(rows(3 * H), &mut grads[self.bias_hh + 2 * H..][..H]);
    }

    /// After [`Gru::backward`]: writes the gradient of x.
    pub fn backward_input<T: Real>(&self, params: &[T], gates: &Batch<T>, dx: &mut Batch<T>) {
        dx.resize(H, gates.len());
        let weight = Rhs { data: &params[self.weight_ih..][..3 * H * H], stride: H };
        let out = Out { data: dx.as_mut_slice(), stride: H };
        matmul((gates.len(), 3 * H, H), Lhs::rows(gates.as_slice(), GATES), weight, out, InitialValue::Zero);
    }
}

#[inline(always)]
fn step<T: Real>(gates: &mut [T], before: &[T], after: &mut [T]) {
    let states = before.as_chunks::<H>().0.iter().zip(after.as_chunks_mut::<H>().0);
    for (gates, (h, next)) in gates.as_chunks_mut::<GATES>().0.iter_mut().zip(states) {
        let [r, z, n, u] = gates.as_chunks_mut::<H>().0 else { unreachable!("four parts") };
        for c in 0..H {
            r[c] = r[c].sigmoid();
            z[c] = z[c].sigmoid();
            n[c] = r[c].mul_add(u[c], n[c]).tanh();
            next[c] = z[c].mul_add(h[c] - n[c], n[c]);
        }
    }
}

/// Replaces the gates by their gradients. Adds the gradient that flows through z h to the slot before to `carry`, if it exists.
#[inline(always)]
fn step_back<T: Real>(gates: &mut [T], before: &[T], dh: &[T], carry: &mut [T]) {
    let states = before.as_chunks::<H>().0.iter().zip(dh.as_chunks::<H>().0);
    let mut carry = carry.as_chunks_mut::<H>().0.iter_mut();
    for (gates, (h, dh)) in gates.as_chunks_mut::<GATES>().0.iter_mut().zip(states) {
        let [r, z, n, u] = gates.as_chunks_mut::<H>().0 else { unreachable!("four parts") };
        if let Some(carry) = carry.next() {
            for c in 0..H {
                carry[c] = dh[c].mul_add(z[c], carry[c]);
            }
        }
        for c in 0..H {
            let (rc, zc, nc) = (r[c], z[c], n[c]);
            let open = T::ONE - zc;
            let dn = dh[c] * open * (T::ONE - nc * nc);
            r[c] = dn * u[c] * rc * (T::ONE - rc);
            z[c] = dh[c] * (h[c] - nc) * zc * open;
            n[c] = dn;
            u[c] = dn * rc;
        }
    }
}
