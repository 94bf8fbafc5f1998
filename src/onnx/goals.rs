//! The goals of UAVs (docs/model.md, "Goals") as ONNX operators. The formulas and the order of their operations are those of
//! `policy::goals`: positions and times are f64, so that thresholds and roundings fall alike.

use super::graph::{Graph, Tensor};
use super::memory::{Memory, Sight};
use super::network::Network;
use crate::env::{DIRECTIONS, EnvConfig};
use crate::nn::HIDDEN;
use crate::policy::memory::GRID;
use crate::policy::{EnvParams, Goals};
use crate::wire::onnx::tensor_proto::DataType;

/// Blocks along each side, and cells along each side of a block.
const BLOCKS: usize = Goals::BLOCKS;
const SIDE: usize = GRID / BLOCKS;
/// A coordinate that is out of range of everything.
const FAR: f64 = 1e9;
/// A number beyond all others. It is finite, because it is multiplied by 0 (see [`Graph::choose`]).
const HUGE: f64 = 1e300;

/// The goals of all UAVs, (M, G): first the users, then the blocks of ground.
pub(super) struct GoalTable {
    valid: Tensor,
    headings: Tensor,
    /// (M, G, 16), f32; with advice (M, G, 17).
    features: Tensor,
}

impl Network<'_> {
    /// The goals. `bounds` (M, 6) are those of the UAVs' sectors, `last` (M) their last headings, `advised` (M) the advised ones.
    pub(super) fn goals(
        &mut self,
        memory: &Memory,
        sight: &Sight,
        (positions, slot, bounds): (&Tensor, &Tensor, &Tensor),
        (last, advised): (&Tensor, Option<&Tensor>),
    ) -> GoalTable {
        let env = self.agent.dims().env;
        let state = self.g.column(&memory.users, 0);
        let known = self.known(&state);
        let g = &mut self.g;
        let ground = Ground::new(g, &memory.ground);
        let number = g.indicator(&known);
        let number = g.sum(&number, &[1], true);
        let all = g.size(&memory.users, 1);
        let all = g.cast(&all, DataType::Double);
        let unknown = g.with("Sub", &all, &number);
        let common = common(g, (&ground.unsearched, &unknown, &number, &all), positions);
        let targets = g.slice(&memory.users, 2, 1, 3);
        let targets = g.cast(&targets, DataType::Double);
        let own = [
            user_features(g, &env, memory, (&targets, &known), (positions, slot)),
            ground.features(g, &env, (positions, slot), (&unknown, bounds)),
        ];
        let targets = g.concat(&[&targets, &ground.centers], 1);
        let valid = g.concat(&[&known, &ground.valid], 1);
        let (headings, shared) = headings_and_shared(g, &env, sight, (positions, &targets, last));
        let one = g.double(0.0);
        let zeros = g.with("Mul", &shared[0], &one);
        let mut columns: Vec<Tensor> = own[0].iter().zip(&own[1]).map(|(users, ground)| g.concat(&[users, ground], 1)).collect();
        // The same for all goals of a UAV.
        columns.extend(common.iter().map(|column| g.with("Add", column, &zeros)));
        columns.extend(shared);
        columns.extend(advised.map(|advised| towards(g, &headings, advised)));
        let features = g.stack(&columns);
        GoalTable { valid, headings, features: g.cast(&features, DataType::Float) }
    }

    /// Adds the best score per heading to the Q-values.
    pub(super) fn score_goals(&mut self, goals: &GoalTable, context: &[&Tensor], q: &Tensor) -> Tensor {
        let name = "agent.goals.0";
        let features = Goals::FEATURES + usize::from(!self.agent.config().advice.is_none());
        let weight = self.columns(&format!("{name}.weight"), 0..features);
        let weight = self.g.transpose(&weight);
        let mut hidden = self.g.with("MatMul", &goals.features, &weight);
        let bias = self.constant(&format!("{name}.bias"));
        hidden = self.g.with("Add", &hidden, &bias);
        for (part, rows) in context.iter().enumerate() {
            let from = features + part * HIDDEN;
            let product = self.product(rows, name, from..from + HIDDEN);
            let product = self.g.unsqueeze(&product, &[1]);
            hidden = self.g.with("Add", &hidden, &product);
        }
        let hidden = self.g.map("Relu", &hidden);
        let value = self.constant("agent.goals.2.weight");
        let value = self.g.transpose(&value);
        let score = self.g.with("MatMul", &hidden, &value);
        let bias = self.constant("agent.goals.2.bias");
        let score = self.g.with("Add", &score, &bias);
        let none = self.constant("agent.goals.none");
        let actions: Vec<i64> = (0..self.agent.dims().env.actions as i64).collect();
        let g = &mut self.g;
        let all = g.ints(&[1, 1, actions.len() as i64], &actions);
        let heading = g.unsqueeze(&goals.headings, &[2]);
        let chosen = g.with("Equal", &heading, &all);
        let valid = g.unsqueeze(&goals.valid, &[2]);
        let chosen = g.with("And", &chosen, &valid);
        let lowest = g.float(f32::MIN);
        let scores = g.select(&chosen, &score, &lowest);
        let best = g.max(&scores, 1, false);
        let any = g.cast(&chosen, DataType::Float);
        let any = g.max(&any, 1, false);
        let zero = g.float(0.0);
        let any = g.with("Greater", &any, &zero);
        let best = g.select(&any, &best, &none);
        g.with("Add", q, &best)
    }
}

