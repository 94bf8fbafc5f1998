//! Compares hand-derived gradients with central differences, in f64: of every layer, and of the whole loss.

use qedgix::learner::loss::{Loss, TdLambda};
use qedgix::nn::{
    Batch, Graph, GraphLayer, Gru, HIDDEN, LayerCache, LayerScratch, Linear, Mlp, MlpCache, ParameterLayout, Weights,
};
use qedgix::policy::mixer::MixerKind;
use qedgix::policy::{Advice, AgentConfig, Aggregation, Dims, EnvParams, Gnn, Identity, Memory, ObservationKind};
use qedgix::rng;
use rand::RngExt;

use crate::sample::{AGENT, episodes};

/// Tolerance, relative to the largest gradient of the tensor.
const TOLERANCE: f64 = 1e-6;
const STEP: f64 = 1e-6;

fn uniform(len: usize, name: &str) -> Vec<f64> {
    let mut stream = rng::stream(5, name, 0);
    (0..len).map(|_| 2.0 * stream.random::<f64>() - 1.0).collect()
}

/// Checks `gradient` of `f` at `at`: in each named range, three entries and one random direction.
fn check(
    what: &str,
    ranges: &[(String, std::ops::Range<usize>)],
    at: &[f64],
    gradient: &[f64],
    mut f: impl FnMut(&[f64]) -> f64,
) {
    let mut stream = rng::stream(9, what, 0);
    for (name, range) in ranges.iter().filter(|(_, range)| !range.is_empty()) {
        let largest = gradient[range.clone()].iter().fold(0.0, |m: f64, g| m.max(g.abs()));
        let mut directions: Vec<Vec<(usize, f64)>> = (0..3).map(|_| vec![(stream.random_range(range.clone()), 1.0)]).collect();
        let norm = (range.len() as f64).sqrt();
        directions.push(range.clone().map(|i| (i, if stream.random() { 1.0 } else { -1.0 } / norm)).collect());
        for direction in directions {
            let mut moved = |sign: f64| {
                let mut x = at.to_vec();
                direction.iter().for_each(|&(i, d)| x[i] += sign * STEP * d);
                f(&x)
            };
            let numeric = (moved(1.0) - moved(-1.0)) / (2.0 * STEP);
            let exact: f64 = direction.iter().map(|&(i, d)| gradient[i] * d).sum();
            let error = (numeric - exact).abs();
            assert!(
                error <= TOLERANCE * largest + 1e-9,
                "{what}, {name}: derived {exact:e}, by differences {numeric:e}, largest {largest:e}"
            );
        }
    }
}

