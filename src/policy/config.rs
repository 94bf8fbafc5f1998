//! Configuration of the agent's architecture (docs/model.md, "Observations" and "Agents").

use serde::{Deserialize, Serialize};

use super::memory::Sharing;

/// The graph layer of an agent (docs/model.md, "Agents").
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Gnn {
    /// No graph: the agent of `qmix`, `vdn` and `iql`.
    None,
    /// `EdgeConv`, the layer of Qedgix.
    EdgeConv,
    /// Messages and an update network, the paper's Algorithm 3.
    AggGnn,
    /// Relational graph convolution, the paper's Algorithm 4.
    Rgcn,
}

/// How messages are aggregated over neighbours.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Aggregation {
    /// The mean over the neighbours.
    Mean,
    /// The sum, as in the paper.
    Sum,
}

/// Form of a node's observation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ObservationKind {
    /// One fixed place per entity, width 2M + 3N (docs/model.md, "Flat observation"). Ties a checkpoint to one (M, N).
    Flat,
    /// Sums of embeddings, width 128 (docs/model.md, "Set observation"). Fits any M and N.
    Set,
}

/// Distinguishes UAVs with equal observations (docs/model.md, "Identity").
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Identity {
    /// One-hot index, M wide.
    Onehot,
    /// cos and sin of 2 pi i / M.
    Phase,
    /// Four numbers drawn per UAV and episode.
    Token,
    /// None: UAVs that start at one point always make the same moves.
    None,
}

/// What a UAV remembers besides its hidden state (docs/model.md, "Memory").
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Memory {
    /// Nothing, as in the paper.
    #[default]
    None,
    /// The users it has detected and the ground it has searched.
    Own,
    /// The same, exchanged among UAVs in communication range.
    Shared,
}

/// What a rule tells a UAV in every slot (docs/model.md, "Advice").
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Advice {
    /// Nothing, as in the paper.
    #[default]
    None,
    /// The heading that `sweep` would fly from the UAV's memory; with a shared memory, that of `sweep-shared`.
    Sweep,
}

/// Width of a `token` identity.
pub const TOKEN: usize = 4;

/// Architecture of the agents, shared by all UAVs (docs/model.md, "Agents").
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AgentConfig {
    /// Graph layer.
    pub gnn: Gnn,
    /// Number of graph layers, at least 1. Ignored without a graph.
    pub layers: usize,
    /// Aggregation of `edgeconv`.
    pub aggregation: Aggregation,
    /// Observation of every node.
    pub observation: ObservationKind,
    /// Identity of a UAV.
    pub identity: Identity,
    /// Whether a UAV's input has its own position.
    pub self_position: bool,
    /// Whether a node is its own neighbour.
    pub self_loops: bool,
    /// Number of links over which a UAV observes. More than 1 only without a graph layer.
    pub hops: usize,
    /// What a UAV remembers.
    #[serde(default)]
    pub memory: Memory,
    /// What a rule advises, from this memory.
    #[serde(default)]
    pub advice: Advice,
    /// Whether flat observations have relative positions in units of d, and own positions are scaled to [-1, 1].
    pub normalise: bool,
}

impl Advice {
    /// Whether UAVs get no advice.
    pub fn is_none(self) -> bool {
        self == Self::None
    }
}

impl Memory {
    /// Whether UAVs have no memory.
    pub fn is_none(self) -> bool {
        self == Self::None
    }

    /// How memories are shared; `None` without memory.
    pub fn sharing(self) -> Option<Sharing> {
        match self {
            Self::None => None,
            Self::Own => Some(Sharing::Own),
            Self::Shared => Some(Sharing::Shared),
        }
    }
}