/// The features that all goals of a UAV share: (M, 1) each.
fn common(
    g: &mut Graph,
    (unsearched, unknown, known, all): (&Tensor, &Tensor, &Tensor, &Tensor),
    positions: &Tensor,
) -> [Tensor; 4] {
    let share = g.times(unsearched, 1.0 / (GRID * GRID) as f64);
    let expected = g.with("Mul", &share, unknown);
    let expected = g.ln1(&expected);
    let all = g.at_least(all, 1.0);
    let uavs = g.size(positions, 0);
    let uavs = g.cast(&uavs, DataType::Double);
    let per_uav = g.with("Div", known, &uavs);
    [expected, g.with("Div", unknown, &all), share, g.ln1(&per_uav)]
}

/// The features of the remembered users as goals: (M, N) each.
fn user_features(
    g: &mut Graph,
    env: &EnvParams,
    memory: &Memory,
    (targets, known): (&Tensor, &Tensor),
    (positions, slot): (&Tensor, &Tensor),
) -> [Tensor; 7] {
    let range = env.transmission_range;
    let [collected, observed] = [3, 4].map(|column| {
        let column = g.column(&memory.users, column);
        let column = g.cast(&column, DataType::Double);
        g.with("Sub", slot, &column)
    });
    let offsets = g.difference((targets, &[]), (positions, &[1]));
    let slots = g.travel(env, &offsets, range);
    let age = g.with("Add", &collected, &slots);
    let rate = g.with("Div", &age, &slots);
    // The best AoI per slot that the next flight, from there, promises: (M, N, N).
    let between = g.difference((targets, &[1]), (targets, &[2]));
    // The order of the axes: from, to. Travel is symmetric.
    let onward = g.travel(env, &between, range);
    let from = g.unsqueeze(&slots, &[2]);
    let total = g.with("Add", &from, &onward);
    let next = g.unsqueeze(&collected, &[1]);
    let next = g.with("Add", &next, &total);
    let next = g.with("Div", &next, &onward);
    let count = g.size(targets, 1);
    let index = g.range(&count);
    let (rows, columns) = (g.unsqueeze(&index, &[1]), g.unsqueeze(&index, &[0]));
    let same = g.with("Equal", &rows, &columns);
    let other = g.map("Not", &same);
    let valid = g.unsqueeze(known, &[1]);
    let other = g.with("And", &valid, &other);
    let zero = g.double(0.0);
    let next = g.choose(&other, &next, &zero);
    // At least 0, also without users.
    let none = g.times(&slots, 0.0);
    let none = g.unsqueeze(&none, &[2]);
    let next = g.concat(&[&next, &none], 2);
    let next = g.max(&next, 2, false);
    let zeros = g.times(&slots, 0.0);
    let one = g.double(1.0);
    let inverse = g.with("Div", &one, &slots);
    [g.add_to(&zeros, 1.0), g.ln1(&slots), inverse, g.ln1(&age), g.ln1(&rate), g.ln1(&next), g.ln1(&observed)]
}

/// The ground that was not searched, by block.
struct Ground {
    /// Cells per block, (M, 25), f64.
    blocks: Tensor,
    /// Mean positions of these cells, (M, 25, 2).
    centers: Tensor,
    /// Cells of all blocks, (M, 1).
    unsearched: Tensor,
    /// Blocks with cells, (M, 25).
    valid: Tensor,
}

