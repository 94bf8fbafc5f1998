//! Expressions of f64 on [`Graph`], with the formulas and the order of operations of `policy::flight`.

use super::graph::{Graph, Tensor};
use crate::policy::EnvParams;
use crate::wire::onnx::tensor_proto::DataType;

/// Expressions of f64.
impl Graph {
    /// a if `condition`, else b. Both are finite, so one product is 0 and the sum is exact. Runtimes have `Where` for other types only.
    pub(super) fn choose(&mut self, condition: &Tensor, a: &Tensor, b: &Tensor) -> Tensor {
        let other = self.map("Not", condition);
        let (is_a, is_b) = (self.indicator(condition), self.indicator(&other));
        let (a, b) = (self.with("Mul", a, &is_a), self.with("Mul", b, &is_b));
        self.with("Add", &a, &b)
    }

    pub(super) fn add_to(&mut self, x: &Tensor, value: f64) -> Tensor {
        let value = self.double(value);
        self.with("Add", x, &value)
    }

    pub(super) fn times(&mut self, x: &Tensor, value: f64) -> Tensor {
        let value = self.double(value);
        self.with("Mul", x, &value)
    }

    pub(super) fn over(&mut self, x: &Tensor, value: f64) -> Tensor {
        let value = self.double(value);
        self.with("Div", x, &value)
    }

    pub(super) fn at_least(&mut self, x: &Tensor, value: f64) -> Tensor {
        let value = self.double(value);
        self.with("Max", x, &value)
    }

    pub(super) fn square(&mut self, x: &Tensor) -> Tensor {
        self.with("Mul", x, x)
    }

    /// ln(1 + x) for x above 0.
    pub(super) fn ln1(&mut self, x: &Tensor) -> Tensor {
        let x = self.at_least(x, 0.0);
        let x = self.add_to(&x, 1.0);
        self.map("Log", &x)
    }

    /// The coordinates of points, the last axis.
    pub(super) fn xy(&mut self, points: &Tensor) -> [Tensor; 2] {
        [self.column(points, 0), self.column(points, 1)]
    }

    /// Differences of the coordinates of `a` and `b`, at which axes of size 1 are added.
    pub(super) fn difference(&mut self, a: (&Tensor, &[i64]), b: (&Tensor, &[i64])) -> [Tensor; 2] {
        let [a, b] = [a, b].map(|(points, axes)| {
            let [x, y] = self.xy(points);
            if axes.is_empty() { [x, y] } else { [self.unsqueeze(&x, axes), self.unsqueeze(&y, axes)] }
        });
        [self.with("Sub", &a[0], &b[0]), self.with("Sub", &a[1], &b[1])]
    }

    /// The sum of two squares.
    pub(super) fn squares(&mut self, [x, y]: &[Tensor; 2]) -> Tensor {
        let (x, y) = (self.square(x), self.square(y));
        self.with("Add", &x, &y)
    }

    /// The lengths of differences, rounded as `f64::hypot` does (Borges, An Improved Algorithm for hypot(a, b), 2019). UAVs may be almost equally
    /// far from a goal, and rounding then decides which is nearer.
    pub(super) fn length(&mut self, [dx, dy]: &[Tensor; 2]) -> Tensor {
        let (dx, dy) = (self.map("Abs", dx), self.map("Abs", dy));
        let (long, short) = (self.with("Max", &dx, &dy), self.with("Min", &dx, &dy));
        let squares = self.squares(&[long.clone(), short.clone()]);
        let h = self.map("Sqrt", &squares);
        let twice_short = self.times(&short, 2.0);
        // What h^2 is too large by, without cancellation: from h - short where the sides are alike, else from h - long.
        let alike = {
            let delta = self.with("Sub", &h, &short);
            let a = self.times(&delta, 2.0);
            let a = self.with("Sub", &a, &long);
            let a = self.with("Mul", &long, &a);
            let b = self.with("Sub", &long, &short);
            let b = self.times(&b, 2.0);
            let b = self.with("Sub", &delta, &b);
            let b = self.with("Mul", &b, &delta);
            self.with("Add", &a, &b)
        };
        let different = {
            let delta = self.with("Sub", &h, &long);
            let a = self.with("Sub", &long, &twice_short);
            let b = self.times(&delta, 2.0);
            let a = self.with("Mul", &b, &a);
            let b = self.times(&delta, 4.0);
            let b = self.with("Sub", &b, &short);
            let b = self.with("Mul", &b, &short);
            let c = self.square(&delta);
            let b = self.with("Add", &b, &c);
            self.with("Add", &a, &b)
        };
        let is_alike = self.with("LessOrEqual", &h, &twice_short);
        let excess = self.choose(&is_alike, &alike, &different);
        let twice = self.times(&h, 2.0);
        let twice = self.at_least(&twice, f64::MIN_POSITIVE);
        let correction = self.with("Div", &excess, &twice);
        self.with("Sub", &h, &correction)
    }

    /// Slots of flight over the differences `[dx, dy]` until the target is within `range`.
    pub(super) fn travel(&mut self, env: &EnvParams, [dx, dy]: &[Tensor; 2], range: f64) -> Tensor {
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
    pub(super) fn indicator(&mut self, condition: &Tensor) -> Tensor {
        self.cast(condition, DataType::Double)
    }

    /// Each index as a row of `width` numbers, f32: 1 at the index, else 0.
    pub(super) fn one_hot(&mut self, index: &Tensor, width: usize) -> Tensor {
        let all: Vec<i64> = (0..width as i64).collect();
        let (all, index) = (self.ints(&[1, width as i64], &all), self.unsqueeze(index, &[1]));
        let equal = self.with("Equal", &index, &all);
        self.cast(&equal, DataType::Float)
    }

    /// Columns as the last axis.
    pub(super) fn stack(&mut self, columns: &[Tensor]) -> Tensor {
        let columns: Vec<Tensor> = columns.iter().map(|column| self.unsqueeze(column, &[-1])).collect();
        self.concat(&columns.iter().collect::<Vec<_>>(), -1)
    }
}
