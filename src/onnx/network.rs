//! The networks of an agent (docs/model.md, "Agents") as ONNX operators, with weights from a checkpoint.

use super::graph::{Graph, Tensor};
use crate::nn::HIDDEN;
use crate::policy::{Agent, Aggregation, Gnn};
use crate::wire::onnx::tensor_proto::DataType;

/// The graph, and where its weights come from.
pub(super) struct Network<'a> {
    pub(super) g: Graph,
    pub(super) agent: &'a Agent,
    pub(super) params: &'a [f32],
    pub(super) advice_margin: f32,
    /// The largest fleet of the training.
    pub(super) most_uavs: usize,
}

/// Detections as lists of edges, and what follows from the sizes of the fleet.
pub(super) struct Edges {
    /// Nodes that detect, (E).
    pub(super) from: Tensor,
    /// Detected nodes, (E).
    pub(super) to: Tensor,
    /// Relative positions, (E, 2).
    pub(super) relative: Tensor,
    /// M, N and M + N, each a vector of one.
    pub(super) uavs: Tensor,
    pub(super) users: Tensor,
    pub(super) nodes: Tensor,
}

const SLOPE: f32 = 0.01;

impl Network<'_> {
    /// A parameter by name: its shape and values.
    fn parameter(&self, name: &str) -> (&[usize], &[f32]) {
        let found = self.agent.layout().parameters().iter().find(|p| p.name == name);
        let found = found.unwrap_or_else(|| panic!("the architecture has a parameter {name}"));
        (&found.shape, &self.params[found.range.clone()])
    }

    /// A parameter as a constant.
    pub(super) fn constant(&mut self, name: &str) -> Tensor {
        let (shape, values) = self.parameter(name);
        let (shape, values) = (shape.iter().map(|&n| n as i64).collect::<Vec<_>>(), values.to_vec());
        self.g.floats(&shape, &values)
    }

    /// Columns of a weight, as a constant (outputs, columns).
    pub(super) fn columns(&mut self, name: &str, columns: std::ops::Range<usize>) -> Tensor {
        let (shape, values) = self.parameter(name);
        let rows = shape[0] as i64;
        let part: Vec<f32> = values.chunks_exact(shape[1]).flat_map(|row| &row[columns.clone()]).copied().collect();
        self.g.floats(&[rows, columns.len() as i64], &part)
    }

    /// The layer `name.weight`, `name.bias`.
    pub(super) fn linear(&mut self, x: &Tensor, name: &str) -> Tensor {
        let (weight, bias) = (self.constant(&format!("{name}.weight")), self.constant(&format!("{name}.bias")));
        self.g.linear(x, &weight, &bias)
    }

    /// x W^T for some columns of `name.weight`, without the bias.
    pub(super) fn product(&mut self, x: &Tensor, name: &str, columns: std::ops::Range<usize>) -> Tensor {
        let weight = self.columns(&format!("{name}.weight"), columns);
        let zero = self.g.float(0.0);
        self.g.linear(x, &weight, &zero)
    }

    fn norm_relu(&mut self, x: &Tensor, name: &str) -> Tensor {
        let (scale, shift) = (self.constant(&format!("{name}.weight")), self.constant(&format!("{name}.bias")));
        let normed = self.g.layer_norm(x, &scale, &shift);
        self.g.map("Relu", &normed)
    }

    /// Linear, LayerNorm, ReLU, Linear.
    pub(super) fn mlp(&mut self, x: &Tensor, name: &str) -> Tensor {
        let x = self.linear(x, &format!("{name}.0"));
        let x = self.norm_relu(&x, &format!("{name}.1"));
        self.linear(&x, &format!("{name}.3"))
    }

    /// ReLU(Linear), the embedding of points.
    pub(super) fn embed(&mut self, x: &Tensor, name: &str) -> Tensor {
        let x = self.linear(x, name);
        self.g.map("Relu", &x)
    }

    /// The hidden states of the UAVs after the slot.
    pub(super) fn gru(&mut self, x: &Tensor, h: &Tensor) -> Tensor {
        let width = HIDDEN as i64;
        let (wi, bi) = (self.constant("agent.rnn.weight_ih"), self.constant("agent.rnn.bias_ih"));
        let (wh, bh) = (self.constant("agent.rnn.weight_hh"), self.constant("agent.rnn.bias_hh"));
        let g = &mut self.g;
        let (of_input, of_state) = (g.linear(x, &wi, &bi), g.linear(h, &wh, &bh));
        let gate = |g: &mut Graph, part: i64| {
            let [a, b] = [&of_input, &of_state].map(|all| g.slice(all, 1, part * width, (part + 1) * width));
            let sum = g.with("Add", &a, &b);
            g.map("Sigmoid", &sum)
        };
        let (r, z) = (gate(g, 0), gate(g, 1));
        let [a, u] = [&of_input, &of_state].map(|all| g.slice(all, 1, 2 * width, 3 * width));
        let reset = g.with("Mul", &r, &u);
        let sum = g.with("Add", &a, &reset);
        let n = g.map("Tanh", &sum);
        let difference = g.with("Sub", h, &n);
        let kept = g.with("Mul", &z, &difference);
        g.with("Add", &n, &kept)
    }

    /// The sum over the edges of each node of `values` (E, width).
    fn sum_by_node(&mut self, edges: &Edges, values: &Tensor, width: i64) -> Tensor {
        let width = self.g.list(&[width]);
        let shape = self.g.concat(&[&edges.nodes, &width], 0);
        let zeros = self.g.zeros(&shape);
        let from = self.g.unsqueeze(&edges.from, &[1]);
        self.g.scatter(&zeros, &from, values, true)
    }

    /// Whether the target of each edge is a user, (E), and its index among the users or, for a UAV, N.
    fn users_of(&mut self, edges: &Edges) -> (Tensor, Tensor) {
        let is_user = self.g.with("GreaterOrEqual", &edges.to, &edges.uavs);
        let index = self.g.with("Sub", &edges.to, &edges.uavs);
        let index = self.g.select(&is_user, &index, &edges.users);
        (is_user, index)
    }

    /// The observation of every node, (M + N, width). `aoi`: AoI / K of the users.
    pub(super) fn observations(&mut self, edges: &Edges, aoi: &Tensor) -> Tensor {
        let (is_user, index) = self.users_of(edges);
        let zero = self.g.floats(&[1], &[0.0]);
        // One more, for targets that are UAVs.
        let padded = self.g.concat(&[aoi, &zero], 0);
        let of_target = self.g.gather(&padded, &index);
        let of_target = self.g.unsqueeze(&of_target, &[1]);
        let config = *self.agent.config();
        let is_set = config.observation == crate::policy::ObservationKind::Set;
        let scale = if is_set || config.normalise { 1.0 / self.agent.dims().env.detection_range } else { 1.0 };
        let scale = self.g.float(scale as f32);
        let relative = self.g.with("Mul", &edges.relative, &scale);
        let points = self.g.concat(&[&relative, &of_target], 1);
        if is_set {
            self.set_observations(edges, (&relative, &points, &is_user), aoi)
        } else {
            self.flat_observations(edges, &points, aoi)
        }
    }

    fn set_observations(
        &mut self,
        edges: &Edges,
        (relative, points, is_user): (&Tensor, &Tensor, &Tensor),
        aoi: &Tensor,
    ) -> Tensor {
        let width = HIDDEN as i64;
        let (uav, user) = (self.embed(relative, "agent.sets.uav"), self.embed(points, "agent.sets.user"));
        let zero = self.g.float(0.0);
        let is_user = self.g.unsqueeze(is_user, &[1]);
        let uav = self.g.select(&is_user, &zero, &uav);
        let user = self.g.select(&is_user, &user, &zero);
        let both = self.g.concat(&[&uav, &user], 1);
        let sums = self.sum_by_node(edges, &both, 2 * width);
        // A user also observes itself.
        let own = self.g.unsqueeze(aoi, &[1]);
        let place = self.g.floats(&[1, 2], &[0.0, 0.0]);
        let two = self.g.list(&[2]);
        let shape = self.g.concat(&[&edges.users, &two], 0);
        let place = self.g.expand(&place, &shape);
        let own = self.g.concat(&[&place, &own], 1);
        let own = self.embed(&own, "agent.sets.user");
        let wide = self.g.list(&[width]);
        let of_users = self.g.concat(&[&edges.users, &wide], 0);
        let left = self.g.zeros(&of_users);
        let own = self.g.concat(&[&left, &own], 1);
        let both = self.g.list(&[2 * width]);
        let of_uavs = self.g.concat(&[&edges.uavs, &both], 0);
        let none = self.g.zeros(&of_uavs);
        let own = self.g.concat(&[&none, &own], 0);
        self.g.with("Add", &sums, &own)
    }

    fn flat_observations(&mut self, edges: &Edges, points: &Tensor, aoi: &Tensor) -> Tensor {
        let (uavs, users) = (self.agent.dims().uavs as i64, self.agent.dims().users as i64);
        let three = self.g.list(&[3]);
        let shape = self.g.concat(&[&edges.nodes, &edges.nodes, &three], 0);
        let zeros = self.g.zeros(&shape);
        let [from, to] = [&edges.from, &edges.to].map(|ends| self.g.unsqueeze(ends, &[1]));
        let pairs = self.g.concat(&[&from, &to], 1);
        let all = self.g.scatter(&zeros, &pairs, points, false);
        // A user observes itself, at distance 0.
        let own = self.g.range(&edges.users);
        let own = self.g.with("Add", &own, &edges.uavs);
        let own = self.g.unsqueeze(&own, &[1]);
        let column = self.g.list(&[2]);
        let column = self.g.expand(&column, &edges.users);
        let column = self.g.unsqueeze(&column, &[1]);
        let places = self.g.concat(&[&own, &own, &column], 1);
        let all = self.g.scatter(&all, &places, aoi, false);
        let of_uavs = self.g.slice(&all, 1, 0, uavs);
        let of_uavs = self.g.slice(&of_uavs, 2, 0, 2);
        let of_users = self.g.slice(&all, 1, uavs, i64::MAX);
        let (left, right) = (self.g.list(&[-1, 2 * uavs]), self.g.list(&[-1, 3 * users]));
        let (left, right) = (self.g.reshape(&of_uavs, &left), self.g.reshape(&of_users, &right));
        self.g.concat(&[&left, &right], 1)
    }

    /// The edges of graph layers: the detections, and with self loops every node to itself.
    fn layer_edges(&mut self, edges: &Edges) -> Edges {
        let (mut from, mut to) = (edges.from.clone(), edges.to.clone());
        if self.agent.config().self_loops {
            let own = self.g.range(&edges.nodes);
            (from, to) = (self.g.concat(&[&from, &own], 0), self.g.concat(&[&to, &own], 0));
        }
        let (uavs, users, nodes) = (edges.uavs.clone(), edges.users.clone(), edges.nodes.clone());
        Edges { from, to, relative: edges.relative.clone(), uavs, users, nodes }
    }

    /// The network of the edges `name`, aggregated over the neighbours of each node. `difference`: of x_i and x_j - x_i, else of x_i and
    /// x_j.
    fn edge_net(&mut self, edges: &Edges, x: &Tensor, name: &str, (difference, mean): (bool, bool)) -> Tensor {
        let first = format!("{name}.0");
        let own = self.product(x, &first, 0..HIDDEN);
        let other = self.product(x, &first, HIDDEN..2 * HIDDEN);
        let bias = self.constant(&format!("{first}.bias"));
        let own = self.g.with("Add", &own, &bias);
        let own = if difference { self.g.with("Sub", &own, &other) } else { own };
        let (own, other) = (self.g.gather(&own, &edges.from), self.g.gather(&other, &edges.to));
        let pairs = self.g.with("Add", &own, &other);
        let pairs = self.norm_relu(&pairs, &format!("{name}.1"));
        let outputs = self.linear(&pairs, &format!("{name}.3"));
        let sums = self.sum_by_node(edges, &outputs, HIDDEN as i64);
        if !mean {
            return sums;
        }
        let degree = self.degrees(edges, None);
        self.g.with("Div", &sums, &degree)
    }

    /// Number of edges of each node, at least 1, (M + N, 1); only of those in `mask` (E, 1), if given.
    fn degrees(&mut self, edges: &Edges, mask: Option<&Tensor>) -> Tensor {
        let ones = if let Some(mask) = mask {
            self.g.cast(mask, DataType::Float)
        } else {
            let one = self.g.list(&[1]);
            let count = self.g.size(&edges.from, 0);
            let shape = self.g.concat(&[&count, &one], 0);
            let one = self.g.float(1.0);
            self.g.expand(&one, &shape)
        };
        let degrees = self.sum_by_node(edges, &ones, 1);
        let one = self.g.float(1.0);
        self.g.with("Max", &degrees, &one)
    }

    fn rgcn(&mut self, edges: &Edges, x: &Tensor, name: &str) -> Tensor {
        let root = self.linear(x, &format!("{name}.root"));
        let (is_user, _) = self.users_of(edges);
        let is_user = self.g.unsqueeze(&is_user, &[1]);
        let is_uav = self.g.map("Not", &is_user);
        let values = self.g.gather(x, &edges.to);
        let zero = self.g.float(0.0);
        let means = [&is_uav, &is_user].map(|kind| {
            let chosen = self.g.select(kind, &values, &zero);
            let sums = self.sum_by_node(edges, &chosen, HIDDEN as i64);
            let degrees = self.degrees(edges, Some(kind));
            self.g.with("Div", &sums, &degrees)
        });
        let relations = self.constant(&format!("{name}.rel"));
        let relation = |g: &mut Graph, r: i64, mean: &Tensor| {
            let index = g.integer(r);
            let weight = g.gather(&relations, &index);
            g.with("MatMul", mean, &weight)
        };
        let of_kind = |g: &mut Graph, [a, b]: [i64; 2]| {
            let (a, b) = (relation(g, a, &means[0]), relation(g, b, &means[1]));
            g.with("Add", &a, &b)
        };
        let (uavs, users) = (of_kind(&mut self.g, [0, 1]), of_kind(&mut self.g, [1, 2]));
        let index = self.g.range(&edges.nodes);
        let is_uav = self.g.with("Less", &index, &edges.uavs);
        let is_uav = self.g.unsqueeze(&is_uav, &[1]);
        let related = self.g.select(&is_uav, &uavs, &users);
        self.g.with("Add", &root, &related)
    }

    /// The output of the graph layers for the UAVs, (M, 64).
    pub(super) fn graph_layers(&mut self, edges: &Edges, h: &Tensor, observations: &Tensor) -> Tensor {
        let of_users = self.g.list(&[i64::MAX]);
        let of_users = self.g.slice_at(observations, 0, &edges.uavs, &of_users);
        let (uavs, users) = (self.linear(h, "agent.w1"), self.linear(&of_users, "agent.w2"));
        let mut x = self.g.concat(&[&uavs, &users], 0);
        x = self.g.leaky_relu(&x, SLOPE);
        let edges = self.layer_edges(edges);
        let config = *self.agent.config();
        for l in 0..config.layers {
            let name = format!("agent.layers.{l}");
            let y = match config.gnn {
                Gnn::None | Gnn::EdgeConv => {
                    self.edge_net(&edges, &x, &format!("{name}.f"), (true, config.aggregation == Aggregation::Mean))
                }
                Gnn::AggGnn => {
                    let message = self.edge_net(&edges, &x, &format!("{name}.com"), (false, true));
                    let both = self.g.concat(&[&x, &message], 1);
                    self.mlp(&both, &format!("{name}.update"))
                }
                Gnn::Rgcn => self.rgcn(&edges, &x, &name),
            };
            x = if l + 1 < config.layers { self.g.map("Relu", &y) } else { y };
        }
        let zero = self.g.list(&[0]);
        self.g.slice_at(&x, 0, &zero, &edges.uavs)
    }
}
