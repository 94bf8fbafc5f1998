//! Each UAV decides alone (docs/model.md, "Deciding alone"): from what it observes itself, what it remembers, and the messages of other UAVs.
//!
//! A message has what its UAV observes in the slot and what it remembered before the slot. The receiver runs the policy on the part of the
//! fleet that it knows, itself and the senders, and keeps its own heading and memory. The policy computes every UAV in a fixed order of
//! sums, so the heading has the bits of the joint decision as soon as the messages of all UAVs within [`Policy::reach`] are there.
//!
//! UAVs whose messages are missing keep their places, so that identities and sectors do not shift, but detect nothing and have not
//! remembered anything.

pub mod audit;
mod codec;
mod observation;

pub use codec::{Message, Mission, UavState};
pub use observation::{Observation, OwnDetection};

use super::nodes::mirror;
use super::{GraphForm, ReportedDetection, ReportedGraph, SceneOrGraph, Sensing};
use crate::invalid::Invalid;
use crate::policy::{Carry, EnvParams, FleetGraph, FleetProfile, FleetStep, Policy, Reach, RequiredInput};

/// Largest memory of a whole fleet, in numbers, for which UAVs decide alone: each makes room for all.
const MAX_NUMBERS: usize = 1 << 22;

/// One slot of a fleet, as each UAV knows it without messages.
#[derive(Clone, Copy)]
pub struct Slot<'a> {
    /// The policy of all UAVs.
    pub policy: &'a dyn Policy,
    /// The world.
    pub env: EnvParams,
    /// M and N.
    pub size: (usize, usize),
    /// Seed of the policy's random choices.
    pub seed: u64,
    /// Index of the slot.
    pub step: u64,
}

/// A UAV in a slot: what it observes, and what it remembered before.
#[derive(Clone, Copy, Debug)]
pub struct Member<'a> {
    /// Canonical index.
    pub uav: u32,
    /// What it observes.
    pub observation: &'a Observation,
    /// What it remembers, of the length of a fleet of one UAV and N users.
    pub memory: &'a [f32],
}

/// What a UAV decides.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct DecidedAlone {
    /// Heading index.
    pub heading: u8,
    /// Its Q-values; NaN if the policy has none.
    pub q_values: Vec<f32>,
    /// What it remembers after the slot.
    pub memory: Vec<f32>,
    /// Canonical indices of the UAVs that it detects and whose messages are missing, if the policy needs messages.
    pub missing: Vec<u32>,
}

/// Checks that UAVs of a fleet of this size can decide alone by `policy`.
///
/// # Errors
/// [`Invalid`] if the policy needs all positions or the fleet does not fit.
pub fn check(policy: &dyn Policy, (uavs, users): (usize, usize)) -> Result<(), Invalid> {
    if policy.needs() == RequiredInput::FullScene {
        let expected = "a policy that decides by what UAVs detect; this one needs the positions of all UAVs and users";
        return Err(Invalid::new("policy", "a policy with full information", expected));
    }
    policy.check_fleet(uavs, users)?;
    let numbers = policy.memory_len(uavs, users);
    if numbers > MAX_NUMBERS {
        let expected = format!("a fleet whose memory has at most {MAX_NUMBERS} numbers; this one has {numbers}");
        return Err(Invalid::new("uav_ids", format!("{uavs} UAVs and {users} users"), expected));
    }
    Ok(())
}

/// What UAV `uav` of a fleet remembers in slot 0.
pub fn first_memory(policy: &dyn Policy, size: (usize, usize), seed: u64, uav: u32) -> Vec<f32> {
    let mut all = vec![0.0; policy.memory_len(size.0, size.1)];
    policy.start(size.0, size.1, seed, &mut all);
    memory_of(policy, size, seed, uav, &all)
}

/// What UAV `uav` remembers, of the memory `all` of its fleet.
fn memory_of(policy: &dyn Policy, size: (usize, usize), seed: u64, uav: u32, all: &[f32]) -> Vec<f32> {
    let mut own = vec![0.0; policy.memory_len(1, size.1)];
    policy.start(1, size.1, seed, &mut own);
    policy.carry(all, &mut own, &Carry { from: size, to: (1, size.1), uavs: &[(uav, 0)], users: &all_users(size.1) });
    own
}

fn all_users(users: usize) -> Vec<(u32, u32)> {
    (0..users as u32).map(|j| (j, j)).collect()
}

