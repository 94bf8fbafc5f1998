//! The inputs of a node's network: observation, last action, identity, own position (docs/model.md, "Observations").

use super::config::{AgentConfig, Identity, TOKEN};
use super::geometry::{Geometry, NodeView};
use super::goals::Goals;
use super::hop_search::HopSearch;
use crate::nn::{Embedding, EmbeddingParams, HIDDEN, ParameterLayout, Real, Rows, Weights, simd};

/// Last action of a UAV in slot 0.
pub const NO_ACTION: u8 = u8::MAX;

/// A batch of inputs: the geometry, and the other inputs of each UAV row.
#[derive(Clone, Copy, Debug)]
pub struct Inputs<'a> {
    /// Detections; the first rows are the UAVs.
    pub geometry: &'a Geometry,
    /// Goals and advice per UAV row; empty without a memory.
    pub goals: &'a Goals,
    /// The only heading of each UAV row whose Q-value is needed; absent if all are. Q-values of other headings are then those without
    /// goals.
    pub needed: Option<&'a [u8]>,
    /// Last action per UAV row, [`NO_ACTION`] in slot 0.
    pub last: &'a [u8],
    /// Identity token per UAV row; used with identity `token`.
    pub identity_token: &'a [f32],
    /// Own position (x, y) per UAV row; used with `self_position`.
    pub position: &'a [f32],
}

/// Writes the flat observation of one node, of width 2M + 3N (docs/model.md, "Flat observation"). Relative positions are multiplied
/// by `scale`.
pub fn flat_observation<T: Real>(view: &NodeView<'_>, scale: f64, out: &mut [T]) {
    out.fill(T::ZERO);
    let uavs = view.fleet.uavs;
    let scaled = |x: f32| T::from_f64(f64::from(x) * scale);
    let (detected_uavs, detected_users) = out.split_at_mut(2 * uavs);
    let mut user = |j: usize, rel: [f32; 2]| {
        detected_users[3 * j..3 * j + 3].copy_from_slice(&[
            scaled(rel[0]),
            scaled(rel[1]),
            T::from_f64(view.aoi_scaled[j].into()),
        ]);
    };
    if view.node >= uavs {
        user(view.node - uavs, [0.0; 2]);
    }
    for d in view.detections {
        let target = d.target as usize;
        match target.checked_sub(uavs) {
            Some(j) => user(j, d.rel),
            None => detected_uavs[2 * target..2 * target + 2].copy_from_slice(&d.rel.map(scaled)),
        }
    }
}

/// Writes the flat state of a fleet, of width 2M + 3N (docs/model.md, "Flat state"). `aoi` is in slots, `episode_slots` is K.
pub fn flat_state<T: Real>(uav_xy: &[f32], user_xy: &[f32], aoi: &[f32], episode_slots: usize, out: &mut [T]) {
    let (uavs, users) = out.split_at_mut(uav_xy.len());
    uavs.iter_mut().zip(uav_xy).for_each(|(s, &x)| *s = T::from_f64(x.into()));
    for (user, (xy, a)) in users.chunks_exact_mut(3).zip(user_xy.chunks_exact(2).zip(aoi)) {
        user.copy_from_slice(&[
            T::from_f64(xy[0].into()),
            T::from_f64(xy[1].into()),
            T::from_f64((a / episode_slots as f32).into()),
        ]);
    }
}

/// Writes the part of a UAV's input that follows the observation: last action, identity, own position, advice (docs/model.md, "UAV
/// input").
pub(super) fn write_action_identity_position<T: Real>(
    config: &AgentConfig,
    actions: usize,
    inputs: &Inputs<'_>,
    row: usize,
    out: &mut [T],
) {
    out.fill(T::ZERO);
    let (last, rest) = out.split_at_mut(actions);
    if inputs.last[row] != NO_ACTION {
        last[inputs.last[row] as usize] = T::ONE;
    }
    let (fleet, uav) = inputs.geometry.node_of_row(row);
    let identity = identity_width(config.identity, fleet.uavs);
    let (own, rest) = rest.split_at_mut(identity);
    let (position, advice) = rest.split_at_mut(if config.self_position { 2 } else { 0 });
    match config.identity {
        Identity::None => {}
        Identity::Onehot => own[uav] = T::ONE,
        Identity::Phase => {
            let angle = inputs.geometry.sector(fleet, uav).angle;
            own.copy_from_slice(&[T::from_f64(angle.cos()), T::from_f64(angle.sin())]);
        }
        Identity::Token => {
            let token = &inputs.identity_token[row * TOKEN..][..TOKEN];
            own.iter_mut().zip(token).for_each(|(o, &t)| *o = T::from_f64(t.into()));
        }
    }
    if config.self_position {
        let own = &inputs.position[2 * row..][..2];
        let scale = T::from_f64(if config.normalise { 2.0 } else { 1.0 });
        position.iter_mut().zip(own).for_each(|(o, &p)| *o = (T::from_f64(p.into()) - T::from_f64(0.5)) * scale);
    }
    if let Some(&heading) = inputs.goals.advice().get(row) {
        advice[usize::from(heading)] = T::ONE;
    }
}

