//! The agent's architecture as configuration (spec 2 and 3).

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// The graph layer of an agent (spec 3).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Gnn {
    /// No graph: the QMIX / VDN agent.
    None,
    /// `EdgeConv`, the layer of Qedgix.
    EdgeConv,
    /// Messages and an update network (the paper's Algorithm 3).
    AggGnn,
    /// Relational graph convolution (the paper's Algorithm 4).
    Rgcn,
}

/// How messages are aggregated over neighbours.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum Aggregation {
    /// Divided by the number of neighbours.
    Mean,
    /// As the paper writes it.
    Sum,
}

/// What a node is told of what it sees.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
#[schema(as = Observation)]
pub enum ObservationKind {
    /// One fixed place per entity, width 2M + 3N (spec 2.1); ties a checkpoint to (M, N).
    Flat,
    /// Sums of embeddings, width 128 (spec 2.2); any M and N.
    Set,
}

/// What tells UAVs with equal observations apart (spec 2.4).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum Identity {
    /// One-hot index, M wide.
    Onehot,
    /// cos and sin of 2 pi i / M.
    Phase,
    /// Four numbers drawn per UAV and episode.
    Token,
    /// Nothing: a fleet that starts at one point never parts.
    None,
}

/// Width of a `token` identity.
pub const TOKEN: usize = 4;
/// H, the hidden width.
pub const HIDDEN: usize = crate::nn::HIDDEN;

/// Architecture of the agents, shared by all UAVs (spec 3).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AgentConfig {
    /// Graph layer.
    pub gnn: Gnn,
    /// Number of graph layers, at least 1 (ignored without a graph).
    pub layers: usize,
    /// Aggregation of `edgeconv`.
    pub aggregation: Aggregation,
    /// Observation of every node.
    pub observation: ObservationKind,
    /// Identity of a UAV.
    pub identity: Identity,
    /// Whether a UAV knows its own position.
    pub self_position: bool,
    /// Whether a node is its own neighbour.
    pub self_loops: bool,
    /// Links over which a UAV observes; more than 1 only without a graph layer.
    pub hops: usize,
    /// Whether relative positions are in units of d in flat observations too, and own positions in [-1, 1].
    pub normalise: bool,
}
