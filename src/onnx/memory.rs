//! What UAVs remember (docs/model.md, "Memory"), and their goals (docs/model.md, "Goals"), as ONNX operators. The formulas and the order
//! of their operations are those of `policy::memory` and `policy::goals`: positions and times are f64, so that thresholds and roundings
//! fall alike.

use super::graph::{Graph, Tensor};
use super::network::{Edges, Network};
use crate::env::{DIRECTIONS, EnvConfig};
use crate::nn::HIDDEN;
use crate::policy::memory::{GRID, Sharing};
use crate::policy::{EnvParams, Goals};
use crate::wire::onnx::tensor_proto::DataType;

/// Blocks along each side, and cells along each side of a block.
const BLOCKS: usize = Goals::BLOCKS;
const SIDE: usize = GRID / BLOCKS;
/// A coordinate that is out of range of everything.
const FAR: f64 = 1e9;
/// A number beyond all others. It is finite, because it is multiplied by 0 (see [`Graph::choose`]).
const HUGE: f64 = 1e300;

/// The memory of all UAVs.
pub(super) struct Memory {
    /// Whether each cell was searched, as 0 or 1, (M, 20, 20): rows, then columns.
    pub(super) ground: Tensor,
    /// (M, N, 5): state, x, y, slot of the last collection, slot of the observation.
    pub(super) users: Tensor,
}

/// What UAVs detect, as tables.
pub(super) struct Sight {
    /// Whether UAV i detects UAV j, (M, M).
    sees_uav: Tensor,
    /// Positions of the detected UAVs, (M, M, 2), f64.
    uavs: Tensor,
    /// Whether UAV i detects user j, (M, N).
    sees_user: Tensor,
    /// Positions of the detected users, (M, N, 2), f64.
    users: Tensor,
}

/// The goals of all UAVs, (M, G): first the users, then the blocks of ground.
pub(super) struct GoalTable {
    valid: Tensor,
    headings: Tensor,
    /// (M, G, 16), f32.
    features: Tensor,
}

/// Expressions of f64.
impl Graph {
    /// a if `condition`, else b. Both are finite, so one product is 0 and the sum is exact. Runtimes have `Where` for other types only.
    fn choose(&mut self, condition: &Tensor, a: &Tensor, b: &Tensor) -> Tensor {
        let other = self.map("Not", condition);
        let (is_a, is_b) = (self.indicator(condition), self.indicator(&other));
        let (a, b) = (self.with("Mul", a, &is_a), self.with("Mul", b, &is_b));
        self.with("Add", &a, &b)
    }

    fn add_to(&mut self, x: &Tensor, value: f64) -> Tensor {
        let value = self.double(value);
        self.with("Add", x, &value)
    }

    fn times(&mut self, x: &Tensor, value: f64) -> Tensor {
        let value = self.double(value);
        self.with("Mul", x, &value)
    }

    fn over(&mut self, x: &Tensor, value: f64) -> Tensor {
        let value = self.double(value);
        self.with("Div", x, &value)
    }

    fn at_least(&mut self, x: &Tensor, value: f64) -> Tensor {
        let value = self.double(value);
        self.with("Max", x, &value)
    }

    fn square(&mut self, x: &Tensor) -> Tensor {
        self.with("Mul", x, x)
    }

    /// ln(1 + x) for x above 0.
    fn ln1(&mut self, x: &Tensor) -> Tensor {
        let x = self.at_least(x, 0.0);
        let x = self.add_to(&x, 1.0);
        self.map("Log", &x)
    }

    /// The coordinates of points, the last axis.
    fn xy(&mut self, points: &Tensor) -> [Tensor; 2] {
        [self.column(points, 0), self.column(points, 1)]
    }

    /// Differences of the coordinates of `a` and `b`, at which axes of size 1 are added.
    fn difference(&mut self, a: (&Tensor, &[i64]), b: (&Tensor, &[i64])) -> [Tensor; 2] {
        let [a, b] = [a, b].map(|(points, axes)| {
            let [x, y] = self.xy(points);
            if axes.is_empty() { [x, y] } else { [self.unsqueeze(&x, axes), self.unsqueeze(&y, axes)] }
        });
        [self.with("Sub", &a[0], &b[0]), self.with("Sub", &a[1], &b[1])]
    }