/// Width of the identity in a fleet of `uavs` UAVs.
pub(super) fn identity_width(identity: Identity, uavs: usize) -> usize {
    match identity {
        Identity::Onehot => uavs,
        Identity::Phase => 2,
        Identity::Token => TOKEN,
        Identity::None => 0,
    }
}

/// The set observation: sums of embeddings of detected UAVs and of detected users (docs/model.md, "Set observation").
#[derive(Clone, Copy, Debug)]
pub struct SetEncoder {
    uav: Embedding<2>,
    user: Embedding<3>,
}

impl SetEncoder {
    /// Width of the observation.
    pub const WIDTH: usize = 2 * HIDDEN;

    pub(super) fn new(layout: &mut ParameterLayout, name: &str) -> Self {
        let uav = Embedding::new(layout, &format!("{name}.uav"));
        Self { uav, user: Embedding::new(layout, &format!("{name}.user")) }
    }

    pub(super) fn prepare<T: Real>(&self, params: &[T], prepared: &mut [T]) {
        self.uav.prepare(params, prepared);
        self.user.prepare(params, prepared);
    }

    /// Writes the observations of rows `first` and following to the first columns of `out`, whose rows are `stride` apart.
    pub(super) fn forward<T: Real>(
        &self,
        w: Weights<'_, T>,
        (geometry, first): (&Geometry, usize),
        search: &mut HopSearch,
        (out, stride): (&mut [T], usize),
    ) {
        let (uav, user) = (self.uav.params(w), self.user.params(w));
        simd(
            #[inline(always)]
            || {
                for (r, out) in out.chunks_exact_mut(stride).enumerate() {
                    let [uavs, users] = out[..Self::WIDTH].as_chunks_mut::<HIDDEN>().0 else { unreachable!("two halves") };
                    encode(&geometry.view_of_row(first + r, search), (&uav, &user), (uavs, users));
                }
            },
        );
    }

    /// Adds the gradients of the parameters, given those of the observations of rows `first` and following.
    pub(super) fn backward<T: Real>(
        &self,
        w: Weights<'_, T>,
        (geometry, first): (&Geometry, usize),
        search: &mut HopSearch,
        d: Rows<'_, T>,
        grads: &mut [T],
    ) {
        let (uav, user) = (self.uav.params(w), self.user.params(w));
        let (mut uav_sums, mut user_sums) = (EmbeddingParams::zero(), EmbeddingParams::zero());
        simd(
            #[inline(always)]
            || {
                for (r, d) in d.data.chunks(d.stride).take(d.len).enumerate() {
                    let [uavs, users] = d[..Self::WIDTH].as_chunks::<HIDDEN>().0 else { unreachable!("two halves") };
                    let sums = (&mut uav_sums, &mut user_sums);
                    encode_back(&geometry.view_of_row(first + r, search), (&uav, &user), (uavs, users), sums);
                }
            },
        );
        self.uav.add_grads(&uav_sums, grads);
        self.user.add_grads(&user_sums, grads);
    }
}

#[inline(always)]
fn encode<T: Real>(
    view: &NodeView<'_>,
    (uav, user): (&EmbeddingParams<T, 2>, &EmbeddingParams<T, 3>),
    (uav_sum, user_sum): (&mut [T; HIDDEN], &mut [T; HIDDEN]),
) {
    let (mut uavs, mut users) = ([T::ZERO; HIDDEN], [T::ZERO; HIDDEN]);
    for_each_detected(view, |point| uav.add(point, &mut uavs), |point| user.add(point, &mut users));
    *uav_sum = uavs;
    *user_sum = users;
}

#[inline(always)]
fn encode_back<T: Real>(
    view: &NodeView<'_>,
    (uav, user): (&EmbeddingParams<T, 2>, &EmbeddingParams<T, 3>),
    (d_uav, d_user): (&[T; HIDDEN], &[T; HIDDEN]),
    (uav_sums, user_sums): (&mut EmbeddingParams<T, 2>, &mut EmbeddingParams<T, 3>),
) {
    for_each_detected(view, |point| uav.backward(point, d_uav, uav_sums), |point| user.backward(point, d_user, user_sums));
}

/// Calls `uav` or `user` for every node that the view's node detects. A user also observes itself.
#[inline(always)]
fn for_each_detected<T: Real>(view: &NodeView<'_>, mut uav: impl FnMut([T; 2]), mut user: impl FnMut([T; 3])) {
    let (m, scale) = (view.fleet.uavs, view.fleet.scale);
    let aoi = |node: usize| T::from_f64(view.aoi_scaled[node - m].into());
    if view.node >= m {
        user([T::ZERO, T::ZERO, aoi(view.node)]);
    }
    for d in view.detections {
        let [x, y] = d.rel.map(|x| T::from_f64(f64::from(x) * scale));
        let target = d.target as usize;
        if target < m {
            uav([x, y]);
        } else {
            user([x, y, aoi(target)]);
        }
    }
}
