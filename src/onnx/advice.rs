//! The headings that the rule `sweep` advises (docs/model.md, "Advice") as ONNX operators. The formulas and the order of their
//! operations are those of `policy::sweep_plan`, so scores have the same bits, and of equal ones the same is the first.

use super::goals::{distances, headings_toward, owned};
use super::graph::{Graph, Tensor};
use super::memory::{Memory, Sight};
use super::network::Network;
use super::sectors;
use crate::env::Point;
use crate::policy::EnvParams;
use crate::policy::memory::GRID;
use crate::policy::sweep_plan::{BLOCKS, WEIGHTS};
use crate::wire::onnx::tensor_proto::DataType;

/// Number of blocks of ground.
const ALL: usize = BLOCKS * BLOCKS;

/// What the UAVs are advised.
pub(super) struct Advice {
    /// The advised headings, (M).
    pub(super) headings: Tensor,
    /// What is added to their Q-values, (M, 1).
    bias: Tensor,
    /// What a better heading has to gain, (M, 1).
    margin: Tensor,
    /// Whether the fleet has more UAVs than those of the training, ().
    untrained: Tensor,
}

impl Network<'_> {
    /// The advice from what the UAVs remember. `sector` (M) are rows of the tables of sectors, `bounds` (M, 6) those of the UAVs'
    /// sectors.
    pub(super) fn advice(
        &mut self,
        memory: &Memory,
        sight: &Sight,
        (positions, slot): (&Tensor, &Tensor),
        (sector, bounds): (&Tensor, &Tensor),
    ) -> Advice {
        let env = self.agent.dims().env;
        let bias = self.constant("agent.advice");
        let state = self.g.column(&memory.users, 0);
        let known = self.known(&state);
        let g = &mut self.g;
        let number = g.indicator(&known);
        let number = g.sum(&number, &[1], true);
        let all = g.size(&memory.users, 1);
        let all = g.cast(&all, DataType::Double);
        let unknown = g.with("Sub", &all, &number);
        let uavs = g.size(positions, 0);

        let users = g.slice(&memory.users, 2, 1, 3);
        let users = g.cast(&users, DataType::Double);
        let serving = user_scores(g, &env, (memory, sight), (&users, &known), (positions, slot, bounds));
        let searching = block_scores(g, &env, (&memory.ground, &unknown), (positions, slot, sector));
        // Of equal scores, the first is the best; a UAV with nothing to do flies to the centre.
        let nothing = g.times(&unknown, 0.0);
        let scores = g.concat(&[&nothing, &serving, &searching], 1);
        let of_each = |g: &mut Graph, points: &[Point]| {
            let points = points_constant(g, points);
            let size = g.list(&[1, 1]);
            let size = g.concat(&[&uavs, &size], 0);
            g.expand(&points, &size)
        };
        let (centre, blocks) = (of_each(g, &[[0.5; 2]]), of_each(g, &centres()));
        let targets = g.concat(&[&centre, &users, &blocks], 1);
        let (rows, best) = (g.range(&uavs), g.arg_max(&scores, 1));
        let indices = g.stack(&[rows, best]);
        let target = g.gather_nd(&targets, &indices);
        let target = g.unsqueeze(&target, &[1]);
        let headings = headings_toward(g, &env, positions, &target);
        let headings = g.column(&headings, 0);

        let uavs = g.cast(&uavs, DataType::Double);
        let load = g.with("Div", &number, &uavs);
        let load = g.at_least(&load, 1.0);
        let load = g.cast(&load, DataType::Float);
        let margin = g.float(self.advice_margin);
        let margin = g.with("Mul", &load, &margin);
        let most = g.double(self.most_uavs as f64);
        let untrained = g.with("Greater", &uavs, &most);
        Advice { headings, bias, margin, untrained }
    }

    /// The Q-values with what the advised headings gain: in a fleet that was not trained, at least as much as any other has.
    pub(super) fn trust(&mut self, q: &Tensor, advice: &Advice) -> Tensor {
        let actions = self.agent.dims().env.actions;
        let advised = self.g.one_hot(&advice.headings, actions);
        let g = &mut self.g;
        let gain = g.with("Mul", &advised, &advice.bias);
        let q = g.with("Add", q, &gain);
        let own = g.with("Mul", &advised, &q);
        let own = g.sum(&own, &[1], true);
        let highest = g.max(&q, 1, true);
        let base = g.select(&advice.untrained, &highest, &own);
        let gain = g.with("Sub", &base, &own);
        let gain = g.with("Add", &gain, &advice.margin);
        let gain = g.with("Mul", &advised, &gain);
        g.with("Add", &q, &gain)
    }
}