    /// The sum of two squares.
    fn squares(&mut self, [x, y]: &[Tensor; 2]) -> Tensor {
        let (x, y) = (self.square(x), self.square(y));
        self.with("Add", &x, &y)
    }

    /// Slots of flight over the differences `[dx, dy]` until the target is within `range`.
    fn travel(&mut self, env: &EnvParams, [dx, dy]: &[Tensor; 2], range: f64) -> Tensor {
        let (dx, dy) = (self.map("Abs", dx), self.map("Abs", dy));
        let (long, short) = (self.with("Max", &dx, &dy), self.with("Min", &dx, &dy));
        let short = self.times(&short, std::f64::consts::SQRT_2 - 1.0);
        let path = self.with("Add", &long, &short);
        let path = self.add_to(&path, -range);
        let slots = self.over(&path, env.speed.max(1e-9));
        let slots = self.map("Ceil", &slots);
        self.at_least(&slots, 1.0)
    }

    /// 1 where `condition` holds, else 0, as f64.
    fn indicator(&mut self, condition: &Tensor) -> Tensor {
        self.cast(condition, DataType::Double)
    }

    /// Columns as the last axis.
    fn stack(&mut self, columns: &[Tensor]) -> Tensor {
        let columns: Vec<Tensor> = columns.iter().map(|column| self.unsqueeze(column, &[-1])).collect();
        self.concat(&columns.iter().collect::<Vec<_>>(), -1)
    }
}

