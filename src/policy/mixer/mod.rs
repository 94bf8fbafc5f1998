//! Mixers (spec 4): the UAVs' values become one per slot. Used in training only.
//!
//! The weights of a mixing network depend on the state and never on the values, and enter as absolute values, so Q_tot
//! does not fall when any Q_i rises.

mod hyper_net;
mod invariant;
mod qmix;

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use self::invariant::{Invariant, InvariantCache};
use self::qmix::{Qmix, QmixCache};
use super::agent::Dims;
use crate::nn::{Batch, ParameterLayout, Real, Rows, RowsMut, Weights};

/// E, the width of the mixing layer.
const E: usize = 32;

/// How the UAVs' values become joint values.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum MixerKind {
    /// Hypernetworks on the flat state.
    Qmix,
    /// Hypernetworks on a permutation-invariant summary of the state.
    Invariant,
    /// The sum.
    Vdn,
    /// No mixing: each UAV has its own target (`iql`).
    None,
}

/// A mixing network and where its parameters lie.
#[derive(Clone, Copy, Debug)]
pub struct Mixer {
    uavs: usize,
    net: Net,
}

#[derive(Clone, Copy, Debug)]
enum Net {
    Qmix(Qmix),
    Invariant(Invariant),
    Vdn,
    None,
}

/// Activations of one forward pass.
#[derive(Debug, Default)]
pub struct MixerCache<T: Real> {
    qmix: QmixCache<T>,
    invariant: InvariantCache<T>,
}

impl Mixer {
    /// Adds `mixer.*` to the layout.
    pub fn new(kind: MixerKind, dims: &Dims, layout: &mut ParameterLayout) -> Self {
        let net = match kind {
            MixerKind::Qmix => Net::Qmix(Qmix::new(layout, dims)),
            MixerKind::Invariant => Net::Invariant(Invariant::new(layout, dims)),
            MixerKind::Vdn => Net::Vdn,
            MixerKind::None => Net::None,
        };
        Self { uavs: dims.uavs, net }
    }

    /// Joint values per slot: 1, or M when nothing is mixed.
    pub fn values(&self) -> usize {
        if matches!(self.net, Net::None) { self.uavs } else { 1 }
    }

    /// See [`crate::nn::Weights`].
    pub fn prepare<T: Real>(&self, flat: &[T], transposed: &mut [T]) {
        match &self.net {
            Net::Qmix(net) => net.prepare(flat, transposed),
            Net::Invariant(net) => net.prepare(flat, transposed),
            Net::Vdn | Net::None => {}
        }
    }

    /// `total` from flat states (spec 2.3) and the UAVs' values, one row per slot each.
    pub fn forward<T: Real>(
        &self,
        w: Weights<'_, T>,
        (states, q): (Rows<'_, T>, Rows<'_, T>),
        c: &mut MixerCache<T>,
        total: RowsMut<'_, T>,
    ) {
        match &self.net {
            Net::Qmix(net) => net.forward(w, states, q, &mut c.qmix, total.data),
            Net::Invariant(net) => net.forward(w, states, q, &mut c.invariant, total.data),
            Net::Vdn => {
                for (total, q) in total.data.iter_mut().zip(q.data.chunks_exact(self.uavs)) {
                    *total = q.iter().fold(T::ZERO, |sum, &q| sum + q);
                }
            }
            Net::None => total.data.copy_from_slice(q.data),
        }
    }

    /// Adds the gradients of the parameters and writes those of the values. Spoils the cache.
    pub fn backward<T: Real>(
        &self,
        w: Weights<'_, T>,
        (states, q): (Rows<'_, T>, Rows<'_, T>),
        c: &mut MixerCache<T>,
        d_total: &[T],
        (grads, dq): (&mut [T], &mut Batch<T>),
    ) {
        dq.reset(self.uavs, q.len);
        match &self.net {
            Net::Qmix(net) => net.backward(w, (states, q), &mut c.qmix, d_total, (grads, dq)),
            Net::Invariant(net) => net.backward(w, (states, q), &mut c.invariant, d_total, (grads, dq)),
            Net::Vdn => {
                for (dq, &d) in dq.as_mut_slice().chunks_exact_mut(self.uavs).zip(d_total) {
                    dq.fill(d);
                }
            }
            Net::None => dq.as_mut_slice().copy_from_slice(d_total),
        }
    }
}

/// -1, 0 or 1.
#[inline(always)]
fn sign<T: Real>(x: T) -> T {
    if x > T::ZERO {
        T::ONE
    } else if x < T::ZERO {
        -T::ONE
    } else {
        T::ZERO
    }
}

/// Derivative of the ELU, from its output.
#[inline(always)]
fn elu_slope<T: Real>(y: T) -> T {
    if y > T::ZERO { T::ONE } else { y + T::ONE }
}
