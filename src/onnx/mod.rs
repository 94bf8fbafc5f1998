//! Learned policies as ONNX models, which fly without a server (docs/onboard.md): one slot of one fleet, with what UAVs remember as inputs
//! and outputs.
//!
//! `network` has the networks, `memory` what UAVs remember, `goals` their goals, `advice` what they are advised, `sectors` tables of their
//! sectors, `graph` and `expressions` the operators.

mod advice;
mod expressions;
mod goals;
mod graph;
mod memory;
mod network;
mod sectors;

use prost::Message;

use self::advice::Advice;
use self::goals::GoalTable;
use self::graph::{Dim, Graph, Tensor};
use self::memory::Memory;
use self::network::{Edges, Network};
use crate::checkpoint::Checkpoint;
use crate::invalid::Invalid;
use crate::nn::HIDDEN;
use crate::policy::memory::GRID;
use crate::policy::{AgentConfig, Gnn, Identity, LearnedPolicy, TOKEN};
use crate::wire::onnx::tensor_proto::DataType;

const UAVS: Dim = Dim::Symbol("uavs");
const USERS: Dim = Dim::Symbol("users");
const EDGES: Dim = Dim::Symbol("edges");

/// The policy of a checkpoint as an ONNX model. `name` is for people.
///
/// # Errors
/// [`Invalid`] for architectures that have no ONNX form: those that observe over several links.
pub fn export(checkpoint: &Checkpoint, name: &str) -> Result<Vec<u8>, Invalid> {
    let policy: LearnedPolicy = checkpoint.policy();
    let (agent, env) = (policy.agent(), policy.agent().dims().env);
    let config = *agent.config();
    if config.hops > 1 {
        let expected = "1: what a UAV observes over several links is not part of the network";
        return Err(Invalid::new("training.hops", config.hops, expected));
    }
    let (params, advice_margin) = (policy.parameters(), policy.advice_margin());
    let most_uavs = policy.trained().most_uavs;
    let mut network = Network { g: Graph::default(), agent, params, advice_margin, most_uavs };
    slot(&mut network, &config);
    let metadata = vec![
        ("policy", name.to_owned()),
        ("actions", env.actions.to_string()),
        ("speed", env.speed.to_string()),
        ("detection_range", env.detection_range.to_string()),
        ("communication_range", env.communication_range.to_string()),
        ("transmission_range", env.transmission_range.to_string()),
        ("slots", env.slots.to_string()),
    ];
    let text = "One slot of a fleet: what its UAVs detect and remember, to their headings and what they remember next. docs/onboard.md \
                describes inputs and outputs.";
    Ok(network.g.finish(name, text, metadata).encode_to_vec())
}

/// The inputs that only some architectures have.
#[derive(Default)]
struct Optional {
    position: Option<Tensor>,
    /// Numbers of the UAVs.
    number: Option<Tensor>,
    /// Rows of the tables of sectors.
    sector: Option<Tensor>,
    token: Option<Tensor>,
    memory: Option<(Tensor, Memory)>,
}

/// What UAVs with a memory know before their networks run.
struct Knowledge {
    memory: Memory,
    advice: Option<Advice>,
    goals: GoalTable,
}

/// Builds one slot.
fn slot(n: &mut Network<'_>, config: &AgentConfig) {
    let hidden = [UAVS, Dim::Fixed(HIDDEN as i64)];
    let two = Dim::Fixed(2);
    let h = n.g.input("hidden", DataType::Float, &hidden, "hidden state; zeros in slot 0");
    let last = n.g.input("last_heading", DataType::Int64, &[UAVS], "heading index of the last slot; -1 in slot 0");
    let aoi =
        n.g.input("user_aoi", DataType::Float, &[USERS], "AoI of each user in slots; any value for a user that no UAV detects");
    let text = "node, detected node; nodes are the UAVs, then the users";
    let edge_index = n.g.input("edge_index", DataType::Int64, &[EDGES, two], text);
    let relative =
        n.g.input("edge_relative", DataType::Float, &[EDGES, two], "position of the detected node minus that of the node");
    let optional = optional_inputs(n, config);

    let [from, to] = [0, 1].map(|end| n.g.column(&edge_index, end));
    let (uavs, users) = (n.g.size(&h, 0), n.g.size(&aoi, 0));
    let nodes = n.g.with("Add", &uavs, &users);
    let edges = Edges { from, to, relative, uavs, users, nodes };
    let slots = n.g.float(n.agent.dims().env.slots as f32);
    let scaled = n.g.with("Div", &aoi, &slots);
    let observations = n.observations(&edges, &scaled);
    let knowledge = knowledge(n, config, (&edges, &aoi, &last), &optional);
    let advice = knowledge.as_ref().and_then(|knowledge| knowledge.advice.as_ref());
    let x = uav_inputs(n, config, (&edges, &observations, &last), (&optional, advice));
    let x = n.embed(&x, "agent.fc");
    let after = n.gru(&x, &h);
    let (mut q, y) = if config.gnn == Gnn::None {
        (n.linear(&after, "agent.head"), None)
    } else {
        let y = n.graph_layers(&edges, &after, &observations);
        let both = n.g.concat(&[&after, &y], 1);
        (n.mlp(&both, "agent.head"), Some(y))
    };
    if let Some(Knowledge { memory, advice, goals }) = &knowledge {
        let context: Vec<&Tensor> = [Some(&after), y.as_ref()].into_iter().flatten().collect();
        q = n.score_goals(goals, &context, &q);
        if let Some(advice) = advice {
            q = n.trust(&q, advice);
        }
        n.g.output(&memory.ground, "ground_out", floats(&ground_shape()), "`ground` of the next slot");
        n.g.output(&memory.users, "users_out", floats(&users_shape()), "`users` of the next slot");
    }
    let heading = n.g.arg_max(&q, 1);
    let actions = Dim::Fixed(n.agent.dims().env.actions as i64);
    let text = "heading h is 45 h degrees, counter-clockwise from +x; 8 is hover";
    n.g.output(&heading, "heading_index", (DataType::Int64, &[UAVS]), text);
    n.g.output(&q, "q_values", floats(&[UAVS, actions]), "value of each heading");
    n.g.output(&after, "hidden_out", floats(&hidden), "`hidden` of the next slot");
}