impl Network<'_> {
    /// What the UAVs at `positions` (M, 2) detect.
    pub(super) fn sight(&mut self, edges: &Edges, positions: &Tensor) -> Sight {
        let g = &mut self.g;
        let three = g.list(&[3]);
        let shape = g.concat(&[&edges.nodes, &edges.nodes, &three], 0);
        let zeros = g.zeros(&shape);
        let [from, to] = [&edges.from, &edges.to].map(|ends| g.unsqueeze(ends, &[1]));
        let pairs = g.concat(&[&from, &to], 1);
        let (count, one) = (g.size(&edges.from, 0), g.list(&[1]));
        let shape = g.concat(&[&count, &one], 0);
        let one = g.float(1.0);
        let ones = g.expand(&one, &shape);
        let seen = g.concat(&[&edges.relative, &ones], 1);
        let all = g.scatter(&zeros, &pairs, &seen, false);
        let (first, end) = (g.list(&[0]), g.list(&[i64::MAX]));
        let of_uavs = g.slice_at(&all, 0, &first, &edges.uavs);
        let own = g.unsqueeze(positions, &[1]);
        let table = |g: &mut Graph, from: &Tensor, to: &Tensor| {
            let part = g.slice_at(&of_uavs, 1, from, to);
            let (seen, zero) = (g.column(&part, 2), g.float(0.0));
            let seen = g.with("Greater", &seen, &zero);
            let relative = g.slice(&part, 2, 0, 2);
            let relative = g.cast(&relative, DataType::Double);
            (seen, g.with("Add", &own, &relative))
        };
        let (sees_uav, uavs) = table(g, &first, &edges.uavs);
        let (sees_user, users) = table(g, &edges.uavs, &end);
        Sight { sees_uav, uavs, sees_user, users }
    }

    /// The memory after a slot, from that before. `aoi` (N) is f32, `slot` f64.
    pub(super) fn remember(
        &mut self,
        before: &Memory,
        sight: &Sight,
        (positions, aoi, slot): (&Tensor, &Tensor, &Tensor),
    ) -> Memory {
        let own = Memory {
            ground: self.search(&before.ground, positions),
            users: self.observe(&before.users, sight, (positions, aoi, slot)),
        };
        if self.agent.config().memory.sharing() == Some(Sharing::Shared) { self.exchange(&own, sight) } else { own }
    }

    /// Marks the cells whose centres are in range.
    fn search(&mut self, ground: &Tensor, positions: &Tensor) -> Tensor {
        let range = self.agent.dims().env.detection_range;
        let g = &mut self.g;
        let centers: Vec<f64> = (0..GRID).map(|k| (k as f64 + 0.5) / GRID as f64).collect();
        let (columns, rows) = (g.doubles(&[1, 1, GRID as i64], &centers), g.doubles(&[1, GRID as i64, 1], &centers));
        let [x, y] = g.xy(positions);
        let [x, y] = [x, y].map(|at| g.unsqueeze(&at, &[1, 2]));
        let differences = [g.with("Sub", &columns, &x), g.with("Sub", &rows, &y)];
        let distance = g.squares(&differences);
        let range = g.double(range * range);
        let near = g.with("LessOrEqual", &distance, &range);
        let near = g.cast(&near, DataType::Float);
        g.with("Max", ground, &near)
    }

    /// Writes what each UAV detects into its users.
    fn observe(&mut self, users: &Tensor, sight: &Sight, (positions, aoi, slot): (&Tensor, &Tensor, &Tensor)) -> Tensor {
        let near = (0.99 * self.agent.dims().env.detection_range).powi(2);
        let g = &mut self.g;
        let columns: Vec<Tensor> = (0..5).map(|c| g.column(users, c)).collect();
        let known = self.known(&columns[0]);
        let g = &mut self.g;
        let remembered = g.slice(users, 2, 1, 3);
        let remembered = g.cast(&remembered, DataType::Double);
        let offsets = g.difference((&remembered, &[]), (positions, &[1]));
        let (distance, near) = (g.squares(&offsets), g.double(near));
        let near = g.with("Less", &distance, &near);
        let gone = g.with("And", &known, &near);
        let slot = g.cast(slot, DataType::Float);
        let (zero, one) = (g.float(0.0), g.float(1.0));
        let at = g.cast(&sight.users, DataType::Float);
        let [x, y] = g.xy(&at);
        let collected = g.with("Sub", &slot, aoi);
        let state = g.select(&gone, &zero, &columns[0]);
        let observed = g.select(&gone, &slot, &columns[4]);
        let values =
            [(one, state), (x, columns[1].clone()), (y, columns[2].clone()), (collected, columns[3].clone()), (slot, observed)];
        let values = values.map(|(seen, unseen)| g.select(&sight.sees_user, &seen, &unseen));
        g.stack(&values)
    }

    /// Whether users are known, from their states.
    fn known(&mut self, states: &Tensor) -> Tensor {
        let one = self.g.float(1.0);
        self.g.with("Equal", states, &one)
    }

    /// Every UAV receives the memories of those that it detects. Of two entries for a user, the newer one wins; of equal ones its own,
    /// then the first. In slot 0, a known user wins over an unknown one.
    fn exchange(&mut self, own: &Memory, sight: &Sight) -> Memory {
        let (state, observed) = (self.g.column(&own.users, 0), self.g.column(&own.users, 4));
        let known = self.known(&state);
        let g = &mut self.g;
        let (zero, none) = (g.float(0.0), g.float(-1.0));
        let at_start = g.with("Equal", &observed, &zero);
        let first = g.with("And", &known, &at_start);
        let first = g.cast(&first, DataType::Float);
        let twice = g.with("Add", &observed, &observed);
        let key = g.with("Add", &twice, &first);
        let (mine, theirs) = (g.unsqueeze(&key, &[1]), g.unsqueeze(&key, &[0]));
        let sees = g.unsqueeze(&sight.sees_uav, &[2]);
        let theirs = g.select(&sees, &theirs, &none);
        let candidates = g.concat(&[&mine, &theirs], 1);
        let best = g.arg_max(&candidates, 1);
        let (zero_index, one) = (g.integer(0), g.integer(1));
        let is_own = g.with("Equal", &best, &zero_index);
        let count = g.size(&own.users, 0);
        let rows = g.range(&count);
        let rows = g.unsqueeze(&rows, &[1]);
        let other = g.with("Sub", &best, &one);
        let source = g.select(&is_own, &rows, &other);
        let count = g.size(&own.users, 1);
        let user = g.range(&count);
        let zeros = g.with("Mul", &source, &zero_index);
        let user = g.with("Add", &user, &zeros);
        let indices = g.stack(&[source, user]);
        let users = g.gather_nd(&own.users, &indices);
        let (theirs, sees) = (g.unsqueeze(&own.ground, &[0]), g.unsqueeze(&sight.sees_uav, &[2, 3]));
        let theirs = g.select(&sees, &theirs, &zero);
        let theirs = g.max(&theirs, 1, false);
        Memory { ground: g.with("Max", &own.ground, &theirs), users }
    }

    /// The goals. `sectors` (M, 6) are the bounds of the UAVs' sectors, `last` (M) their last headings.
    pub(super) fn goals(
        &mut self,
        memory: &Memory,
        sight: &Sight,
        (positions, slot, last, sectors): (&Tensor, &Tensor, &Tensor, &Tensor),
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
            ground.features(g, &env, (positions, slot), (&unknown, sectors)),
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
        let features = g.stack(&columns);
        GoalTable { valid, headings, features: g.cast(&features, DataType::Float) }
    }

    /// Adds the best score per heading to the Q-values.
    pub(super) fn score_goals(&mut self, goals: &GoalTable, context: &[&Tensor], q: &Tensor) -> Tensor {
        let name = "agent.goals.0";
        let features = Goals::FEATURES;
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
        let ground = g.cast(ground, DataType::Double);
        let one = g.double(1.0);
        let cells = g.with("Sub", &one, &ground);
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
        (unknown, sectors): (&Tensor, &Tensor),
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
        let own = owned(g, &self.centers, sectors);
        let zeros = g.times(&slots, 0.0);
        let one = g.double(1.0);
        [zeros, g.ln1(&slots), g.with("Div", &one, &slots), g.ln1(&age), g.ln1(&rate), g.ln1(&expected), own]
    }
}

