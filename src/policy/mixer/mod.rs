//! Mixers compute the joint value Q_tot of a slot from the UAVs' values (docs/model.md, "Mixers"). Used in training only.
//!
//! The weights of a mixing network depend on the state, not on the values, and are used as absolute values. So
//! dQ_tot/dQ_i >= 0.

mod hyper_net;
mod invariant;
mod mixing;
mod qmix;

use serde::{Deserialize, Serialize};

use self::invariant::{Invariant, InvariantCache};
use self::qmix::{Qmix, QmixCache};
use super::agent::Dims;
use crate::nn::{Batch, ParameterLayout, Real, Rows, RowsMut, Weights};

/// How the UAVs' values become joint values.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
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

/// A mixing network and the offsets of its parameters. All but `qmix` mix fleets of any size.
#[derive(Clone, Copy, Debug)]
pub struct Mixer {
    net: Net,
}

#[derive(Clone, Copy, Debug)]
enum Net {
    Qmix(Qmix),
    Invariant(Invariant),
    Vdn,
    None,
}

/// Activations of a forward pass.
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
            MixerKind::Invariant => Net::Invariant(Invariant::new(layout)),
            MixerKind::Vdn => Net::Vdn,
            MixerKind::None => Net::None,
        };
        Self { net }
    }

    /// Whether it mixes fleets of any size, and not only of the size that it was made for.
    pub fn fits_any_fleet(&self) -> bool {
        !matches!(self.net, Net::Qmix(_))
    }

    /// Number of joint values per slot of a fleet of `uavs` UAVs: 1, or M with [`MixerKind::None`].
    pub fn joint_values_per_slot(&self, uavs: usize) -> usize {
        if matches!(self.net, Net::None) { uavs } else { 1 }
    }

    /// See [`crate::nn::Weights`].
    pub fn prepare<T: Real>(&self, params: &[T], prepared: &mut [T]) {
        match &self.net {
            Net::Qmix(net) => net.prepare(params, prepared),
            Net::Invariant(net) => net.prepare(params, prepared),
            Net::Vdn | Net::None => {}
        }
    }

    /// Writes the joint values `total`, from flat states (docs/model.md, "Flat state") and the UAVs' values, one row per slot each.
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
                for (total, q) in total.data.iter_mut().zip(q.data.chunks_exact(q.stride)) {
                    *total = q.iter().fold(T::ZERO, |sum, &q| sum + q);
                }
            }
            Net::None => total.data.copy_from_slice(q.data),
        }
    }

    /// Adds the gradients of the parameters and writes those of the values. Overwrites the cache.
    pub fn backward<T: Real>(
        &self,
        w: Weights<'_, T>,
        (states, q): (Rows<'_, T>, Rows<'_, T>),
        c: &mut MixerCache<T>,
        d_total: &[T],
        (grads, dq): (&mut [T], &mut Batch<T>),
    ) {
        dq.resize(q.stride, q.len);
        match &self.net {
            Net::Qmix(net) => net.backward(w, (states, q), &mut c.qmix, d_total, (grads, dq)),
            Net::Invariant(net) => net.backward(w, (states, q), &mut c.invariant, d_total, (grads, dq)),
            Net::Vdn => {
                for (dq, &d) in dq.as_mut_slice().chunks_exact_mut(q.stride).zip(d_total) {
                    dq.fill(d);
                }
            }
            Net::None => dq.as_mut_slice().copy_from_slice(d_total),
        }
    }
}