fn points_constant(g: &mut Graph, points: &[Point]) -> Tensor {
    g.doubles(&[1, points.len() as i64, 2], points.as_flattened())
}

/// The centres of the blocks, row by row.
fn centres() -> [Point; ALL] {
    std::array::from_fn(|block| [block % BLOCKS, block / BLOCKS].map(|k| (k as f64 + 0.5) / BLOCKS as f64))
}

/// The scores of the remembered users, (M, N); 0 where there is nothing to collect.
fn user_scores(
    g: &mut Graph,
    env: &EnvParams,
    (memory, sight): (&Memory, &Sight),
    (users, known): (&Tensor, &Tensor),
    (positions, slot, bounds): (&Tensor, &Tensor, &Tensor),
) -> Tensor {
    let collected = g.column(&memory.users, 3);
    let collected = g.cast(&collected, DataType::Double);
    let since = g.with("Sub", slot, &collected);
    let offsets = g.difference((users, &[]), (positions, &[1]));
    let slots = g.travel(env, &offsets, env.transmission_range);
    let age = g.with("Add", &since, &slots);
    let power = g.double(WEIGHTS.time_power);
    let time = g.with("Pow", &slots, &power);
    let score = g.with("Div", &age, &time);
    let [mine, nearest] = distances(g, sight, positions, users);
    let nearer = g.with("Less", &nearest, &mine);
    let foreign = owned(g, users, bounds);
    let foreign = g.map("Not", &foreign);
    let as_near = g.with("Equal", &nearest, &mine);
    let foreign = g.with("And", &as_near, &foreign);
    let contested = g.with("Or", &nearer, &foreign);
    let (one, less, zero) = (g.double(1.0), g.double(WEIGHTS.contested), g.double(0.0));
    let weight = g.choose(&contested, &less, &one);
    let score = g.with("Mul", &score, &weight);
    let waits = g.with("Greater", &since, &zero);
    let counts = g.with("And", known, &waits);
    g.choose(&counts, &score, &zero)
}

/// The scores of the blocks of ground, (M, 100); 0 for those that are searched.
fn block_scores(
    g: &mut Graph,
    env: &EnvParams,
    (ground, unknown): (&Tensor, &Tensor),
    (positions, slot, sector): (&Tensor, &Tensor, &Tensor),
) -> Tensor {
    let side = GRID / BLOCKS;
    let (zero, one) = (g.double(0.0), g.double(1.0));
    let cells = g.unsearched(ground);
    let shape = g.list(&[-1, BLOCKS as i64, side as i64, BLOCKS as i64, side as i64]);
    let cells = g.reshape(&cells, &shape);
    let cells = g.sum(&cells, &[2, 4], false);
    let shape = g.list(&[-1, ALL as i64]);
    let cells = g.reshape(&cells, &shape);
    let shares = g.over(&cells, (side * side) as f64);
    let unsearched = g.sum(&shares, &[1], true);
    let unsearched = g.at_least(&unsearched, 1.0);
    let per_block = g.with("Div", unknown, &unsearched);

    let own = sectors::owners(g, sector, &centres());
    let foreign = g.double(WEIGHTS.foreign_sector);
    let weights = g.choose(&own, &one, &foreign);
    let weights = g.with("Mul", &shares, &weights);
    // One addition after the other, in the order of the rule.
    let near = near(g, env.detection_range);
    let weights = g.unsqueeze(&weights, &[1]);
    let within = g.with("Mul", &near, &weights);
    let within = g.running_sum(&within, 2);
    let within = g.column(&within, ALL as i64 - 1);

    let blocks = points_constant(g, &centres());
    let offsets = g.difference((&blocks, &[]), (positions, &[1]));
    let slots = g.travel(env, &offsets, env.detection_range);
    let score = g.times(&within, WEIGHTS.search);
    let score = g.with("Mul", &score, &per_block);
    let arrival = g.with("Add", slot, &slots);
    let score = g.with("Mul", &score, &arrival);
    let time = g.add_to(&slots, 1.0);
    let score = g.with("Div", &score, &time);
    let valid = g.with("Greater", &shares, &zero);
    g.choose(&valid, &score, &zero)
}

/// 1 for the blocks whose centre is within `range` of that of each block, else 0: (1, 100, 100).
fn near(g: &mut Graph, range: f64) -> Tensor {
    let square = range * range;
    let near = |to: Point| centres().map(|p| f64::from((p[0] - to[0]).powi(2) + (p[1] - to[1]).powi(2) <= square));
    let values: Vec<f64> = centres().into_iter().flat_map(near).collect();
    g.doubles(&[1, ALL as i64, ALL as i64], &values)
}
