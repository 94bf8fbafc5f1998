//! The locality audit: does each UAV, alone with its own sensors and the messages that the policy says it needs, decide what the joint
//! policy decides?
//!
//! The fleet flies the joint decisions, computed from what all UAVs detect as in `Act` with a graph. In every slot each UAV also decides
//! alone, several times: with the messages of the UAVs within 0, 1, ... links. Each of these trials has memories of its own, so a wrong
//! memory shows later. A policy passes if the trial with the reach that it declares has the bits of the joint decision every time.

use super::codec::Message;
use super::observation::{Observation, OwnDetection};
use super::{Member, Slot, check, first_memory};
use crate::env::{BatchEnv, EnvConfig, Point, points};
use crate::invalid::Invalid;
use crate::policy::{EnvParams, FleetGraph, FleetStep, Policy, Reach};
use crate::serving::nodes::{Node, NodeDetection};
use crate::serving::{FleetInput, FleetMemory, Sensing};

/// The result of an audit.
#[derive(Clone, Debug, PartialEq)]
pub struct Audit {
    /// What the policy declares.
    pub reach: Reach,
    /// Distance within which all senders are, in units of the square's side; `None`: any distance.
    pub range: Option<f64>,
    /// Number of UAVs times number of slots that were compared.
    pub decisions: u64,
    /// With the messages of the UAVs within 0, 1, ... links, up to those that the policy declares; last, if it declares all, with all.
    pub trials: Vec<Trial>,
    /// Decisions of `Act` with a scene that have the heading of `Act` with a graph. In a scene, users also detect each other where no UAV
    /// detects both.
    pub scene_equal: u64,
    /// Size of the messages in bytes.
    pub mean_bytes: f64,
    /// The largest message.
    pub max_bytes: usize,
    /// Mean AoI of the flights, in slots.
    pub mean_aoi: f64,
}

/// UAVs that decide alone with the messages of some others.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Trial {
    /// Whose: of the UAVs within so many links; `None`: of all.
    pub links: Option<usize>,
    /// Decisions with the heading of the joint decision.
    pub equal: u64,
    /// Decisions in which the Q-values also have its bits.
    pub same_bits: u64,
    /// Messages received.
    pub received: u64,
}

impl Audit {
    /// Whether each UAV decides alone as jointly, with messages of UAVs within a fixed number of links.
    pub fn passed(&self) -> bool {
        let complete = |trial: &Trial| trial.same_bits == self.decisions;
        matches!(self.reach, Reach::Links(_)) && self.trials.last().is_some_and(complete)
    }

    fn add(&mut self, other: &Self, episodes: usize) {
        let before = self.decisions as f64;
        self.decisions += other.decisions;
        for (mine, theirs) in self.trials.iter_mut().zip(&other.trials) {
            mine.equal += theirs.equal;
            mine.same_bits += theirs.same_bits;
            mine.received += theirs.received;
        }
        self.scene_equal += other.scene_equal;
        self.mean_bytes = (self.mean_bytes * before + other.mean_bytes * other.decisions as f64) / self.decisions as f64;
        self.max_bytes = self.max_bytes.max(other.max_bytes);
        self.mean_aoi += other.mean_aoi / episodes as f64;
    }
}

/// Audits `policy` on the episodes with these seeds, split among `threads`.
///
/// # Errors
/// The policy needs the positions of all, or does not fit the environment.
pub fn audit(policy: &dyn Policy, env: &EnvConfig, seeds: &[u64], threads: usize) -> Result<Audit, Invalid> {
    env.validate()?;
    check(policy, (env.uavs, env.users))?;
    let run = |seed: &u64| Episode::new(policy, env, *seed).and_then(Episode::run);
    let mut total = Episode::new(policy, env, 0)?.audit;
    let part_len = seeds.len().div_ceil(threads.max(1)).max(1);
    let parts: Vec<Result<Vec<Audit>, Invalid>> = std::thread::scope(|scope| {
        let start = |part: &'_ [u64]| part.iter().map(run).collect::<Result<Vec<_>, _>>();
        let threads: Vec<_> = seeds.chunks(part_len).map(|part| scope.spawn(move || start(part))).collect();
        threads.into_iter().map(|thread| thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))).collect()
    });
    for part in parts {
        part?.iter().for_each(|audit| total.add(audit, seeds.len()));
    }
    Ok(total)
}

