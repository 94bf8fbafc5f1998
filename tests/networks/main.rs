//! Properties of agents, mixers and updates that hold for all parameters (docs/model.md, "Observations", "Agents", "Mixers",
//! "Learner"), and their gradients.

mod gradients;
#[path = "../sample/mod.rs"]
mod sample;

use qedgix::env::Point;
use qedgix::learner::loss::{Loss, TdLambda, Trace};
use qedgix::learner::{Algorithm, Learner, Preset, TrainConfig};
use qedgix::nn::{Batch, Graph, GraphLayer, HIDDEN, LayerCache, ParameterLayout, Rows, Weights};
use qedgix::policy::baselines;
use qedgix::policy::mixer::{Mixer, MixerCache, MixerKind};
use qedgix::policy::{
    Advice, Agent, AgentConfig, BatchedAgent, Dims, EnvParams, FleetGraph, FleetStep, Geometry, GeometryConfig, Gnn, HopSearch,
    Identity, LearnedPolicy, Memory, ObservationKind, Policy, RequiredInput, StepInput, TOKEN, Trained,
};
use qedgix::rng;
use qedgix::threads;
use rand::RngExt;
use sample::{AGENT, episodes};

const ENV: EnvParams = EnvParams {
    speed: 0.04,
    transmission_range: 0.12,
    detection_range: 0.28,
    communication_range: 0.28,
    actions: 8,
    slots: 80,
    extent: [1.0; 2],
};
const DIMS: Dims = Dims { uavs: 3, users: 5, env: ENV };
const SET: AgentConfig =
    AgentConfig { observation: ObservationKind::Set, identity: Identity::Phase, self_position: true, ..AGENT };

fn parameters(layout: &ParameterLayout, seed: u64) -> Vec<f32> {
    layout.initialise(&mut rng::stream(seed, "init", 0))
}

fn learned(config: AgentConfig) -> LearnedPolicy {
    LearnedPolicy::new(config, DIMS, parameters(Agent::new(config, DIMS).layout(), 1)).expect("as many as the layout says")
}

/// What a fleet detects with all nodes near the centre, so that most nodes detect each other.
fn graph(uavs: usize, users: usize, seed: u64) -> FleetGraph {
    let mut stream = rng::stream(seed, "slot", 0);
    let mut points = |n: usize| -> Vec<Point> { (0..n).map(|_| [0, 1].map(|_| 0.3 + 0.4 * stream.random::<f64>())).collect() };
    let (uavs, users) = (points(uavs), points(users));
    let aoi: Vec<f32> = (0..users.len()).map(|i| (i * 7 % 40) as f32).collect();
    FleetGraph::from_scene(&uavs, &users, &aoi, DIMS.env.detection_range)
}

/// A fleet with its graph, memory and last results.
struct Fleet {
    graph: FleetGraph,
    memory: Vec<f32>,
    headings: Vec<u8>,
    q: Vec<f32>,
}

impl Fleet {
    fn new(policy: &dyn Policy, uavs: usize, users: usize, seed: u64) -> Self {
        let mut memory = vec![0.0; policy.memory_len(uavs, users)];
        policy.start(uavs, users, seed, &mut memory);
        let (headings, q) = (vec![0; uavs], vec![0.0; uavs * policy.actions()]);
        Self { graph: graph(uavs, users, seed), memory, headings, q }
    }

    fn turn(&mut self) -> FleetStep<'_> {
        let Self { graph, memory, headings, q } = self;
        FleetStep { env: ENV, graph, profile: None, step: 0, memory, headings, q_values: Some(q) }
    }

    fn bits(&self) -> (Vec<u32>, Vec<u8>, Vec<u32>) {
        let bits = |x: &[f32]| x.iter().map(|x| x.to_bits()).collect();
        (bits(&self.memory), self.headings.clone(), bits(&self.q))
    }
}