impl Slot<'_> {
    /// Checks what a UAV observes.
    ///
    /// # Errors
    /// As [`Slot::decide`].
    pub fn check(&self, own: &Member<'_>) -> Result<(), Invalid> {
        self.fleet_graph(own, &[]).map(|_| ()).map_err(|mut error| {
            if let Some((_, rest)) = error.field.split_once("].").filter(|_| error.field.starts_with("graph.nodes[")) {
                error.field = format!("observation.{rest}");
            }
            error
        })
    }

    /// What UAV `own` decides with the messages of `others`, of which none is its own and none is there twice.
    ///
    /// # Errors
    /// [`Invalid`] if an observation lacks what the policy needs, or a detection lies far beyond its range.
    pub fn decide(&self, own: &Member<'_>, others: &[Member<'_>]) -> Result<DecidedAlone, Invalid> {
        let Self { policy, env, size: (uavs, users), seed, step } = *self;
        let graph = self.fleet_graph(own, others)?;
        let mut memory = vec![0.0; policy.memory_len(uavs, users)];
        policy.start(uavs, users, seed, &mut memory);
        let all = all_users(users);
        for member in others.iter().chain([own]) {
            let carry = Carry { from: (1, users), to: self.size, uavs: &[(0, member.uav)], users: &all };
            policy.carry(member.memory, &mut memory, &carry);
        }
        let members = || others.iter().chain([own]);
        let profile = members().any(|member| member.observation.speed.is_some()).then(|| {
            let mut speeds = vec![env.speed; uavs];
            for member in members() {
                speeds[member.uav as usize] = member.observation.speed.unwrap_or(env.speed);
            }
            FleetProfile { speeds, ..FleetProfile::default() }
        });
        let actions = policy.actions();
        let (mut headings, mut q_values) = (vec![0; uavs], vec![f32::NAN; uavs * actions]);
        policy.act(&mut [FleetStep {
            env,
            graph: &graph,
            step,
            profile: profile.as_ref(),
            memory: &mut memory,
            headings: &mut headings,
            q_values: Some(&mut q_values),
        }]);
        let uav = own.uav as usize;
        let needs_messages = policy.reach() != Reach::Links(0);
        let heard = |target: &u32| others.iter().any(|other| other.uav == *target);
        let detected = own.observation.detections.iter().map(|d| d.target).filter(|&target| (target as usize) < uavs);
        Ok(DecidedAlone {
            heading: headings[uav],
            q_values: q_values[uav * actions..][..actions].to_vec(),
            memory: memory_of(policy, self.size, seed, own.uav, &memory),
            missing: detected.filter(|target| needs_messages && !heard(target)).collect(),
        })
    }

    /// What the policy reads. A detection far beyond the range is refused; the sender of a message has checked its own.
    fn fleet_graph(&self, own: &Member<'_>, others: &[Member<'_>]) -> Result<FleetGraph, Invalid> {
        let sensing = Sensing { ranges: self.env.ranges(), symmetric: false, frame: None };
        SceneOrGraph::Graph(self.graph(own, others)?).into_fleet_graph(self.size, self.policy, sensing)
    }

    /// What the members detect. The users report nothing.
    fn graph(&self, own: &Member<'_>, others: &[Member<'_>]) -> Result<ReportedGraph, Invalid> {
        let (uavs, users) = self.size;
        if self.policy.needs() == RequiredInput::OwnPositions && own.observation.position.is_none() {
            return Err(Invalid::missing("observation.position", "the position of the UAV, which this policy needs"));
        }
        let mut graph = ReportedGraph {
            // The position of a UAV that nobody has heard of has no effect.
            positions: vec![own.observation.position; uavs],
            aoi: vec![0.0; users],
            detections: vec![Vec::new(); uavs + users],
            without_detections: vec![true; users],
            request_of_canonical: (0..(uavs + users) as u32).collect(),
            form: GraphForm::Nodes,
        };
        let mut known = vec![false; users];
        for member in others.iter().chain([own]) {
            let Observation { position, detections, .. } = member.observation;
            if position.is_some() {
                graph.positions[member.uav as usize] = *position;
            }
            for detection in detections {
                if let Some(user) = (detection.target as usize).checked_sub(uavs) {
                    let aoi = &mut graph.aoi[user];
                    *aoi = if known[user] { aoi.min(detection.aoi) } else { detection.aoi };
                    known[user] = true;
                }
            }
            graph.detections[member.uav as usize] = detections
                .iter()
                .enumerate()
                .map(|(i, d)| ReportedDetection { target: d.target, rel: d.rel, request_index: i as u32, mirrored: false })
                .collect();
        }
        Ok(mirror(graph))
    }
}
