//! Episodes that a client flies, and the requests that come out of them.

use super::{ActArgs, Observation};
use crate::env::{EnvConfig, Episode, Point, Start};
use crate::policy::Slot;
use crate::wire::v1;
use crate::wire::v1::act_request::{Memory, Observation as Sent};

/// What all clients fly.
pub(super) struct Setup {
    policy: String,
    env: EnvConfig,
    observation: Observation,
    /// The policy's own.
    range: f64,
    /// Lengths are multiplied by this.
    scale: f64,
}

impl Setup {
    /// The flags, for `policy`.
    ///
    /// # Errors
    /// A fleet that no environment holds.
    pub(super) fn new(args: &ActArgs, policy: &v1::Policy) -> anyhow::Result<Self> {
        let hover = policy.headings as usize > EnvConfig::COMPASS;
        let env = EnvConfig { uavs: args.uavs, users: args.users, hover, start: Start::Random, ..EnvConfig::default() };
        env.validate()?;
        let range = policy.detection_range;
        let scale = args.range.map_or(1.0, |wanted| range / wanted);
        Ok(Self { policy: args.policy.clone(), env, observation: args.observation, range, scale })
    }
}

/// One fleet in its episodes, one after another. A session sees each as a new run.
pub(super) struct World {
    episode: Episode,
    run: u64,
    session: String,
    observation: Observation,
    range: f64,
    scale: f64,
    slot: Slot,
    uavs: Vec<String>,
    users: Vec<String>,
}

impl World {
    /// The first episode of `session`.
    ///
    /// # Errors
    /// None once a [`Setup`] is there.
    pub(super) fn new(setup: &Setup, session: String, seed: u64) -> anyhow::Result<Self> {
        Ok(Self {
            episode: Episode::new(&setup.env, seed)?,
            run: 0,
            session,
            observation: setup.observation,
            range: setup.range,
            scale: setup.scale,
            slot: Slot::default(),
            uavs: (0..setup.env.uavs).map(|i| format!("uav-{i}")).collect(),
            users: (0..setup.env.users).map(|i| format!("user-{i}")).collect(),
        })
    }

    /// Its session's name.
    pub(super) fn session(&self) -> &str {
        &self.session
    }

    /// What opens its session.
    pub(super) fn open(&self, setup: &Setup) -> v1::OpenSessionRequest {
        let (policy, session_id) = (setup.policy.clone(), self.session.clone());
        v1::OpenSessionRequest { policy, session_id, run_id: Some(self.run_id()), seed: Some(self.episode.seed()) }
    }

    fn run_id(&self) -> String {
        format!("run-{}", self.run)
    }

    /// What is asked in this slot.
    pub(super) fn request(&mut self) -> v1::ActRequest {
        let scaled = |points: Vec<Point>| -> Vec<Point> { points.into_iter().map(|p| p.map(|x| x * self.scale)).collect() };
        let (uavs, users) = (scaled(self.episode.uavs()), scaled(self.episode.users()));
        let observation = match self.observation {
            Observation::Scene => Sent::Scene(self.scene(&uavs, &users)),
            Observation::Graph => Sent::Graph(self.graph(&uavs, &users)),
        };
        v1::ActRequest {
            observation: Some(observation),
            memory: Some(Memory::SessionId(self.session.clone())),
            step: Some(self.episode.slot() as u64),
            run_id: Some(self.run_id()),
            ..Default::default()
        }
    }

    fn scene(&self, uavs: &[Point], users: &[Point]) -> v1::Scene {
        let uavs = self.uavs.iter().zip(uavs).map(|(id, p)| v1::SceneUav { id: id.clone(), x: p[0], y: p[1] });
        let users = self.users.iter().zip(users).zip(self.episode.aoi());
        let users = users.map(|((id, p), &aoi)| v1::SceneUser { id: id.clone(), x: p[0], y: p[1], aoi: aoi.into() });
        v1::Scene { uavs: uavs.collect(), users: users.collect() }
    }