#[test]
fn neither_batching_nor_threads_change_a_bit_of_the_result() {
    let variants = [
        SET,
        AgentConfig { identity: Identity::Token, self_loops: true, layers: 3, ..SET },
        AgentConfig { gnn: Gnn::AggGnn, ..SET },
        AgentConfig { gnn: Gnn::Rgcn, identity: Identity::None, ..SET },
        AgentConfig { gnn: Gnn::None, ..SET },
        AgentConfig { gnn: Gnn::None, hops: 3, ..SET },
        AgentConfig { gnn: Gnn::None, memory: Memory::Own, ..SET },
        AgentConfig { memory: Memory::Shared, ..SET },
        AgentConfig { memory: Memory::Shared, advice: Advice::Sweep, ..SET },
    ];
    for config in variants {
        let policy = learned(config);
        // Users that a memory has no room for are the last size.
        let sizes = [(1, 1), (3, 5), (2, 0), (9, 4), (1, 12), (4, 40), (20, 3), (5, 300)];
        let fleets =
            || -> Vec<Fleet> { (0..).zip(sizes).map(|(seed, (uavs, users))| Fleet::new(&policy, uavs, users, seed)).collect() };
        let (mut single, mut batch, mut reversed, mut split) = (fleets(), fleets(), fleets(), fleets());
        for _ in 0..3 {
            single.iter_mut().for_each(|fleet| policy.act(&mut [fleet.turn()]));
            policy.act(&mut batch.iter_mut().map(Fleet::turn).collect::<Vec<_>>());
            policy.act(&mut reversed.iter_mut().rev().map(Fleet::turn).collect::<Vec<_>>());
            threads::allow(3, || split.iter_mut().for_each(|fleet| policy.act(&mut [fleet.turn()])));
        }
        for (((a, b), c), d) in single.iter().zip(&batch).zip(&reversed).zip(&split) {
            assert_eq!(a.bits(), b.bits(), "{config:?}");
            assert_eq!(a.bits(), c.bits(), "{config:?}");
            assert_eq!(a.bits(), d.bits(), "{config:?}, on three threads");
        }
    }
}

#[test]
fn a_policy_follows_advice_unless_another_heading_is_better_by_the_margin() {
    let config = AgentConfig { memory: Memory::Shared, advice: Advice::Sweep, ..SET };
    // New weights hardly differ from the advice.
    let loud = || {
        let agent = Agent::new(config, DIMS);
        let mut params = parameters(agent.layout(), 1);
        params.iter_mut().for_each(|x| *x *= 10.0);
        let trust = agent.layout().parameters().iter().find(|p| p.name == "agent.advice").expect("with advice");
        params[trust.range.clone()].fill(0.0);
        LearnedPolicy::new(config, DIMS, params).expect("as many as the layout says")
    };
    let rule = baselines::by_name("sweep-shared", ENV).expect("a baseline");
    let fly = |policy: &dyn Policy, seed: u64| {
        let mut fleet = Fleet::new(policy, 3, 5, seed);
        policy.act(&mut [fleet.turn()]);
        (fleet.headings, fleet.q)
    };
    let mut differ = 0;
    for seed in 0..20 {
        let (free, q) = fly(&loud(), seed);
        let (advised, _) = fly(&*rule, seed);
        let (bound, _) = fly(&loud().with_advice_margin(1e3), seed);
        assert_eq!(bound, advised);
        for trained in [Trained { most_uavs: 2, ..Trained::ANY }, Trained { least_detection_range: 0.3, ..Trained::ANY }] {
            let (elsewhere, _) = fly(&loud().with_advice_margin(0.01).with_trained(trained), seed);
            assert_eq!(elsewhere, advised, "{trained:?}");
        }
        let here = Trained { most_uavs: 3, least_detection_range: 0.28 };
        assert_eq!(fly(&loud().with_trained(here), seed), (free.clone(), q.clone()));
        let (_, shifted) = fly(&loud().with_advice_margin(0.5), seed);
        let actions = q.len() / advised.len();
        for (i, &heading) in advised.iter().enumerate() {
            for (action, (q, shifted)) in q.iter().zip(&shifted).skip(i * actions).take(actions).enumerate() {
                // No UAV knows more than 5 of the users, so there are at most 5/3 per UAV.
                let (low, high) = if action == usize::from(heading) { (0.5, 0.5 * 5.0 / 3.0) } else { (0.0, 0.0) };
                assert!((low - 1e-5..=high + 1e-5).contains(&(shifted - q)), "{shifted} {q}");
            }
        }
        differ += usize::from(free != advised);
    }
    assert!(differ > 10, "such weights follow the advice by chance only: {differ}");
}

