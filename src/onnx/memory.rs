//! What UAVs remember (docs/model.md, "Memory") as ONNX operators. The formulas and the order of their operations are those of
//! `policy::memory`: positions and times are f64, so that thresholds and roundings fall alike.

use super::graph::{Graph, Tensor};
use super::network::{Edges, Network};
use crate::policy::memory::{GRID, SEARCH_AGAIN_FROM, Sharing};
use crate::wire::onnx::tensor_proto::DataType;

/// The memory of all UAVs.
pub(super) struct Memory {
    /// 0, or 1 + the slot in which the search began that found this cell searched, (M, 20, 20): rows, then columns.
    pub(super) ground: Tensor,
    /// (M, N, 5): state, x, y, slot of the last collection, slot of the observation.
    pub(super) users: Tensor,
}

/// What UAVs detect, as tables.
pub(super) struct Sight {
    /// Whether UAV i detects UAV j, (M, M).
    pub(super) sees_uav: Tensor,
    /// Positions of the detected UAVs, (M, M, 2), f64.
    pub(super) uavs: Tensor,
    /// Whether UAV i detects user j, (M, N).
    pub(super) sees_user: Tensor,
    /// Positions of the detected users, (M, N, 2), f64.
    pub(super) users: Tensor,
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
            ground: self.search(before, positions, slot),
            users: self.observe(&before.users, sight, (positions, aoi, slot)),
        };
        if self.agent.config().memory.sharing() == Some(Sharing::Shared) { self.exchange(&own, sight) } else { own }
    }

    /// Marks the cells whose centres are in range, in the present search or in a new one.
    fn search(&mut self, before: &Memory, positions: &Tensor, slot: &Tensor) -> Tensor {
        let range = self.agent.dims().env.detection_range;
        let cells = self.g.cells(&before.ground);
        let again = self.begins_search((&cells, &before.users), slot);
        let g = &mut self.g;
        let centers: Vec<f64> = (0..GRID).map(|k| (k as f64 + 0.5) / GRID as f64).collect();
        let (columns, rows) = (g.doubles(&[1, 1, GRID as i64], &centers), g.doubles(&[1, GRID as i64, 1], &centers));
        let [x, y] = g.xy(positions);
        let [x, y] = [x, y].map(|at| g.unsqueeze(&at, &[1, 2]));
        let differences = [g.with("Sub", &columns, &x), g.with("Sub", &rows, &y)];
        let distance = g.squares(&differences);
        let range = g.double(range * range);
        let near = g.with("LessOrEqual", &distance, &range);
        let (zero, one) = (g.float(0.0), g.float(1.0));
        let slot = g.cast(slot, DataType::Float);
        let began = g.max(&cells, 1, false);
        let began = g.unsqueeze(&began, &[1, 2]);
        let (began, now) = (g.with("Max", &began, &one), g.with("Add", &slot, &one));
        let began = g.select(&again, &now, &began);
        let kept = g.select(&again, &zero, &before.ground);
        g.select(&near, &began, &kept)
    }

    /// Whether each UAV searches the ground again, (M, 1, 1). `cells` (M, 400) and `users` are its memory before.
    fn begins_search(&mut self, (cells, users): (&Tensor, &Tensor), slot: &Tensor) -> Tensor {
        let state = self.g.column(users, 0);
        let known = self.known(&state);
        let g = &mut self.g;
        let least = g.min(cells, 1);
        let (zero, from) = (g.float(0.0), g.double(SEARCH_AGAIN_FROM as f64));
        let complete = g.with("Greater", &least, &zero);
        let number = g.indicator(&known);
        let number = g.sum(&number, &[1], false);
        let all = g.size(users, 1);
        let all = g.cast(&all, DataType::Double);
        let misses = g.with("Less", &number, &all);
        let late = g.with("GreaterOrEqual", slot, &from);
        let again = g.with("And", &complete, &misses);
        let again = g.with("And", &again, &late);
        g.unsqueeze(&again, &[1, 2])
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
    pub(super) fn known(&mut self, states: &Tensor) -> Tensor {
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
        // Of searches, those that began last count.
        let columns = g.transpose(&rows);
        let itself = g.with("Equal", &rows, &columns);
        let sees = g.with("Or", &sight.sees_uav, &itself);
        let began = g.cells(&own.ground);
        let began = g.max(&began, 1, false);
        let began = g.unsqueeze(&began, &[0]);
        let heard = g.select(&sees, &began, &zero);
        let latest = g.max(&heard, 1, true);
        let counts = g.with("Equal", &began, &latest);
        let counts = g.with("And", &sees, &counts);
        let (counts, theirs) = (g.unsqueeze(&counts, &[2, 3]), g.unsqueeze(&own.ground, &[0]));
        let theirs = g.select(&counts, &theirs, &zero);
        Memory { ground: g.max(&theirs, 1, false), users }
    }
}

impl Graph {
    /// The cells of the ground of each UAV, (M, 400).
    fn cells(&mut self, ground: &Tensor) -> Tensor {
        let shape = self.list(&[-1, (GRID * GRID) as i64]);
        self.reshape(ground, &shape)
    }

    /// 1 for the cells that were not searched, else 0: f64, (M, 20, 20).
    pub(super) fn unsearched(&mut self, ground: &Tensor) -> Tensor {
        let zero = self.float(0.0);
        let unsearched = self.with("Equal", ground, &zero);
        self.indicator(&unsearched)
    }
}