/// One episode.
struct Episode<'a> {
    policy: &'a dyn Policy,
    params: EnvParams,
    env: BatchEnv,
    seed: u64,
    size: (usize, usize),
    audit: Audit,
    /// Memory of the joint policy with a graph, and with a scene.
    joint: [Vec<f32>; 2],
    /// Per trial and UAV.
    alone: Vec<Vec<Vec<f32>>>,
}

impl<'a> Episode<'a> {
    fn new(policy: &'a dyn Policy, config: &EnvConfig, seed: u64) -> Result<Self, Invalid> {
        let (params, size) = (EnvParams::from(config), (config.uavs, config.users));
        let mut env = BatchEnv::new(config, 1)?;
        env.reset(&[seed]);
        let reach = policy.reach();
        let links: Vec<Option<usize>> = match reach {
            Reach::Links(links) => (0..=links).map(Some).collect(),
            Reach::Fleet => vec![Some(0), Some(1), None],
        };
        let trials: Vec<Trial> = links.into_iter().map(|links| Trial { links, ..Trial::default() }).collect();
        let mut memory = vec![0.0; policy.memory_len(size.0, size.1)];
        policy.start(size.0, size.1, seed, &mut memory);
        let first: Vec<_> = (0..size.0 as u32).map(|uav| first_memory(policy, size, seed, uav)).collect();
        let alone = vec![first; trials.len()];
        let audit = Audit {
            reach,
            range: reach.range(&params),
            decisions: 0,
            trials,
            scene_equal: 0,
            mean_bytes: 0.0,
            max_bytes: 0,
            mean_aoi: 0.0,
        };
        Ok(Self { policy, params, env, seed, size, audit, joint: [memory.clone(), memory], alone })
    }

    fn run(mut self) -> Result<Audit, Invalid> {
        let mut bytes = 0;
        while !self.env.done() {
            bytes += self.slot()?;
        }
        self.audit.mean_bytes = bytes as f64 / self.audit.decisions.max(1) as f64;
        self.audit.mean_aoi = self.env.metrics(0).mean_aoi;
        Ok(self.audit)
    }

    /// Decides and flies one slot. Returns the bytes of all messages.
    fn slot(&mut self) -> Result<usize, Invalid> {
        let (uavs, users): (Vec<Point>, Vec<Point>) = (points(self.env.uav_xy()).collect(), points(self.env.user_xy()).collect());
        let aoi = self.env.aoi().to_vec();
        let scene = FleetGraph::from_scene(&uavs, &users, &aoi, self.params.ranges());
        let reported = self.reported(&scene, &uavs, &aoi)?;
        let (joint, joint_q) = self.act(0, &reported);
        let (with_scene, _) = self.act(1, &scene);
        self.audit.scene_equal += joint.iter().zip(&with_scene).filter(|(a, b)| a == b).count() as u64;
        let observations: Vec<Observation> = (0..uavs.len()).map(|i| observation(&scene, i, uavs[i], &aoi)).collect();
        let links: Vec<Vec<usize>> = (0..uavs.len()).map(|i| links_from(&reported, i)).collect();
        let (slot, actions) = (self.as_slot(), self.policy.actions());
        for (t, trial) in self.audit.trials.iter_mut().enumerate() {
            let before = &self.alone[t];
            let member = |i: usize| Member { uav: i as u32, observation: &observations[i], memory: &before[i] };
            let mut after = Vec::with_capacity(uavs.len());
            for i in 0..uavs.len() {
                let heard = |k: &usize| *k != i && trial.links.is_none_or(|reach| links[i][*k] <= reach);
                let others: Vec<Member<'_>> = (0..uavs.len()).filter(heard).map(member).collect();
                let decided = slot.decide(&member(i), &others)?;
                let q = &joint_q[i * actions..][..actions];
                let same = decided.heading == joint[i];
                let bits = decided.q_values.iter().zip(q).all(|(a, b)| a.to_bits() == b.to_bits());
                trial.equal += u64::from(same);
                trial.same_bits += u64::from(same && bits);
                trial.received += others.len() as u64;
                after.push(decided.memory);
            }
            self.alone[t] = after;
        }
        self.audit.decisions += uavs.len() as u64;
        let bytes = self.message_bytes(&observations);
        self.env.step(&joint);
        Ok(bytes)
    }