#[test]
fn more_hops_observe_exactly_the_nodes_within_that_many_links() {
    // A chain: UAV 0, four users, UAV 1. Each node detects only the next and the previous one.
    let users: Vec<Point> = (1..=4).map(|i| [0.2 * f64::from(i), 0.0]).collect();
    let graph = FleetGraph::from_scene(&[[0.0, 0.0], [1.0, 0.0]], &users, &[8.0, 16.0, 24.0, 32.0], 0.25);
    for (hops, reach) in [(1, [2].as_slice()), (2, &[2, 3]), (3, &[2, 3, 4]), (4, &[2, 3, 4, 5]), (5, &[1, 2, 3, 4, 5])] {
        let config = GeometryConfig { ranges: 0.25.into(), episode_slots: 80, layers: 0, self_loops: false, hops };
        let (mut geometry, mut search) = (Geometry::default(), HopSearch::default());
        geometry.clear();
        // Several equal fleets: each gets its own nodes.
        (0..3).for_each(|_| geometry.push_graph(&config, &graph));
        geometry.finish(&config);
        for fleet in 0..3 {
            let view = geometry.view_of_node(fleet, 0, &mut search);
            let seen: Vec<u32> = view.detections.iter().map(|d| d.target).collect();
            assert_eq!(seen, reach, "{hops} hops");
            for d in view.detections {
                let x = if d.target == 1 { 1.0 } else { 0.2 * (d.target - 1) as f32 };
                assert!((d.rel[0] - x).abs() < 1e-6 && d.rel[1] == 0.0, "{d:?}");
            }
            assert_eq!(geometry.view_of_node(fleet, 1, &mut search).detections.len(), reach.len(), "from the other end");
        }
    }
}

#[test]
fn more_hops_hold_no_more_detections() {
    // A square lattice of 400 UAVs: each has up to 4 links, and observes up to 180 nodes over 9 links.
    let uavs: Vec<Point> = (0..400).map(|i| [0.04 * f64::from(i % 20), 0.04 * f64::from(i / 20)]).collect();
    let graph = FleetGraph::from_scene(&uavs, &[], &[], 0.05);
    let mut held = Vec::new();
    for (hops, observed) in [(1, 4), (9, 180)] {
        let config = GeometryConfig { ranges: 0.05.into(), episode_slots: 80, layers: 0, self_loops: false, hops };
        let (mut geometry, mut search) = (Geometry::default(), HopSearch::default());
        geometry.clear();
        geometry.push_graph(&config, &graph);
        geometry.finish(&config);
        assert_eq!(geometry.view_of_node(0, 210, &mut search).detections.len(), observed, "{hops} hops");
        held.push(geometry.detection_count());
    }
    assert_eq!(held, [4 * 19 * 20; 2]);
}