impl Ground {
    fn new(g: &mut Graph, ground: &Tensor) -> Self {
        let cells = g.unsearched(ground);
        let (grid, side, blocks) = (GRID as i64, SIDE as i64, BLOCKS as i64);
        let numbers: Vec<f64> = (0..GRID).map(|k| k as f64).collect();
        let (columns, rows) = (g.doubles(&[1, grid], &numbers), g.doubles(&[grid, 1], &numbers));
        let by_block = |g: &mut Graph, values: &Tensor| {
            let shape = g.list(&[-1, blocks, side, blocks, side]);
            let values = g.reshape(values, &shape);
            let sums = g.sum(&values, &[2, 4], false);
            let shape = g.list(&[-1, blocks * blocks]);
            g.reshape(&sums, &shape)
        };
        let counts = by_block(g, &cells);
        let zero = g.double(0.0);
        let valid = g.with("Greater", &counts, &zero);
        let some = g.at_least(&counts, 1.0);
        let far = g.double(FAR);
        let centers = [&columns, &rows].map(|numbers| {
            let weighted = g.with("Mul", &cells, numbers);
            let sums = by_block(g, &weighted);
            let mean = g.with("Div", &sums, &some);
            let mean = g.add_to(&mean, 0.5);
            let mean = g.over(&mean, GRID as f64);
            g.choose(&valid, &mean, &far)
        });
        let centers = g.stack(&centers);
        let unsearched = g.sum(&counts, &[1], true);
        Self { blocks: counts, centers, unsearched, valid }
    }

    /// The features of the blocks as goals: (M, 25) each.
    fn features(
        &self,
        g: &mut Graph,
        env: &EnvParams,
        (positions, slot): (&Tensor, &Tensor),
        (unknown, bounds): (&Tensor, &Tensor),
    ) -> [Tensor; 7] {
        let range = env.detection_range;
        let offsets = g.difference((&self.centers, &[]), (positions, &[1]));
        let slots = g.travel(env, &offsets, range);
        // Cells of the blocks near each block.
        let between = g.difference((&self.centers, &[1]), (&self.centers, &[2]));
        let (distance, limit) = (g.squares(&between), g.double(range * range));
        let near = g.with("LessOrEqual", &distance, &limit);
        let cells = g.unsqueeze(&self.blocks, &[1]);
        let zero = g.double(0.0);
        let within = g.choose(&near, &cells, &zero);
        let within = g.sum(&within, &[2], false);
        let some = g.at_least(&self.unsearched, 1.0);
        let expected = g.with("Mul", unknown, &within);
        let expected = g.with("Div", &expected, &some);
        let age = g.with("Add", slot, &slots);
        let rate = g.with("Mul", &expected, &age);
        let rate = g.with("Div", &rate, &slots);
        let own = owned(g, &self.centers, bounds);
        let own = g.indicator(&own);
        let zeros = g.times(&slots, 0.0);
        let one = g.double(1.0);
        [zeros, g.ln1(&slots), g.with("Div", &one, &slots), g.ln1(&age), g.ln1(&rate), g.ln1(&expected), own]
    }
}

/// Whether points (M, B, 2) are in the sectors of the UAVs (M, 6): directions of the middle, of the end and of the start.
pub(super) fn owned(g: &mut Graph, points: &Tensor, bounds: &Tensor) -> Tensor {
    let middle = g.double(0.5);
    let points = g.with("Sub", points, &middle);
    let [x, y] = g.xy(&points);
    // The middle of the square counts as the direction of angle 0.
    let (zero, one) = (g.double(0.0), g.double(1.0));
    let at_middle = [&x, &y].map(|x| g.with("Equal", x, &zero));
    let at_middle = g.with("And", &at_middle[0], &at_middle[1]);
    let x = g.choose(&at_middle, &one, &x);
    // a x b, positive if b is to the left of a.
    let cross = |g: &mut Graph, part: i64| {
        let [dx, dy] = [2 * part, 2 * part + 1].map(|column| {
            let column = g.column(bounds, column);
            g.unsqueeze(&column, &[1])
        });
        let (left, right) = (g.with("Mul", &dx, &y), g.with("Mul", &dy, &x));
        g.with("Sub", &left, &right)
    };
    let (from_middle, from_end, from_start) = (cross(g, 0), cross(g, 1), cross(g, 2));
    let is_left = g.with("GreaterOrEqual", &from_middle, &zero);
    let before_end = g.with("LessOrEqual", &from_end, &zero);
    let after_start = g.with("GreaterOrEqual", &from_start, &zero);
    let is_right = g.map("Not", &is_left);
    let (left, right) = (g.with("And", &is_left, &before_end), g.with("And", &is_right, &after_start));
    g.with("Or", &left, &right)
}