    /// What UAVs detect; what users do is left to the server.
    fn graph(&mut self, uavs: &[Point], users: &[Point]) -> v1::Graph {
        let aoi = self.episode.aoi();
        self.slot.set_scene(uavs, users, aoi, self.range);
        let detection = |d: &crate::policy::Detection| {
            let target = d.target as usize;
            let (id, aoi) = match target.checked_sub(uavs.len()) {
                Some(user) => (&self.users[user], Some(aoi[user].into())),
                None => (&self.uavs[target], None),
            };
            v1::Detection { target_id: id.clone(), rel_x: d.rel[0].into(), rel_y: d.rel[1].into(), aoi }
        };
        let uav = |(i, p): (usize, &Point)| v1::Node {
            id: self.uavs[i].clone(),
            kind: v1::NodeKind::Uav.into(),
            detections: self.slot.detections(i).iter().map(detection).collect(),
            position: Some(v1::Position { x: p[0], y: p[1] }),
            aoi: None,
        };
        let user = |(id, &aoi): (&String, &f32)| v1::Node {
            id: id.clone(),
            kind: v1::NodeKind::User.into(),
            aoi: Some(aoi.into()),
            ..Default::default()
        };
        v1::Graph { nodes: uavs.iter().enumerate().map(uav).chain(self.users.iter().zip(aoi).map(user)).collect() }
    }

    /// Flies what was answered; at the end of an episode the next one begins.
    ///
    /// # Errors
    /// Not a heading for each UAV.
    pub(super) fn fly(&mut self, answer: &v1::ActResponse) -> anyhow::Result<()> {
        let headings: Vec<u8> = answer.actions.iter().map(|a| a.heading_index as u8).collect();
        self.episode.step(&headings)?;
        if self.episode.done() {
            self.restart();
        }
        Ok(())
    }

    /// Begins the next episode.
    pub(super) fn restart(&mut self) {
        self.run += 1;
        self.episode.reset(self.episode.seed().wrapping_add(self.run << 32));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn world(observation: Observation, scale: f64) -> World {
        let env = EnvConfig { slots: 2, start: Start::Random, ..EnvConfig::default() };
        let setup = Setup { policy: "qedgix".into(), env, observation, range: 0.28, scale };
        World::new(&setup, "s".into(), 1).expect("a small fleet")
    }

    #[test]
    fn episodes_follow_each_other_as_runs() {
        let mut world = world(Observation::Scene, 1.0);
        let answer = v1::ActResponse { actions: vec![v1::Action::default(); 3], ..Default::default() };
        let asked: Vec<_> = (0..5)
            .map(|_| {
                let request = world.request();
                world.fly(&answer).expect("three headings");
                (request.run_id.expect("named"), request.step.expect("counted"))
            })
            .collect();
        let expected = [("run-0", 0), ("run-0", 1), ("run-1", 0), ("run-1", 1), ("run-2", 0)];
        assert_eq!(asked, expected.map(|(run, step)| (run.to_owned(), step)));
        assert!(world.fly(&v1::ActResponse::default()).is_err(), "an answer without headings");
    }

    #[test]
    fn scaled_lengths_scale_what_is_sent_and_who_is_seen() {
        let nodes = |scale| match world(Observation::Graph, scale).request().observation {
            Some(Sent::Graph(graph)) => graph.nodes,
            _ => unreachable!("graphs were asked for"),
        };
        let (near, far) = (nodes(0.5), nodes(20.0));
        assert_eq!((near.len(), far.len()), (8, 8));
        let seen = |nodes: &[v1::Node]| nodes.iter().map(|n| n.detections.len()).sum::<usize>();
        assert!(seen(&near) > seen(&far));
        let at = |nodes: &[v1::Node]| nodes[0].position.expect("a UAV tells its position").x;
        assert_eq!(at(&near) * 40.0, at(&far));
        assert!(near.iter().flat_map(|n| &n.detections).all(|d| d.rel_x.hypot(d.rel_y) <= 0.28 * (1.0 + 1e-6)));
        assert!(near[3..].iter().all(|n| n.detections.is_empty() && n.aoi.is_some()));
    }
}