#[test]
fn batched_agent_policy_and_update_compute_the_same_values() {
    let plain = AgentConfig { gnn: Gnn::None, ..AGENT };
    let configs = [
        AGENT,
        SET,
        AgentConfig { identity: Identity::Token, ..plain },
        AgentConfig { hops: 3, normalise: true, ..plain },
        AgentConfig { memory: Memory::Own, ..plain },
        AgentConfig { memory: Memory::Shared, identity: Identity::Token, ..SET },
        AgentConfig { memory: Memory::Own, advice: Advice::Sweep, ..plain },
        AgentConfig { memory: Memory::Shared, advice: Advice::Sweep, ..SET },
    ];
    for config in configs {
        let dims = Dims { env: EnvParams { slots: 6, ..ENV }, ..DIMS };
        let (m, n, slots) = (dims.uavs, dims.users, dims.env.slots);
        let ep = episodes(&dims, 2, 8);
        let td_lambda = TdLambda { gamma: 0.99, lambda: 0.6 };
        let mut loss = Loss::<f32>::new(config, dims, MixerKind::Vdn, td_lambda, 1);
        let params = parameters(loss.layout(), 3);
        let mut trace = Trace::default();
        loss.compute_gradient(&params, &params, std::slice::from_ref(&ep), Some(&mut trace));

        let agent = Agent::new(config, dims);
        let policy = LearnedPolicy::new(config, dims, params.clone()).expect("as many as the layout says");
        let mut batched_agent = BatchedAgent::new(&agent, dims, 1);
        for e in 0..2 {
            batched_agent.begin(&agent, &params, &ep.identity_token[e * m * TOKEN..][..m * TOKEN]);
            let mut memory = vec![0.0; policy.memory_len(m, n)];
            policy.start(m, n, 0, &mut memory);
            if config.identity == Identity::Token {
                for (uav, identity_token) in memory[..m * (HIDDEN + 1 + TOKEN)]
                    .chunks_exact_mut(HIDDEN + 1 + TOKEN)
                    .zip(ep.identity_token[e * m * TOKEN..].chunks_exact(TOKEN))
                {
                    uav[HIDDEN + 1..].copy_from_slice(identity_token);
                }
            }
            for t in 0..slots {
                let at = e * (slots + 1) + t;
                let (uav_xy, user_xy) = (&ep.uav_xy[at * 2 * m..][..2 * m], &ep.user_xy[e * 2 * n..][..2 * n]);
                let aoi = &ep.aoi[at * n..][..n];
                let q = batched_agent.step(&agent, StepInput { uav_xy, user_xy, aoi }).to_vec();
                assert_eq!(q, trace.q[at * m * dims.env.actions..][..m * dims.env.actions], "slot {t}, {config:?}");

                let points = |xy: &[f32]| -> Vec<Point> { xy.chunks_exact(2).map(|p| [p[0].into(), p[1].into()]).collect() };
                let graph = FleetGraph::from_scene(&points(uav_xy), &points(user_xy), aoi, dims.env.detection_range);
                let (mut headings, mut served) = (vec![0; m], vec![0.0; q.len()]);
                let turn = FleetStep {
                    env: dims.env,
                    graph: &graph,
                    profile: None,
                    step: t as u64,
                    memory: &mut memory,
                    headings: &mut headings,
                    q_values: Some(&mut served),
                };
                policy.act(&mut [turn]);
                assert_eq!(q, served, "slot {t}, {config:?}");

                let actions = &ep.actions[(e * slots + t) * m..][..m];
                batched_agent.record_actions(actions);
                // Continue with the action of the episode instead of the greedy heading.
                let stride = HIDDEN + 1 + if config.identity == Identity::Token { TOKEN } else { 0 };
                memory[..stride * m].chunks_exact_mut(stride).zip(actions).for_each(|(uav, &a)| uav[HIDDEN] = f32::from(a));
            }
        }
    }
}

#[test]
fn uavs_separate_only_with_an_identity() {
    let fly = |config: AgentConfig, seed: u64| {
        let policy = LearnedPolicy::new(config, DIMS, parameters(Agent::new(config, DIMS).layout(), seed)).expect("the layout's");
        assert_eq!(policy.needs(), if config.self_position { RequiredInput::OwnPositions } else { RequiredInput::Detections });
        let mut stream = rng::stream(seed, "users", 0);
        let users: Vec<Point> = (0..5).map(|_| [stream.random(), stream.random()]).collect();
        let mut uavs: Vec<Point> = vec![[0.5, 0.5]; 3];
        let mut memory = vec![0.0; policy.memory_len(3, 5)];
        policy.start(3, 5, seed, &mut memory);
        let mut separated = false;
        for step in 0..80 {
            let graph = FleetGraph::from_scene(&uavs, &users, &[step as f32; 5], DIMS.env.detection_range);
            let mut headings = [0; 3];
            policy.act(&mut [FleetStep {
                env: policy.env(),
                graph: &graph,
                profile: None,
                step,
                memory: &mut memory,
                headings: &mut headings,
                q_values: None,
            }]);
            for (p, h) in uavs.iter_mut().zip(headings) {
                let (sin, cos) = (f64::from(h) * std::f64::consts::FRAC_PI_4).sin_cos();
                *p = [(p[0] + 0.04 * cos).clamp(0.0, 1.0), (p[1] + 0.04 * sin).clamp(0.0, 1.0)];
            }
            separated |= uavs.iter().any(|p| *p != uavs[0]);
        }
        separated
    };
    for gnn in [Gnn::None, Gnn::EdgeConv] {
        let separating = |identity| (0..6).filter(|&seed| fly(AgentConfig { gnn, identity, ..SET }, seed)).count();
        assert_eq!(separating(Identity::None), 0, "{gnn:?}");
        for identity in [Identity::Onehot, Identity::Phase, Identity::Token] {
            // Some random networks prefer the same heading for every input, but not all six.
            assert!(separating(identity) > 0, "{gnn:?}, {identity:?}");
        }
    }
}