fn floats(shape: &[Dim]) -> (DataType, &[Dim]) {
    (DataType::Float, shape)
}

fn ground_shape() -> [Dim; 3] {
    [UAVS, Dim::Fixed(GRID as i64), Dim::Fixed(GRID as i64)]
}

fn users_shape() -> [Dim; 3] {
    [UAVS, USERS, Dim::Fixed(5)]
}

fn optional_inputs(n: &mut Network<'_>, config: &AgentConfig) -> Optional {
    let (two, mut optional) = (Dim::Fixed(2), Optional::default());
    let remembers = !config.memory.is_none();
    if config.self_position || remembers {
        let text = "x, y of each UAV in units of the square's side";
        optional.position = Some(n.g.input("uav_positions", DataType::Double, &[UAVS, two], text));
    }
    if remembers || matches!(config.identity, Identity::Phase | Identity::Onehot) {
        let text = "number of each UAV and size of its fleet, as in slot 0";
        let places = n.g.input("place", DataType::Int64, &[UAVS, two], text);
        optional.number = Some(n.g.column(&places, 0));
        optional.sector = Some(sectors::row(&mut n.g, &places));
    }
    if config.identity == Identity::Token {
        let text = "four numbers from -1 to 1 per UAV, drawn once";
        optional.token = Some(n.g.input("identity_token", DataType::Float, &[UAVS, Dim::Fixed(TOKEN as i64)], text));
    }
    if remembers {
        let slot = n.g.input("slot", DataType::Int64, &[], "number of the slot, from 0");
        let ground = n.g.input("ground", DataType::Float, &ground_shape(), "searched ground; zeros in slot 0");
        let users = n.g.input("users", DataType::Float, &users_shape(), "remembered users; zeros in slot 0");
        optional.memory = Some((slot, Memory { ground, users }));
    }
    optional
}

/// What the UAVs remember after they have detected, and what follows from it.
fn knowledge(
    n: &mut Network<'_>,
    config: &AgentConfig,
    (edges, aoi, last): (&Edges, &Tensor, &Tensor),
    optional: &Optional,
) -> Option<Knowledge> {
    let ((slot, before), position, sector) = (optional.memory.as_ref()?, optional.position.as_ref()?, optional.sector.as_ref()?);
    let slot = n.g.cast(slot, DataType::Double);
    let sight = n.sight(edges, position);
    let memory = n.remember(before, &sight, (position, aoi, &slot));
    let bounds = sectors::bounds(&mut n.g, sector);
    let advice = (!config.advice.is_none()).then(|| n.advice(&memory, &sight, (position, &slot), (sector, &bounds)));
    let advised = advice.as_ref().map(|advice| &advice.headings);
    let goals = n.goals(&memory, &sight, (position, &slot, &bounds), (last, advised));
    Some(Knowledge { memory, advice, goals })
}

/// The inputs of the UAVs' networks (docs/model.md, "UAV input").
fn uav_inputs(
    n: &mut Network<'_>,
    config: &AgentConfig,
    (edges, observations, last): (&Edges, &Tensor, &Tensor),
    (optional, advice): (&Optional, Option<&Advice>),
) -> Tensor {
    let actions = n.agent.dims().env.actions;
    let zero = n.g.list(&[0]);
    let mut parts = vec![n.g.slice_at(observations, 0, &zero, &edges.uavs)];
    parts.push(n.g.one_hot(last, actions));
    match (config.identity, &optional.sector, &optional.number) {
        (Identity::Phase, Some(sector), _) => parts.push(sectors::phases(&mut n.g, sector)),
        (Identity::Onehot, _, Some(number)) => parts.push(n.g.one_hot(number, n.agent.dims().uavs)),
        _ => parts.extend(optional.token.clone()),
    }
    if let Some(position) = optional.position.as_ref().filter(|_| config.self_position) {
        let position = n.g.cast(position, DataType::Float);
        let middle = n.g.float(0.5);
        let position = n.g.with("Sub", &position, &middle);
        let scale = n.g.float(if config.normalise { 2.0 } else { 1.0 });
        parts.push(n.g.with("Mul", &position, &scale));
    }
    if let Some(advice) = advice {
        parts.push(n.g.one_hot(&advice.headings, actions));
    }
    n.g.concat(&parts.iter().collect::<Vec<_>>(), 1)
}
