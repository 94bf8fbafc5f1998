//! Why a UAV takes its heading: how the Q-value of that heading changes when something that it detects is left out, or what another UAV tells
//! it (docs/model.md, "Explanations").

use super::{Carry, EnvParams, FleetGraph, FleetProfile, FleetStep, Policy};

/// What one detection or message means for the heading of a UAV.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Influence {
    /// The UAV.
    pub uav: u32,
    /// What is left out: a node that the UAV detects, or the UAV whose message it is. UAVs come before users.
    pub node: u32,
    /// Whether it is the message of the node, not its detection.
    pub message: bool,
    /// The Q-value of the heading minus that without the detection or message. Positive: it speaks for the heading.
    pub change: f32,
}

/// A fleet in a slot that was decided.
#[derive(Clone, Copy)]
pub struct DecidedSlot<'a> {
    /// The world.
    pub env: EnvParams,
    /// What the nodes detect.
    pub graph: &'a FleetGraph,
    /// The slot.
    pub step: u64,
    /// How the fleet differs from a usual one.
    pub profile: Option<&'a FleetProfile>,
    /// The memory before the slot.
    pub memory: &'a [f32],
    /// The heading of each UAV.
    pub headings: &'a [u8],
    /// A Q-values per UAV.
    pub q_values: &'a [f32],
}

impl DecidedSlot<'_> {
    /// Number of times that the policy is run to explain the slot.
    pub fn runs(graph: &FleetGraph) -> usize {
        graph.uavs() * graph.uavs() + (0..graph.uavs()).map(|i| graph.detections(i).len()).sum::<usize>()
    }

    /// The influences on each UAV, the strongest first; none if the policy has no Q-values. Messages that change nothing are left out.
    pub fn explain(&self, policy: &dyn Policy) -> Vec<Influence> {
        let (uavs, actions) = (self.graph.uavs(), policy.actions());
        if self.q_values.len() != uavs * actions || self.q_values.iter().any(|q| !q.is_finite()) {
            return Vec::new();
        }
        let place = |i: usize| i * actions + usize::from(self.headings[i]);
        let mut influences = Vec::new();
        for i in 0..uavs {
            for detection in self.graph.detections(i) {
                let without = self.graph.filtered(|node, target| node != i || target != detection.target as usize);
                let q = self.run(policy, &without, self.memory.to_vec())[place(i)];
                let change = self.q_values[place(i)] - q;
                influences.push(Influence { uav: i as u32, node: detection.target, message: false, change });
            }
        }
        for k in 0..uavs {
            // The others still detect the UAV, but it tells them nothing: neither what it detects nor what it remembers.
            let mut silent = self.graph.filtered(|node, target| node != k && (node < uavs || target != k));
            let forgotten = self.forgotten(policy, k);
            for i in (0..uavs).filter(|&i| i != k) {
                // As for a UAV that has not heard of it: the receiver knows the ground around itself anyway.
                silent.place_uav(k, i);
                let change = self.q_values[place(i)] - self.run(policy, &silent, forgotten.clone())[place(i)];
                if change != 0.0 {
                    influences.push(Influence { uav: i as u32, node: k as u32, message: true, change });
                }
            }
        }
        influences.sort_by(|a, b| a.uav.cmp(&b.uav).then(b.change.abs().total_cmp(&a.change.abs())));
        influences
    }

    /// The memory without that of UAV `k`.
    fn forgotten(&self, policy: &dyn Policy, k: usize) -> Vec<f32> {
        let size = (self.graph.uavs(), self.graph.users());
        let mut memory = vec![0.0; self.memory.len()];
        policy.start(size.0, size.1, 0, &mut memory);
        let uavs: Vec<_> = (0..size.0 as u32).filter(|&i| i as usize != k).map(|i| (i, i)).collect();
        let users: Vec<_> = (0..size.1 as u32).map(|j| (j, j)).collect();
        policy.carry(self.memory, &mut memory, &Carry { from: size, to: size, uavs: &uavs, users: &users });
        memory
    }

    fn run(&self, policy: &dyn Policy, graph: &FleetGraph, mut memory: Vec<f32>) -> Vec<f32> {
        let mut headings = self.headings.to_vec();
        let mut q_values = self.q_values.to_vec();
        policy.act(&mut [FleetStep {
            env: self.env,
            graph,
            step: self.step,
            profile: self.profile,
            memory: &mut memory,
            headings: &mut headings,
            q_values: Some(&mut q_values),
        }]);
        q_values
    }
}
