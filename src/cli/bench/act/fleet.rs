//! A simulated fleet: runs episodes and makes the requests of their slots.

use super::{ActArgs, ObservationForm};
use crate::env::{EnvConfig, Episode, Point, Start};
use crate::policy::FleetGraph;
use crate::wire::v1;
use crate::wire::v1::act_request::{Memory, Observation as Sent};

/// Properties of all simulated fleets.
pub(super) struct FleetConfig {
    policy: String,
    env: EnvConfig,
    observation: ObservationForm,
    /// Detection range of the policy.
    range: f64,
    /// Factor of all lengths in requests.
    scale: f64,
}

impl FleetConfig {
    /// Reads the flags, for `policy`.
    ///
    /// # Errors
    /// The number of UAVs or users is out of range.
    pub(super) fn new(args: &ActArgs, policy: &v1::Policy) -> anyhow::Result<Self> {
        let hover = policy.headings as usize > EnvConfig::COMPASS;
        let env = EnvConfig { uavs: args.uavs, users: args.users, hover, start: Start::Random, ..EnvConfig::default() };
        env.validate()?;
        let range = policy.detection_range;
        let scale = args.range.map_or(1.0, |requested| range / requested);
        Ok(Self { policy: args.policy.clone(), env, observation: args.observation, range, scale })
    }
}

/// A fleet that runs episode after episode in one session. Each episode has its own run id.
pub(super) struct SimulatedFleet {
    episode: Episode,
    run: u64,
    session: String,
    observation: ObservationForm,
    range: f64,
    scale: f64,
    graph: FleetGraph,
    uavs: Vec<String>,
    users: Vec<String>,
}

impl SimulatedFleet {
    /// Begins the first episode in `session`.
    ///
    /// # Errors
    /// Never for a valid [`FleetConfig`].
    pub(super) fn new(config: &FleetConfig, session: String, seed: u64) -> anyhow::Result<Self> {
        Ok(Self {
            episode: Episode::new(&config.env, seed)?,
            run: 0,
            session,
            observation: config.observation,
            range: config.range,
            scale: config.scale,
            graph: FleetGraph::default(),
            uavs: (0..config.env.uavs).map(|i| format!("uav-{i}")).collect(),
            users: (0..config.env.users).map(|i| format!("user-{i}")).collect(),
        })
    }

    /// Id of the session.
    pub(super) fn session(&self) -> &str {
        &self.session
    }

    /// The request that opens the session.
    pub(super) fn open_request(&self, config: &FleetConfig) -> v1::OpenSessionRequest {
        let (policy, session_id) = (config.policy.clone(), self.session.clone());
        v1::OpenSessionRequest {
            policy,
            session_id,
            run_id: Some(self.run_id()),
            seed: Some(self.episode.seed()),
            ..Default::default()
        }
    }

    fn run_id(&self) -> String {
        format!("run-{}", self.run)
    }