/// Whether points (M, B, 2) are in the sectors of the UAVs (M, 6): directions of the middle, of the end and of the start.
fn owned(g: &mut Graph, points: &Tensor, sectors: &Tensor) -> Tensor {
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
            let column = g.column(sectors, column);
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
    let owned = g.with("Or", &left, &right);
    g.indicator(&owned)
}

/// The headings towards `targets` (M, G, 2), and the features that follow from heading and distance: (M, G) each.
fn headings_and_shared(
    g: &mut Graph,
    env: &EnvParams,
    sight: &Sight,
    (positions, targets, last): (&Tensor, &Tensor, &Tensor),
) -> (Tensor, Vec<Tensor>) {
    let compass = EnvConfig::COMPASS as i64;
    let direction = |axis: usize| DIRECTIONS[..EnvConfig::COMPASS].iter().map(|d| d[axis]).collect::<Vec<f64>>();
    let [right, up] = [0, 1].map(|axis| g.doubles(&[compass], &direction(axis)));
    let [dx, dy] = g.difference((targets, &[]), (positions, &[1]));
    let offsets = [g.unsqueeze(&dx, &[2]), g.unsqueeze(&dy, &[2])];
    let (a, b) = (g.with("Mul", &offsets[0], &right), g.with("Mul", &offsets[1], &up));
    let progress = g.with("Add", &a, &b);
    let inside = stays_inside(g, env, positions, [&right, &up]);
    let lowest = g.double(-HUGE);
    let progress = g.choose(&inside, &progress, &lowest);
    let headings = g.arg_max(&progress, 2);

    let distance = g.squares(&[dx, dy]);
    let mine = g.map("Sqrt", &distance);
    let others = g.difference((&sight.uavs, &[2]), (targets, &[1]));
    let others = g.squares(&others);
    let others = g.map("Sqrt", &others);
    let sees = g.unsqueeze(&sight.sees_uav, &[2]);
    let far = g.double(HUGE);
    let others = g.choose(&sees, &others, &far);
    let nearest = g.min(&others, 1);
    let lead = g.with("Sub", &nearest, &mine);
    let lead = g.over(&lead, env.detection_range);
    let contested = g.with("Less", &nearest, &mine);
    let contested = g.indicator(&contested);
    let last = g.unsqueeze(last, &[1]);
    let onward = g.with("Equal", &headings, &last);
    let onward = g.indicator(&onward);
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
