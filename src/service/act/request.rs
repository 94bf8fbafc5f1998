//! Requests and responses of `Act`.

use std::fmt;
use std::sync::Arc;

use bytes::Bytes;

use crate::env::Point;
use crate::invalid::Invalid;
use crate::serving::{
    Decision, FleetIds, FleetInput, Flight, FlightOptions, LoadedPolicy, PolicySpec, SceneOrGraph, Sensing, Task,
};

/// A request for one slot.
#[derive(Clone, Debug)]
pub struct Request {
    /// The policy; optional for sessions, which are pinned to one.
    pub policy: Option<PolicySpec>,
    /// Positions or detections of the fleet.
    pub input: FleetInput,
    /// Where the fleet's memory is kept.
    pub memory: MemoryLocation,
    /// The step, if the caller counts steps.
    pub step: Option<u64>,
    /// The run of a session; ignored if the caller keeps the memory.
    pub run_id: Option<String>,
    /// Seed of the policy's random choices, at slot 0 of a sequence or of memory that the caller keeps.
    pub seed: Option<u64>,
    /// The frame and the world, at step 0 of a sequence or if the caller keeps the memory.
    pub flight: Option<Box<FlightOptions>>,
    /// Whether the response has what velocities and waypoints follow from.
    pub return_motion: bool,
    /// Whether the response says why.
    pub explain: bool,
}

/// Where the memory of a fleet is kept between slots.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum MemoryLocation {
    /// On the server, in this session.
    Session(String),
    /// On the server, in a session that the requests themselves begin and end.
    Sequence(Sequence),
    /// By the caller: the bytes of the last response, empty at slot 0.
    RecurrentState(Bytes),
}

/// The position of a request in a sequence of the Open Inference Protocol.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Sequence {
    /// The sequence.
    pub id: SequenceId,
    /// Whether this slot begins the sequence, in place of a running one with the same id.
    pub start: bool,
    /// Whether this slot ends the sequence.
    pub end: bool,
}

/// The id of a sequence. The number 5 and the text "5" are different ids.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum SequenceId {
    /// A number.
    Number(u64),
    /// A text.
    Name(String),
}

impl fmt::Display for SequenceId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Number(number) => number.fmt(f),
            Self::Name(name) => write!(f, "{name:?}"),
        }
    }
}

/// The decision for one slot. Its headings are in canonical order of UAVs; `canonical_of_request` leads to the order of the request.
#[derive(Clone, Debug)]
pub struct Response {
    /// The policy version that decided.
    pub policy: Arc<LoadedPolicy>,
    /// Ids of UAVs in canonical order.
    pub uavs: Vec<String>,
    /// Canonical index of each UAV in the order of the request.
    pub canonical_of_request: Vec<u32>,
    /// The decision.
    pub decision: Decision,
    /// Memory for the next slot, if the caller keeps it.
    pub recurrent_state: Option<Bytes>,
    /// The frame and the world of the fleet, if it has its own or the request asks for [`Motion`].
    pub flight: Option<Arc<Flight>>,
    /// The motion of the UAVs, if the request asks for it.
    pub motion: Option<Motion>,
}

/// Where UAVs are and how fast, in canonical order.
#[derive(Clone, Debug)]
pub struct Motion {
    /// In the unit square, where known.
    pub positions: Vec<Option<Point>>,
    /// In units of the caller per second, where they differ from that of the world; empty if none does.
    pub speeds: Vec<Option<f64>>,
}

/// An input in the unit square, with what the response needs of it.
pub(super) struct Placed {
    pub(super) fleet: FleetIds,
    pub(super) canonical_of_request: Vec<u32>,
    pub(super) content: SceneOrGraph,
    /// Speed of each UAV per slot; empty if all have that of the world.
    pub(super) speeds: Vec<f64>,
    /// Slots that each UAV can still fly; empty if not known.
    pub(super) endurance: Vec<f64>,
    pub(super) flight: Option<Arc<Flight>>,
    pub(super) motion: Option<Motion>,
}

impl Placed {
    /// Translates `input` to the unit square. `flight`: absent if the fleet flies in the unit square and in the world of `policy`.
    ///
    /// # Errors
    /// [`Invalid`] for coordinates that are far from the area, and speeds that are too high.
    pub(super) fn new(
        input: FleetInput,
        policy: &LoadedPolicy,
        flight: Option<&Arc<Flight>>,
        motion: bool,
    ) -> Result<Self, Invalid> {
        let FleetInput { fleet, canonical_of_request, speeds: own, endurances, far, mut content } = input;
        let plain = || Arc::new(Flight::plain(&*policy.implementation));
        let flight = flight.cloned().or_else(|| (motion || !own.is_empty()).then(plain));
        let Some(flight) = flight else {
            return match far {
                Some(far) => Err(*far),
                None => Ok(Self {
                    fleet,
                    canonical_of_request,
                    content,
                    speeds: Vec::new(),
                    endurance: Vec::new(),
                    flight: None,
                    motion: None,
                }),
            };
        };
        flight.translate(&mut content, far)?;
        let speeds = flight.speeds(&own, |i| content.uav_field(i, &canonical_of_request, "speed"))?;
        let endurance = flight.endurance(&endurances);
        let unknown = |content: &SceneOrGraph| content.uav_positions().iter().position(Option::is_none);
        if let Some(i) = flight.guard.as_ref().and_then(|_| unknown(&content)) {
            let field = content.uav_field(i, &canonical_of_request, "position");
            return Err(Invalid::missing(field, "the position of every UAV, which constraints need"));
        }
        let motion = motion.then(|| Motion { positions: content.uav_positions(), speeds: own });
        Ok(Self { fleet, canonical_of_request, content, speeds, endurance, flight: Some(flight), motion })
    }

    /// `task` in the world of the fleet, with its constraints.
    pub(super) fn in_world(task: Task, flight: Option<&Arc<Flight>>, speeds: Vec<f64>, endurance: Vec<f64>) -> Task {
        let Some(flight) = flight else { return task };
        let task = task.in_world(flight.env, speeds);
        match &flight.guard {
            Some(guard) => task.guarded(guard.clone(), endurance),
            None => task,
        }
    }

    /// What the policy detects.
    pub(super) fn sensing(&self, policy: &LoadedPolicy) -> Sensing {
        self.flight.as_ref().map_or_else(|| Sensing::of(&*policy.implementation), |flight| flight.sensing())
    }
}