/// Q-values of one slot, for UAVs and users in the order given.
fn values(policy: &LearnedPolicy, uavs: &[Point], users: &[(Point, f32)]) -> Vec<f32> {
    let (points, aoi): (Vec<Point>, Vec<f32>) = users.iter().copied().unzip();
    let graph = FleetGraph::from_scene(uavs, &points, &aoi, DIMS.env.detection_range);
    let mut memory = vec![0.0; policy.memory_len(uavs.len(), users.len())];
    policy.start(uavs.len(), users.len(), 0, &mut memory);
    let (mut headings, mut q) = (vec![0; uavs.len()], vec![0.0; uavs.len() * 8]);
    policy.act(&mut [FleetStep {
        env: policy.env(),
        graph: &graph,
        profile: None,
        step: 0,
        memory: &mut memory,
        headings: &mut headings,
        q_values: Some(&mut q),
    }]);
    q
}

fn close(a: f32, b: f32) -> bool {
    (a - b).abs() <= 2e-6 * (1.0 + a.abs())
}

#[test]
fn set_agents_are_equivariant_in_uavs_and_invariant_in_users() {
    for gnn in [Gnn::None, Gnn::EdgeConv, Gnn::AggGnn, Gnn::Rgcn] {
        let policy = learned(AgentConfig { gnn, identity: Identity::None, ..SET });
        let mut stream = rng::stream(2, "permutation", 0);
        let mut point = || -> Point { [0, 1].map(|_| 0.3 + 0.4 * stream.random::<f64>()) };
        let uavs: Vec<Point> = (0..5).map(|_| point()).collect();
        let users: Vec<(Point, f32)> = (0..7).map(|i| (point(), 3.0 * i as f32)).collect();
        let order = [3, 0, 4, 1, 2];
        let shuffled: Vec<Point> = order.map(|i| uavs[i]).to_vec();
        let reversed: Vec<_> = users.iter().rev().copied().collect();
        let (q, permuted) = (values(&policy, &uavs, &users), values(&policy, &shuffled, &reversed));
        for (to, from) in order.into_iter().enumerate() {
            for a in 0..8 {
                assert!(close(q[from * 8 + a], permuted[to * 8 + a]), "{gnn:?}");
            }
        }
        assert!(q[..8].iter().zip(&q[8..16]).any(|(a, b)| !close(*a, *b)), "UAVs at different positions have different Q-values");
    }
}

/// A mixer with random parameters: Q_tot as a function of state and values.
struct RandomMixer {
    mixer: Mixer,
    params: Vec<f32>,
    prepared: Vec<f32>,
}

impl RandomMixer {
    fn new(kind: MixerKind, dims: &Dims, seed: u64) -> Self {
        let mut layout = ParameterLayout::default();
        let mixer = Mixer::new(kind, dims, &mut layout);
        let params = parameters(&layout, seed);
        let mut prepared = vec![0.0; params.len()];
        mixer.prepare(&params, &mut prepared);
        Self { mixer, params, prepared }
    }

    fn rows(x: &[f32]) -> Rows<'_, f32> {
        Rows { data: x, stride: x.len(), len: 1 }
    }

    fn total(&self, state: &[f32], q: &[f32]) -> f32 {
        let w = Weights { params: &self.params, prepared: &self.prepared };
        let mut total = Batch::default();
        total.resize(1, 1);
        self.mixer.forward(w, (Self::rows(state), Self::rows(q)), &mut MixerCache::default(), total.rows_mut());
        total.as_slice()[0]
    }

    fn slope(&self, state: &[f32], q: &[f32]) -> Vec<f32> {
        let w = Weights { params: &self.params, prepared: &self.prepared };
        let (mut cache, mut total, mut dq) = (MixerCache::default(), Batch::default(), Batch::default());
        total.resize(1, 1);
        let inputs = (Self::rows(state), Self::rows(q));
        self.mixer.forward(w, inputs, &mut cache, total.rows_mut());
        self.mixer.backward(w, inputs, &mut cache, &[1.0], (&mut vec![0.0; self.params.len()], &mut dq));
        dq.as_slice().to_vec()
    }
}

fn uniform(len: usize, seed: u64) -> Vec<f32> {
    let mut stream = rng::stream(seed, "drawn", 0);
    (0..len).map(|_| 2.0 * stream.random::<f32>() - 1.0).collect()
}