/// The headings towards `targets` (M, G, 2), and the features that follow from heading and distance: (M, G) each.
fn headings_and_shared(
    g: &mut Graph,
    env: &EnvParams,
    sight: &Sight,
    (positions, targets, last): (&Tensor, &Tensor, &Tensor),
) -> (Tensor, Vec<Tensor>) {
    let headings = headings_toward(g, env, positions, targets);
    let [mine, nearest] = distances(g, sight, positions, targets);
    let lead = g.with("Sub", &nearest, &mine);
    let lead = g.over(&lead, env.detection_range);
    let contested = g.with("Less", &nearest, &mine);
    let contested = g.indicator(&contested);
    let onward = towards(g, &headings, last);
    let away = g.over(&mine, env.detection_range);
    let away = g.add_to(&away, -1.0);
    let (low, high) = (g.double(-1.0), g.double(1.0));
    let clamp = |g: &mut Graph, x: &Tensor| {
        let x = g.with("Min", x, &high);
        g.with("Max", &x, &low)
    };
    let (lead, away) = (clamp(g, &lead), clamp(g, &away));
    let zeros = g.times(&mine, 0.0);
    let ones = g.add_to(&zeros, 1.0);
    (headings, vec![lead, contested, onward, away, ones])
}

/// Whether each of `headings` (M, G) is the one of its UAV in `of_uavs` (M).
fn towards(g: &mut Graph, headings: &Tensor, of_uavs: &Tensor) -> Tensor {
    let of_uavs = g.unsqueeze(of_uavs, &[1]);
    let equal = g.with("Equal", headings, &of_uavs);
    g.indicator(&equal)
}

/// The heading from each position (M, 2) towards each of its `targets` (M, G, 2): (M, G).
pub(super) fn headings_toward(g: &mut Graph, env: &EnvParams, positions: &Tensor, targets: &Tensor) -> Tensor {
    let compass = EnvConfig::COMPASS as i64;
    let direction = |axis: usize| DIRECTIONS[..EnvConfig::COMPASS].iter().map(|d| d[axis]).collect::<Vec<f64>>();
    let [right, up] = [0, 1].map(|axis| g.doubles(&[compass], &direction(axis)));
    let [dx, dy] = g.difference((targets, &[]), (positions, &[1]));
    let (dx, dy) = (g.unsqueeze(&dx, &[2]), g.unsqueeze(&dy, &[2]));
    let (a, b) = (g.with("Mul", &dx, &right), g.with("Mul", &dy, &up));
    let progress = g.with("Add", &a, &b);
    let inside = stays_inside(g, env, positions, [&right, &up]);
    let lowest = g.double(-HUGE);
    let progress = g.choose(&inside, &progress, &lowest);
    g.arg_max(&progress, 2)
}

/// The distances of each UAV, and of the nearest other one that it detects, from its `targets` (M, G, 2): (M, G) each.
pub(super) fn distances(g: &mut Graph, sight: &Sight, positions: &Tensor, targets: &Tensor) -> [Tensor; 2] {
    let mine = g.difference((targets, &[]), (positions, &[1]));
    let others = g.difference((&sight.uavs, &[2]), (targets, &[1]));
    let (mine, others) = (g.length(&mine), g.length(&others));
    let sees = g.unsqueeze(&sight.sees_uav, &[2]);
    let far = g.double(HUGE);
    let others = g.choose(&sees, &others, &far);
    [mine, g.min(&others, 1)]
}

/// Whether each heading stays in the area, (M, 1, 8); all do if none does.
fn stays_inside(g: &mut Graph, env: &EnvParams, positions: &Tensor, directions: [&Tensor; 2]) -> Tensor {
    let (low, high) = (g.double(0.0), g.double(1.0));
    let at = g.xy(positions);
    let [x, y] = [0, 1].map(|axis| {
        let at = g.unsqueeze(&at[axis], &[1, 2]);
        let step = g.times(directions[axis], env.speed);
        let next = g.with("Add", &at, &step);
        let (above, below) = (g.with("GreaterOrEqual", &next, &low), g.with("LessOrEqual", &next, &high));
        g.with("And", &above, &below)
    });
    let inside = g.with("And", &x, &y);
    let number = g.indicator(&inside);
    let any = g.max(&number, 2, true);
    let none = g.with("Equal", &any, &low);
    g.with("Or", &inside, &none)
}
