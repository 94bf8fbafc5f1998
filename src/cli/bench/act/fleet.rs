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
    /// The world of the sessions, if it is not that of the policy.
    world: Option<v1::World>,
}

impl FleetConfig {
    /// Reads the flags, for `policy`.
    ///
    /// # Errors
    /// The number of UAVs or users is out of range.
    pub(super) fn new(args: &ActArgs, policy: &v1::Policy) -> anyhow::Result<Self> {
        let hover = policy.headings as usize > EnvConfig::COMPASS;
        let default = EnvConfig::default();
        let detection_range = args.range.unwrap_or(policy.detection_range);
        let transmission_range = default.transmission_range * detection_range / default.detection_range;
        let env = EnvConfig {
            uavs: args.uavs,
            users: args.users,
            detection_range,
            transmission_range,
            hover,
            start: Start::Random,
            ..default
        };
        env.validate()?;
        let world = args.range.map(|_| v1::World {
            detection_range: Some(detection_range),
            transmission_range: Some(transmission_range),
            ..Default::default()
        });
        Ok(Self { policy: args.policy.clone(), env, observation: args.observation, world })
    }
}

/// A fleet that runs episode after episode in one session. Each episode has its own run id.
pub(super) struct SimulatedFleet {
    episode: Episode,
    run: u64,
    session: String,
    observation: ObservationForm,
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
            world: config.world,
            ..Default::default()
        }
    }

    fn run_id(&self) -> String {
        format!("run-{}", self.run)
    }

    /// The request of the current slot.
    pub(super) fn request(&mut self) -> v1::ActRequest {
        let (uavs, users) = (self.episode.uavs(), self.episode.users());
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
        self.graph.set_scene(uavs, users, aoi, self.episode.config().detection_range);
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
        self.fly(response.actions.iter().map(|action| action.heading_index as u8).collect())
    }

    /// Moves the UAVs in circles: they stay apart, so the requests keep about their size.
    ///
    /// # Errors
    /// Never.
    pub(super) fn circle(&mut self) -> anyhow::Result<()> {
        let slot = self.episode.slot();
        self.fly((0..self.uavs.len()).map(|uav| ((uav + slot) % EnvConfig::COMPASS) as u8).collect())
    }

    fn fly(&mut self, headings: Vec<u8>) -> anyhow::Result<()> {
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

    fn fleet(observation: ObservationForm, detection_range: f64) -> SimulatedFleet {
        let env = EnvConfig { slots: 2, start: Start::Random, detection_range, ..EnvConfig::default() };
        let config = FleetConfig { policy: "qedgix".into(), env, observation, world: None };
        SimulatedFleet::new(&config, "s".into(), 1).expect("a small fleet")
    }

    #[test]
    fn each_episode_has_its_own_run_id() {
        let mut fleet = fleet(ObservationForm::Scene, 0.28);
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
    fn detections_follow_the_range_and_users_have_none_of_their_own() {
        let nodes = |range| match fleet(ObservationForm::Graph, range).request().observation {
            Some(Sent::Graph(graph)) => graph.nodes,
            _ => unreachable!("the observation is a graph"),
        };
        let (near, far) = (nodes(0.12), nodes(1.0));
        assert_eq!((near.len(), far.len()), (8, 8));
        let detections = |nodes: &[v1::Node]| nodes.iter().map(|n| n.detections.len()).sum::<usize>();
        assert!(detections(&near) < detections(&far));
        assert_eq!(near[0].position, far[0].position);
        assert!(far.iter().flat_map(|n| &n.detections).all(|d| d.rel_x.hypot(d.rel_y) <= 1.0 + 1e-6));
        assert!(far[3..].iter().all(|n| n.detections.is_empty() && n.aoi.is_some()));
    }

    #[test]
    fn a_fleet_that_circles_is_after_eight_slots_where_it_was() {
        let env = EnvConfig { speed: 0.001, start: Start::Random, ..EnvConfig::default() };
        let config = FleetConfig { policy: "qedgix".into(), env, observation: ObservationForm::Scene, world: None };
        let mut fleet = SimulatedFleet::new(&config, "s".into(), 1).expect("a small fleet");
        let before = fleet.episode.uavs();
        (0..8).for_each(|_| fleet.circle().expect("as many headings as UAVs"));
        assert!(before.iter().zip(fleet.episode.uavs()).all(|(a, b)| (a[0] - b[0]).hypot(a[1] - b[1]) < 1e-6));
    }
}