#[test]
fn q_tot_is_monotone_in_every_value() {
    for kind in [MixerKind::Qmix, MixerKind::Invariant, MixerKind::Vdn] {
        for seed in 0..50 {
            let mixer = RandomMixer::new(kind, &DIMS, seed);
            let (state, q) = (uniform(2 * 3 + 3 * 5, seed), uniform(3, seed + 1000));
            let slope = mixer.slope(&state, &q);
            assert!(slope.iter().all(|&d| d >= 0.0) && slope.iter().any(|&d| d > 0.0), "{kind:?}: {slope:?}");
            for i in 0..3 {
                let mut more = q.clone();
                more[i] += 0.5;
                assert!(mixer.total(&state, &more) >= mixer.total(&state, &q), "{kind:?}");
            }
        }
    }
}

#[test]
fn the_invariant_mixer_ignores_the_order_of_uavs_and_of_users() {
    let mixer = RandomMixer::new(MixerKind::Invariant, &DIMS, 4);
    let (state, q) = (uniform(21, 4), uniform(3, 5));
    let order = [2, 0, 1];
    let uavs = order.iter().flat_map(|&i| &state[2 * i..2 * i + 2]);
    let users = [4, 2, 0, 1, 3].into_iter().flat_map(|j| &state[6 + 3 * j..9 + 3 * j]);
    let shuffled: Vec<f32> = uavs.chain(users).copied().collect();
    let total = mixer.total(&state, &q);
    assert!(close(total, mixer.total(&shuffled, &order.map(|i| q[i]))));
    assert!(!close(total, mixer.total(&shuffled, &q)), "a permutation of positions alone changes Q_tot");
}

#[test]
fn an_invariant_mixer_fits_any_fleet() {
    let layout = |uavs, users| {
        let mut layout = ParameterLayout::default();
        Mixer::new(MixerKind::Invariant, &Dims { uavs, users, ..DIMS }, &mut layout);
        layout
    };
    assert_eq!(layout(3, 5), layout(12, 40));
}

/// x'_i = agg_j f(x_i || x_j - x_i), edge by edge, in f64.
fn naive_edge_conv(
    layout: &ParameterLayout,
    params: &[f64],
    graph: &Graph,
    x: &Batch<f64>,
    mean: bool,
    nodes: usize,
) -> Vec<f64> {
    let get = |name: &str| {
        let p = layout.parameters().iter().find(|p| p.name == format!("layer.f.{name}")).expect(name);
        &params[p.range.clone()]
    };
    let linear = |name: &str, x: &[f64]| -> Vec<f64> {
        let (weight, bias) = (get(&format!("{name}.weight")), get(&format!("{name}.bias")));
        weight.chunks(x.len()).zip(bias).map(|(w, b)| b + w.iter().zip(x).map(|(w, x)| w * x).sum::<f64>()).collect()
    };
    let f = |pair: &[f64]| {
        let h = linear("0", pair);
        let mean = h.iter().sum::<f64>() / h.len() as f64;
        let variance = h.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / h.len() as f64;
        let affine = get("1.weight").iter().zip(get("1.bias"));
        let normal = h.iter().zip(affine).map(|(x, (g, b))| ((x - mean) / (variance + 1e-5).sqrt() * g + b).max(0.0));
        linear("3", &normal.collect::<Vec<_>>())
    };
    let mut out = Vec::new();
    for i in 0..nodes {
        let neighbours = graph.neighbours(i);
        let mut sum = vec![0.0; HIDDEN];
        for &j in neighbours {
            let (a, b) = (x.row(i), x.row(j as usize));
            let pair: Vec<f64> = a.iter().copied().chain(b.iter().zip(a).map(|(b, a)| b - a)).collect();
            sum.iter_mut().zip(f(&pair)).for_each(|(s, y)| *s += y);
        }
        let share = if mean { 1.0 / neighbours.len().max(1) as f64 } else { 1.0 };
        out.extend(sum.iter().map(|s| s * share));
    }
    out
}

