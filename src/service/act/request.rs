//! Requests and responses of `Act`.

use std::fmt;
use std::sync::Arc;

use bytes::Bytes;

use crate::serving::{Decision, FleetInput, LoadedPolicy, PolicySpec};

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
}