    /// The request of the current slot.
    pub(super) fn request(&mut self) -> v1::ActRequest {
        let scaled = |points: Vec<Point>| -> Vec<Point> { points.into_iter().map(|p| p.map(|x| x * self.scale)).collect() };
        let (uavs, users) = (scaled(self.episode.uavs()), scaled(self.episode.users()));
        let observation = match self.observation {
            ObservationForm::Scene => Sent::Scene(self.scene(&uavs, &users)),
            ObservationForm::Graph => Sent::Graph(self.graph(&uavs, &users)),
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
        let uavs =
            self.uavs.iter().zip(uavs).map(|(id, p)| v1::SceneUav { id: id.clone(), x: p[0], y: p[1], ..Default::default() });
        let users = self.users.iter().zip(users).zip(self.episode.aoi());
        let users = users.map(|((id, p), &aoi)| v1::SceneUser { id: id.clone(), x: p[0], y: p[1], aoi: aoi.into(), z: None });
        v1::Scene { uavs: uavs.collect(), users: users.collect() }
    }

    /// The detections of the UAVs. The server derives those of the users.
    fn graph(&mut self, uavs: &[Point], users: &[Point]) -> v1::Graph {
        let aoi = self.episode.aoi();
        self.graph.set_scene(uavs, users, aoi, self.range);
        let detection = |d: &crate::policy::Detection| {
            let target = d.target as usize;
            let (id, aoi) = match target.checked_sub(uavs.len()) {
                Some(user) => (&self.users[user], Some(aoi[user].into())),
                None => (&self.uavs[target], None),
            };
            v1::Detection { target_id: id.clone(), rel_x: d.rel[0].into(), rel_y: d.rel[1].into(), aoi, rel_z: None }
        };
        let uav = |(i, p): (usize, &Point)| v1::Node {
            id: self.uavs[i].clone(),
            kind: v1::NodeKind::Uav.into(),
            detections: self.graph.detections(i).iter().map(detection).collect(),
            position: Some(v1::Position { x: p[0], y: p[1], z: None }),
            ..Default::default()
        };
        let user = |(id, &aoi): (&String, &f32)| v1::Node {
            id: id.clone(),
            kind: v1::NodeKind::User.into(),
            aoi: Some(aoi.into()),
            ..Default::default()
        };
        v1::Graph { nodes: uavs.iter().enumerate().map(uav).chain(self.users.iter().zip(aoi).map(user)).collect() }
    }

    /// Moves the UAVs by the headings of `response`. After the last slot of an episode, begins the next episode.
    ///
    /// # Errors
    /// `response` does not have one heading per UAV.
    pub(super) fn step(&mut self, response: &v1::ActResponse) -> anyhow::Result<()> {
        let headings: Vec<u8> = response.actions.iter().map(|a| a.heading_index as u8).collect();
        self.episode.step(&headings)?;
        if self.episode.done() {
            self.next_episode();
        }
        Ok(())
    }

    /// Begins the next episode.
    pub(super) fn next_episode(&mut self) {
        self.run += 1;
        self.episode.reset(self.episode.seed().wrapping_add(self.run << 32));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fleet(observation: ObservationForm, scale: f64) -> SimulatedFleet {
        let env = EnvConfig { slots: 2, start: Start::Random, ..EnvConfig::default() };
        let config = FleetConfig { policy: "qedgix".into(), env, observation, range: 0.28, scale };
        SimulatedFleet::new(&config, "s".into(), 1).expect("a small fleet")
    }

    #[test]
    fn each_episode_has_its_own_run_id() {
        let mut fleet = fleet(ObservationForm::Scene, 1.0);
        let response = v1::ActResponse { actions: vec![v1::Action::default(); 3], ..Default::default() };
        let sent: Vec<_> = (0..5)
            .map(|_| {
                let request = fleet.request();
                fleet.step(&response).expect("three headings");
                (request.run_id.expect("set"), request.step.expect("set"))
            })
            .collect();
        let expected = [("run-0", 0), ("run-0", 1), ("run-1", 0), ("run-1", 1), ("run-2", 0)];
        assert_eq!(sent, expected.map(|(run, step)| (run.to_owned(), step)));
        assert!(fleet.step(&v1::ActResponse::default()).is_err(), "a response without headings");
    }

    #[test]
    fn scaling_changes_positions_and_detections() {
        let nodes = |scale| match fleet(ObservationForm::Graph, scale).request().observation {
            Some(Sent::Graph(graph)) => graph.nodes,
            _ => unreachable!("the observation is a graph"),
        };
        let (near, far) = (nodes(0.5), nodes(20.0));
        assert_eq!((near.len(), far.len()), (8, 8));
        let detections = |nodes: &[v1::Node]| nodes.iter().map(|n| n.detections.len()).sum::<usize>();
        assert!(detections(&near) > detections(&far));
        let at = |nodes: &[v1::Node]| nodes[0].position.expect("UAVs have a position").x;
        assert_eq!(at(&near) * 40.0, at(&far));
        assert!(near.iter().flat_map(|n| &n.detections).all(|d| d.rel_x.hypot(d.rel_y) <= 0.28 * (1.0 + 1e-6)));
        assert!(near[3..].iter().all(|n| n.detections.is_empty() && n.aoi.is_some()));
    }
}