/// A layer as a function of parameters and inputs, with the gradients of both.
trait Layer {
    fn forward(&mut self, w: Weights<'_, f64>, x: &Batch<f64>) -> Batch<f64>;
    fn backward(&mut self, w: Weights<'_, f64>, x: &Batch<f64>, dy: Batch<f64>, grads: &mut [f64]) -> Batch<f64>;
    fn prepare(&self, params: &[f64], prepared: &mut [f64]);
}

fn check_layer(name: &str, layout: &ParameterLayout, layer: &mut impl Layer, width: usize, samples: usize) {
    let count = layout.len();
    let mut at = uniform(count, &format!("{name} parameters"));
    at.iter_mut().for_each(|p| *p *= 0.2);
    at.extend(uniform(width * samples, name));
    let mut run = |at: &[f64], cotangent: Option<&[f64]>| -> (Vec<f64>, Vec<f64>) {
        let (params, x) = at.split_at(count);
        let mut prepared = vec![0.0; count];
        layer.prepare(params, &mut prepared);
        let w = Weights { params, prepared: &prepared };
        let mut input = Batch::default();
        input.resize(width, samples);
        input.as_mut_slice().copy_from_slice(x);
        let y = layer.forward(w, &input);
        let mut gradient = vec![0.0; count];
        if let Some(cotangent) = cotangent {
            let mut dy = y.clone();
            dy.as_mut_slice().copy_from_slice(cotangent);
            let dx = layer.backward(w, &input, dy, &mut gradient);
            gradient.extend_from_slice(dx.as_slice());
        }
        (y.as_slice().to_vec(), gradient)
    };
    let outputs = run(&at, None).0.len();
    let cotangent = uniform(outputs, "cotangent");
    let (_, gradient) = run(&at, Some(&cotangent));
    let mut ranges: Vec<_> = layout.parameters().iter().map(|p| (p.name.clone(), p.range.clone())).collect();
    ranges.push(("input".into(), count..at.len()));
    check(name, &ranges, &at, &gradient, |at| run(at, None).0.iter().zip(&cotangent).map(|(y, c)| y * c).sum());
}

struct Plain(Linear);

impl Layer for Plain {
    fn prepare(&self, params: &[f64], prepared: &mut [f64]) {
        self.0.prepare(params, prepared);
    }

    fn forward(&mut self, w: Weights<'_, f64>, x: &Batch<f64>) -> Batch<f64> {
        let mut y = Batch::default();
        y.resize(self.0.outputs, x.len());
        self.0.forward(w, x.rows(), y.rows_mut());
        y
    }

    fn backward(&mut self, w: Weights<'_, f64>, x: &Batch<f64>, dy: Batch<f64>, grads: &mut [f64]) -> Batch<f64> {
        let mut dx = Batch::default();
        dx.resize(x.width(), x.len());
        self.0.backward(w.params, x.rows(), dy.rows(), grads, Some(dx.rows_mut()));
        dx
    }
}

#[test]
fn linear() {
    let mut layout = ParameterLayout::default();
    let mut layer = Plain(Linear::new(&mut layout, "linear", 21, 9));
    check_layer("linear", &layout, &mut layer, 21, 7);
}

struct Split(Mlp<96>, MlpCache<f64>);

impl Layer for Split {
    fn prepare(&self, params: &[f64], prepared: &mut [f64]) {
        self.0.prepare(params, prepared);
    }

    fn forward(&mut self, w: Weights<'_, f64>, x: &Batch<f64>) -> Batch<f64> {
        let mut y = Batch::default();
        y.resize(8, x.len());
        self.0.forward(w, (x.rows(), x.rows().from_column(5), 5), &mut self.1, y.rows_mut());
        y
    }

    fn backward(&mut self, w: Weights<'_, f64>, x: &Batch<f64>, dy: Batch<f64>, grads: &mut [f64]) -> Batch<f64> {
        self.0.backward(w.params, (x.rows(), x.rows().from_column(5), 5), dy.rows(), &mut self.1, grads);
        let mut dx = Batch::default();
        dx.resize(x.width(), x.len());
        let start = qedgix::nn::matmul::InitialValue::Zero;
        self.0.first.backward_input(w.params, (0, x.width()), self.0.d_first(&self.1), dx.rows_mut(), start);
        dx
    }
}

#[test]
fn mlp_of_two_parts() {
    let mut layout = ParameterLayout::default();
    let mut layer = Split(Mlp::new(&mut layout, "mlp", 13, 8), MlpCache::default());
    check_layer("mlp", &layout, &mut layer, 13, 6);
}

struct Cell(Gru, Batch<f64>, Batch<f64>);

/// Number of slots in the test of the GRU.
const SLOTS: usize = 5;

impl Layer for Cell {
    fn prepare(&self, params: &[f64], prepared: &mut [f64]) {
        self.0.prepare(params, prepared);
    }

    fn forward(&mut self, w: Weights<'_, f64>, x: &Batch<f64>) -> Batch<f64> {
        let n = x.len() / SLOTS;
        self.2.resize_zero(HIDDEN, x.len() + n);
        self.0.forward(w, x.rows(), SLOTS, &mut self.1, &mut self.2);
        let mut y = Batch::default();
        y.resize(HIDDEN, x.len());
        y.as_mut_slice().copy_from_slice(&self.2.as_slice()[n * HIDDEN..]);
        y
    }

    fn backward(&mut self, w: Weights<'_, f64>, x: &Batch<f64>, mut dy: Batch<f64>, grads: &mut [f64]) -> Batch<f64> {
        self.0.backward(w.params, (x.rows(), SLOTS), &self.2, (&mut self.1, &mut dy), grads);
        let mut dx = Batch::default();
        self.0.backward_input(w.params, &self.1, &mut dx);
        dx
    }
}

#[test]
fn gru_over_time() {
    let mut layout = ParameterLayout::default();
    let mut layer = Cell(Gru::new(&mut layout, "gru"), Batch::default(), Batch::default());
    check_layer("gru", &layout, &mut layer, HIDDEN, 3 * SLOTS);
}

struct Convolution(GraphLayer, Graph, LayerCache<f64>);

impl Layer for Convolution {
    fn prepare(&self, params: &[f64], prepared: &mut [f64]) {
        self.0.prepare(params, prepared);
    }

    fn forward(&mut self, w: Weights<'_, f64>, x: &Batch<f64>) -> Batch<f64> {
        let mut y = Batch::default();
        y.resize(HIDDEN, self.1.offsets.len() - 1);
        self.0.forward(w, &self.1, x.rows(), &mut self.2, y.rows_mut());
        y
    }

    fn backward(&mut self, w: Weights<'_, f64>, x: &Batch<f64>, mut dy: Batch<f64>, grads: &mut [f64]) -> Batch<f64> {
        let mut dx = Batch::default();
        let (mut scratch, forward) = (LayerScratch::default(), (&self.1, x.rows(), &mut self.2));
        self.0.backward(w, forward, &mut dy, &mut scratch, (grads, &mut dx));
        dx
    }
}

/// Two nodes of the first kind and four of the second. Node 1 is its own neighbour, node 3 has no neighbour, node 5 is only a
/// neighbour.
fn graph() -> Graph {
    let lists: [&[u32]; 5] = [&[1, 2, 4], &[1, 0, 3], &[0, 5], &[], &[2, 0]];
    let offsets = std::iter::once(0).chain(lists.iter().scan(0, |end, l| {
        *end += l.len() as u32;
        Some(*end)
    }));
    Graph { offsets: offsets.collect(), targets: lists.concat(), reach: vec![2, 5, 6] }
}

#[test]
fn graph_layers() {
    let layers: [(&str, fn(&mut ParameterLayout) -> GraphLayer); 4] = [
        ("edgeconv, mean", |layout| GraphLayer::edge_conv(layout, "layer", true)),
        ("edgeconv, sum", |layout| GraphLayer::edge_conv(layout, "layer", false)),
        ("agggnn", |layout| GraphLayer::agg_gnn(layout, "layer")),
        ("rgcn", |layout| GraphLayer::rgcn(layout, "layer")),
    ];
    for (name, make) in layers {
        let mut layout = ParameterLayout::default();
        let mut layer = Convolution(make(&mut layout), graph(), LayerCache::default());
        check_layer(name, &layout, &mut layer, HIDDEN, 6);
    }
}

#[test]
fn whole_loss() {
    let set = AgentConfig { observation: ObservationKind::Set, identity: Identity::Phase, self_position: true, ..AGENT };
    let cases = [
        ("qedgix", AGENT, MixerKind::Qmix),
        ("qedgix on sets", AgentConfig { self_loops: true, aggregation: Aggregation::Sum, ..set }, MixerKind::Invariant),
        ("three layers", AgentConfig { layers: 3, identity: Identity::Token, ..AGENT }, MixerKind::Vdn),
        ("agggnn", AgentConfig { gnn: Gnn::AggGnn, layers: 1, ..set }, MixerKind::Invariant),
        ("rgcn", AgentConfig { gnn: Gnn::Rgcn, identity: Identity::None, ..AGENT }, MixerKind::Qmix),
        ("qmix", AgentConfig { gnn: Gnn::None, ..AGENT }, MixerKind::Qmix),
        ("qmix with memory", AgentConfig { gnn: Gnn::None, memory: Memory::Own, ..set }, MixerKind::Qmix),
        ("qedgix with shared memory", AgentConfig { memory: Memory::Shared, ..set }, MixerKind::Invariant),
        ("qmix with advice", AgentConfig { gnn: Gnn::None, memory: Memory::Own, advice: Advice::Sweep, ..set }, MixerKind::Vdn),
        ("qedgix with advice", AgentConfig { memory: Memory::Shared, advice: Advice::Sweep, ..set }, MixerKind::Invariant),
        ("iql", AgentConfig { gnn: Gnn::None, identity: Identity::Token, ..set }, MixerKind::None),
    ];
    for (name, agent, mixer) in cases {
        let dims = Dims { uavs: 3, users: 4, env: EnvParams { actions: 9, slots: 3, ..EnvParams::default() } };
        let td_lambda = TdLambda { gamma: 0.95, lambda: 0.6 };
        let mut loss = Loss::<f64>::new(agent, dims, mixer, td_lambda, 1);
        let layout = loss.layout().clone();
        let online: Vec<f64> = layout.initialise(&mut rng::stream(1, "online", 0));
        let target: Vec<f64> = layout.initialise(&mut rng::stream(1, "target", 0));
        let episodes = episodes(&dims, 2, 3);
        loss.compute_gradient(&online, &target, std::slice::from_ref(&episodes), None);
        let gradient = loss.gradient().to_vec();
        let ranges: Vec<_> = layout.parameters().iter().map(|p| (p.name.clone(), p.range.clone())).collect();
        check(name, &ranges, &online, &gradient, |online| {
            loss.compute_gradient(online, &target, std::slice::from_ref(&episodes), None).loss
        });
    }
}