#[test]
fn factored_edge_conv_equals_the_formula() {
    let mut stream = rng::stream(6, "graph", 0);
    let lists: Vec<Vec<u32>> =
        (0..9).map(|i| if i == 4 { vec![] } else { (0..12).filter(|_| stream.random_bool(0.4)).collect() }).collect();
    let offsets = (0..=9).map(|i| lists[..i].iter().map(|l| l.len() as u32).sum()).collect();
    let graph = Graph { offsets, targets: lists.concat(), reach: vec![5, 9, 12] };
    for mean in [true, false] {
        let mut layout = ParameterLayout::default();
        let layer = GraphLayer::edge_conv(&mut layout, "layer", mean);
        // Different scales and shifts, so that the order of operations matters.
        let mut params: Vec<f64> = layout.initialise(&mut rng::stream(7, "init", 0));
        params.iter_mut().zip(uniform(layout.len(), 8)).for_each(|(p, d)| *p += 0.1 * f64::from(d));
        let mut prepared = vec![0.0; params.len()];
        layer.prepare(&params, &mut prepared);
        let (mut x, mut y) = (Batch::default(), Batch::default());
        x.resize(HIDDEN, 12);
        x.as_mut_slice().iter_mut().zip(uniform(12 * HIDDEN, 9)).for_each(|(x, d)| *x = d.into());
        y.resize(HIDDEN, 9);
        layer.forward(
            Weights { params: &params, prepared: &prepared },
            &graph,
            x.rows(),
            &mut LayerCache::default(),
            y.rows_mut(),
        );
        let naive = naive_edge_conv(&layout, &params, &graph, &x, mean, 9);
        for (a, b) in y.as_slice().iter().zip(&naive) {
            assert!((a - b).abs() < 1e-12, "{a}, expected {b}");
        }
        assert!(y.row(4).iter().all(|&x| x == 0.0), "an isolated node gets 0");
    }
}

#[test]
fn updates_have_the_same_bits_for_any_number_of_threads() {
    for (algorithm, preset) in
        [(Algorithm::Qedgix, Preset::Practical), (Algorithm::Qmix, Preset::Paper), (Algorithm::Iql, Preset::Paper)]
    {
        let mut config = TrainConfig::preset(algorithm, preset);
        config.environment.slots = 10;
        let run = |threads| {
            let mut learner = Learner::new(&config, threads).expect("threads");
            let mut updates = Vec::new();
            for seed in 0..3 {
                updates.push(learner.update(&[episodes(&config.dims(), 37, seed)], 1e-3));
                learner.sync_targets();
            }
            assert!(updates.iter().all(|u| u.loss.is_finite() && u.grad_norm > 0.0));
            (updates, learner.state())
        };
        let one = run(1);
        assert_eq!(one, run(2), "{algorithm:?}");
        assert_eq!(one, run(3), "{algorithm:?}");
    }
}

#[test]
fn restored_learner_continues_with_the_same_bits() {
    let mut config = TrainConfig::preset(Algorithm::Qmix, Preset::Practical);
    config.environment.slots = 8;
    let batch = |seed| episodes(&config.dims(), 6, seed);
    let mut whole = Learner::new(&config, 1).expect("a thread");
    whole.update(&[batch(0)], 1e-3);
    let state = whole.state();
    whole.sync_targets();
    whole.update(&[batch(1)], 1e-3);
    let mut resumed = Learner::new(&TrainConfig { seed: 99, ..config.clone() }, 1).expect("a thread");
    resumed.restore(state.clone()).expect("the same architecture");
    assert_eq!(resumed.state(), state);
    resumed.sync_targets();
    resumed.update(&[batch(1)], 1e-3);
    assert_eq!(whole.state(), resumed.state());
    let short = qedgix::learner::LearnerState { adam_v: vec![0.0; 3], ..state };
    assert_eq!(resumed.restore(short).expect_err("too short").field, "adam_v");
}

#[test]
fn agents_reject_fleets_that_do_not_fit() {
    let fits = |config, uavs, users| learned(config).check_fleet(uavs, users).map_err(|e| e.field);
    assert_eq!(fits(AGENT, 3, 5), Ok(()));
    assert_eq!(fits(AGENT, 4, 5), Err("uavs".into()));
    assert_eq!(fits(AGENT, 3, 6), Err("users".into()));
    assert_eq!(fits(AgentConfig { identity: Identity::Onehot, ..SET }, 3, 50), Ok(()));
    assert_eq!(fits(AgentConfig { identity: Identity::Onehot, ..SET }, 4, 5), Err("uavs".into()));
    assert_eq!(fits(SET, 40, 200), Ok(()));
    assert_eq!(fits(SET, 0, 5), Err("uavs".into()));
}