    fn as_slot(&self) -> Slot<'a> {
        Slot { policy: self.policy, env: self.params, size: self.size, seed: self.seed, step: self.env.slot() as u64 }
    }

    /// The joint decision of `Act`, with memory `which`: headings and Q-values.
    fn act(&mut self, which: usize, graph: &FleetGraph) -> (Vec<u8>, Vec<f32>) {
        let uavs = self.size.0;
        let (mut headings, mut q_values) = (vec![0; uavs], vec![f32::NAN; uavs * self.policy.actions()]);
        self.policy.act(&mut [FleetStep {
            env: self.params,
            graph,
            step: self.env.slot() as u64,
            profile: None,
            memory: &mut self.joint[which],
            headings: &mut headings,
            q_values: Some(&mut q_values),
        }]);
        (headings, q_values)
    }

    /// The graph of a request in which the UAVs report what they detect, and the users nothing.
    fn reported(&self, scene: &FleetGraph, uavs: &[Point], aoi: &[f32]) -> Result<FleetGraph, Invalid> {
        let (m, n) = self.size;
        let id = |node: usize| if node < m { format!("uav-{node}") } else { format!("user-{}", node - m) };
        let node = |node: usize| Node {
            id: id(node),
            is_uav: node < m,
            detections: scene.detections(node)[..if node < m { scene.detections(node).len() } else { 0 }]
                .iter()
                .map(|d| {
                    let target = d.target as usize;
                    NodeDetection {
                        target_id: id(target),
                        rel: d.rel.map(f64::from),
                        aoi: target.checked_sub(m).map(|j| aoi[j].into()),
                    }
                })
                .collect::<Vec<_>>()
                .into_iter(),
            position: uavs.get(node).copied(),
            aoi: None,
            speed: None,
            endurance: None,
        };
        let input = FleetInput::from_nodes((0..m + n).map(node).collect())?;
        input.content.into_fleet_graph(
            self.size,
            self.policy,
            Sensing { ranges: self.params.ranges(), symmetric: false, frame: None },
        )
    }

    fn message_bytes(&mut self, observations: &[Observation]) -> usize {
        let memories = self.alone.last().map_or(&[][..], Vec::as_slice);
        let mut total = 0;
        for (uav, (observation, memory)) in observations.iter().zip(memories).enumerate() {
            let memory = FleetMemory::Plain(memory.clone());
            let message = Message { mission: [0; 16], step: 0, uav: uav as u32, observation: observation.clone(), memory };
            let bytes = message.encode(self.policy, self.size).len();
            self.audit.max_bytes = self.audit.max_bytes.max(bytes);
            total += bytes;
        }
        total
    }
}

/// What UAV `i` at `at` observes in a scene.
fn observation(scene: &FleetGraph, i: usize, at: Point, aoi: &[f32]) -> Observation {
    let uavs = scene.uavs();
    let detection = |d: &crate::policy::Detection| OwnDetection {
        target: d.target,
        rel: d.rel.map(f64::from),
        aoi: (d.target as usize).checked_sub(uavs).map_or(0.0, |user| aoi[user]),
    };
    Observation { position: Some(at), speed: None, detections: scene.detections(i).iter().map(detection).collect() }
}

/// Number of links from UAV `i` to each UAV; `usize::MAX` where there is no path.
fn links_from(graph: &FleetGraph, i: usize) -> Vec<usize> {
    let mut links = vec![usize::MAX; graph.uavs() + graph.users()];
    links[i] = 0;
    let mut queue = std::collections::VecDeque::from([i]);
    while let Some(node) = queue.pop_front() {
        for target in graph.detections(node).iter().map(|d| d.target as usize) {
            if links[target] == usize::MAX {
                links[target] = links[node] + 1;
                queue.push_back(target);
            }
        }
    }
    links.truncate(graph.uavs());
    links
}
