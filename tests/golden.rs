//! Compares whole learner updates with the golden files (docs/model.md, "Golden files"): detections, observations, Q-values,
//! targets, loss, every gradient, and every parameter after the step.
//!
//! Checks every `*.safetensors` in `tests/golden`, or in the directory `QEDGIX_GOLDEN_DIR` if that variable is set. Prints each
//! file with the tensor that comes closest to its tolerance. A file fails if a tensor is missing, unexpected or of another shape.
//! Repeats all with every vector width of the processor, in a process of its own, unless `QEDGIX_VECTOR_WIDTH` is set.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};
use std::str::FromStr;

use qedgix::learner::Episodes;
use qedgix::learner::loss::{Loss, TdLambda, Trace};
use qedgix::nn::{Adam, ParameterLayout, Real, VECTOR_WIDTH_VARIABLE, VectorWidth};
use qedgix::policy::mixer::MixerKind;
use qedgix::policy::{
    Advice, AgentConfig, Aggregation, Dims, EnvParams, Geometry, GeometryConfig, Gnn, HopSearch, Identity, Memory,
    ObservationKind, TOKEN, flat_observation, flat_state,
};
use safetensors::{Dtype, SafeTensors};

/// Tolerance of outputs and gradients computed in f32, relative to the tensor's largest magnitude, with up to 8 nodes. Gradients of
/// LayerNorm's shift are sums over all edges whose terms nearly cancel, so the error grows with the nodes: 2e-6 with 8, up to 1.3e-5 with 38.
const TOLERANCE: f64 = 2e-5;
/// The same in f64, with any number of nodes. The files have f32 numbers, which are correct to 6e-8.
const TOLERANCE_F64: f64 = 1e-6;
/// Tolerance of parameters after the step: Adam's first step turns tiny gradients into whole steps.
const TOLERANCE_AFTER: f64 = 2e-3;

type Checked<T> = Result<T, String>;

fn main() -> ExitCode {
    if std::env::var_os(VECTOR_WIDTH_VARIABLE).is_some() { check_all() } else { check_widths() }
}

/// Runs this program with each vector width.
fn check_widths() -> ExitCode {
    let program = std::env::current_exe().expect("the path of this program");
    let mut code = ExitCode::SUCCESS;
    for width in VectorWidth::available() {
        println!("vector width {}", width.name());
        let status = Command::new(&program).env(VECTOR_WIDTH_VARIABLE, width.name()).status().expect("this program runs");
        if !status.success() {
            code = ExitCode::FAILURE;
        }
    }
    code
}

fn check_all() -> ExitCode {
    let own = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden");
    let dir = std::env::var_os("QEDGIX_GOLDEN_DIR").map_or(own, PathBuf::from);
    let files = match golden_files(&dir) {
        Ok(files) => files,
        Err(message) => {
            println!("golden: {}: {message}", dir.display());
            return ExitCode::FAILURE;
        }
    };
    let mut failed = 0;
    for file in &files {
        let name = file.file_name().unwrap_or_default().to_string_lossy();
        match check(file) {
            Ok(worst) => println!("ok    {name}: {worst}"),
            Err(message) => {
                failed += 1;
                println!("FAIL  {name}: {message}");
            }
        }
    }
    println!("golden: {} files, {failed} failed", files.len());
    if failed == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

fn golden_files(dir: &Path) -> Checked<Vec<PathBuf>> {
    let entries = std::fs::read_dir(dir).map_err(|e| e.to_string())?;
    let paths: Result<Vec<_>, _> = entries.map(|e| e.map(|e| e.path())).collect();
    let mut files = paths.map_err(|e| e.to_string())?;
    files.retain(|p| p.extension().is_some_and(|e| e == "safetensors"));
    files.sort();
    if files.is_empty() { Err("no *.safetensors here".into()) } else { Ok(files) }
}

/// A golden file's configuration.
struct Config {
    agent: AgentConfig,
    dims: Dims,
    mixer: MixerKind,
    td_lambda: TdLambda,
    batch: usize,
    learning_rate: f64,
    clip: f64,
}

impl Config {
    fn parse(meta: &HashMap<String, String>) -> Checked<Self> {
        let text = |key: &str| meta.get(key).map(String::as_str).ok_or_else(|| format!("metadata lacks {key}"));
        fn number<T: FromStr>(key: &str, text: &str) -> Checked<T> {
            text.parse().map_err(|_| format!("metadata {key} = {text} is not a number of its kind"))
        }
        let count = |key: &str| number::<usize>(key, text(key)?);
        let real = |key: &str| number::<f64>(key, text(key)?);
        let flag = |key: &str| match text(key)? {
            "True" => Ok(true),
            "False" => Ok(false),
            other => Err(format!("metadata {key} = {other} is neither True nor False")),
        };
        let unknown = |key: &str| Err(format!("metadata {key} = {} is unknown", meta[key]));
        let agent = AgentConfig {
            gnn: match text("gnn")? {
                "none" => Gnn::None,
                "edgeconv" => Gnn::EdgeConv,
                "agggnn" => Gnn::AggGnn,
                "rgcn" => Gnn::Rgcn,
                _ => return unknown("gnn"),
            },
            layers: count("layers")?,
            aggregation: match text("agg")? {
                "mean" => Aggregation::Mean,
                "sum" => Aggregation::Sum,
                _ => return unknown("agg"),
            },
            observation: match text("encoder")? {
                "flat" => ObservationKind::Flat,
                "set" => ObservationKind::Set,
                _ => return unknown("encoder"),
            },
            identity: match text("ident")? {
                "onehot" => Identity::Onehot,
                "phase" => Identity::Phase,
                "token" => Identity::Token,
                "none" => Identity::None,
                _ => return unknown("ident"),
            },
            self_position: flag("self_position")?,
            self_loops: flag("self_loops")?,
            hops: 1,
            normalise: false,
            memory: Memory::None,
            advice: Advice::None,
        };
        if count("token")? != TOKEN {
            return Err(format!("metadata token = {}; expected {TOKEN}", text("token")?));
        }
        Ok(Self {
            agent,
            dims: Dims {
                uavs: count("M")?,
                users: count("N")?,
                env: EnvParams {
                    actions: count("A")?,
                    detection_range: real("d")?,
                    communication_range: real("d")?,
                    slots: count("K")?,
                    ..EnvParams::default()
                },
            },
            mixer: match text("mixer")? {
                "qmix" => MixerKind::Qmix,
                "invariant" => MixerKind::Invariant,
                "vdn" => MixerKind::Vdn,
                _ => return unknown("mixer"),
            },
            td_lambda: TdLambda { gamma: real("gamma")?, lambda: real("td_lambda")? },
            batch: count("batch")?,
            learning_rate: real("lr")?,
            clip: real("clip")?,
        })
    }
}

impl Config {
    fn loss<T: Real>(&self) -> Loss<T> {
        Loss::new(self.agent, self.dims, self.mixer, self.td_lambda, 1)
    }
}

/// A file's tensors. Their shapes are checked when they are read, and unread tensors are reported.
struct Tensors<'a> {
    all: SafeTensors<'a>,
    read: BTreeSet<String>,
}

impl Tensors<'_> {
    fn bytes(&mut self, name: &str, shape: &[usize], dtype: Dtype) -> Checked<&[u8]> {
        let view = self.all.tensor(name).map_err(|_| format!("{name} is missing"))?;
        if view.shape() != shape || view.dtype() != dtype {
            let found = (view.shape(), view.dtype());
            return Err(format!("{name} is {found:?} instead of {:?}", (shape, dtype)));
        }
        self.read.insert(name.to_owned());
        Ok(view.data())
    }

    fn f32(&mut self, name: &str, shape: &[usize]) -> Checked<Vec<f32>> {
        let bytes = self.bytes(name, shape, Dtype::F32)?;
        let values: Vec<f32> = bytes.as_chunks().0.iter().map(|&b| f32::from_le_bytes(b)).collect();
        if values.iter().all(|x| x.is_finite()) { Ok(values) } else { Err(format!("{name} is not finite")) }
    }

    fn actions(&mut self, name: &str, shape: &[usize], count: usize) -> Checked<Vec<u8>> {
        let bytes = self.bytes(name, shape, Dtype::I64)?;
        let values = bytes.as_chunks().0.iter().map(|&b| i64::from_le_bytes(b));
        values
            .map(|a| u8::try_from(a).ok().filter(|&a| usize::from(a) < count).ok_or_else(|| format!("{name} has action {a}")))
            .collect()
    }
}

/// Results of comparisons, with the tensor that came closest to its tolerance.
#[derive(Default)]
struct Report {
    /// Share of the tolerance used, tensor, relative error.
    worst: (f64, String, f64),
    failures: BTreeMap<String, f64>,
}

impl Report {
    fn compare<T: Real>(&mut self, name: &str, ours: &[T], golden: &[f32], tolerance: f64) {
        assert_eq!(ours.len(), golden.len(), "{name}");
        let scale = golden.iter().fold(0.0, |max: f64, x| max.max(f64::from(x.abs())));
        let difference = |(a, b): (&T, &f32)| (a.to_f64() - f64::from(*b)).abs();
        // f64::max would ignore NaN.
        let largest = ours.iter().zip(golden).map(difference).fold(0.0, |m: f64, d| if d <= m { m } else { d });
        let error = if largest == 0.0 { 0.0 } else { largest / scale };
        if !(error <= tolerance) {
            self.failures.insert(name.to_owned(), error);
        }
        if !(error / tolerance <= self.worst.0) || self.worst.1.is_empty() {
            self.worst = (error / tolerance, name.to_owned(), error);
        }
    }
}

fn check(file: &Path) -> Checked<String> {
    let bytes = std::fs::read(file).map_err(|e| e.to_string())?;
    let (_, header) = SafeTensors::read_metadata(&bytes).map_err(|e| e.to_string())?;
    let config = Config::parse(header.metadata().as_ref().ok_or("no metadata")?)?;
    let all = SafeTensors::deserialize(&bytes).map_err(|e| e.to_string())?;
    let mut tensors = Tensors { all, read: BTreeSet::new() };
    let mut report = Report::default();
    let Dims { uavs: m, users: n, env: EnvParams { slots: k, actions, .. } } = config.dims;
    let b = config.batch;

    let episodes = Episodes {
        env: config.dims.env,
        len: b,
        uavs: m,
        users: n,
        slots: k,
        uav_xy: tensors.f32("in.uavs", &[b, k + 1, m, 2])?,
        user_xy: tensors.f32("in.users", &[b, n, 2])?,
        users_move: false,
        aoi: tensors.f32("in.aoi", &[b, k + 1, n])?,
        actions: tensors.actions("in.actions", &[b, k, m], actions)?,
        reward: tensors.f32("in.reward", &[b, k])?,
        identity_token: tensors.f32("in.token", &[b, m, TOKEN])?,
    };
    check_features(&config, &episodes, &mut tensors, &mut report)?;

    let golden = Golden::read(&config, episodes, &mut tensors)?;
    golden.compare::<f64>(&config, &mut report, TOLERANCE_F64);
    let nodes = config.dims.uavs + config.dims.users;
    let gradient = golden.compare::<f32>(&config, &mut report, TOLERANCE * (nodes as f64 / 8.0).max(1.0));
    golden.compare_step(&config, &mut report, &gradient);

    let unexpected: Vec<_> = tensors.all.names().into_iter().filter(|name| !tensors.read.contains(*name)).collect();
    if !unexpected.is_empty() {
        return Err(format!("unexpected tensors: {}", unexpected.join(", ")));
    }
    let (_, name, error) = &report.worst;
    let worst = format!("{} tensors, worst {name} with relative error {error:.1e}", tensors.read.len());
    if report.failures.is_empty() {
        return Ok(worst);
    }
    let failures: Vec<_> = report.failures.iter().map(|(name, error)| format!("{name} {error:.1e}")).collect();
    Err(format!("{worst}; beyond tolerance: {}", failures.join(", ")))
}

/// An update: its inputs, and the outputs to compare with.
struct Golden {
    episodes: Episodes,
    layout: ParameterLayout,
    online: Vec<f32>,
    target: Vec<f32>,
    outputs: Vec<(&'static str, Vec<f32>)>,
    gradient: Vec<f32>,
    after: Vec<f32>,
}

impl Golden {
    fn read(config: &Config, episodes: Episodes, tensors: &mut Tensors<'_>) -> Checked<Self> {
        let Dims { uavs: m, env: EnvParams { slots: k, actions, .. }, .. } = config.dims;
        let (b, layout) = (config.batch, config.loss::<f32>().layout().clone());
        let mut flat = |prefix: &str| -> Checked<Vec<f32>> {
            let mut values = Vec::with_capacity(layout.len());
            for p in layout.parameters() {
                values.extend(tensors.f32(&format!("{prefix}{}", p.name), &p.shape)?);
            }
            Ok(values)
        };
        let (online, target, gradient, after) = (flat("")?, flat("target_")?, flat("grad.")?, flat("after.")?);
        let shapes = [
            ("out.q", &[b, k + 1, m, actions][..]),
            ("out.q_tot", &[b, k]),
            ("out.target", &[b, k]),
            ("out.loss", &[1]),
            ("out.grad_norm", &[1]),
        ];
        let outputs: Checked<Vec<_>> = shapes.into_iter().map(|(name, shape)| Ok((name, tensors.f32(name, shape)?))).collect();
        Ok(Self { episodes, layout, online, target, outputs: outputs?, gradient, after })
    }

    /// Compares outputs and gradients computed in `T`. Returns the gradient and its norm.
    fn compare<T: Real>(&self, config: &Config, report: &mut Report, tolerance: f64) -> (Vec<T>, f64) {
        let values = |values: &[f32]| -> Vec<T> { values.iter().map(|&x| T::from_f64(f64::from(x))).collect() };
        let (mut loss, mut trace) = (config.loss::<T>(), Trace::default());
        let (online, target) = (values(&self.online), values(&self.target));
        let metrics = loss.compute_gradient(&online, &target, std::slice::from_ref(&self.episodes), Some(&mut trace));
        let name = |name: &str| format!("{name} in {}", std::any::type_name::<T>());
        let single = [metrics.loss, metrics.grad_norm].map(|x| vec![T::from_f64(x)]);
        let ours = [&trace.q, &trace.q_tot, &trace.target, &single[0], &single[1]];
        for (ours, (tensor, golden)) in ours.into_iter().zip(&self.outputs) {
            report.compare(&name(tensor), ours, golden, tolerance);
        }
        for p in self.layout.parameters() {
            let ours = &loss.gradient()[p.range.clone()];
            report.compare(&name(&format!("grad.{}", p.name)), ours, &self.gradient[p.range.clone()], tolerance);
        }
        (loss.gradient().to_vec(), metrics.grad_norm)
    }

    /// Compares the parameters after the step.
    fn compare_step(&self, config: &Config, report: &mut Report, (gradient, norm): &(Vec<f32>, f64)) {
        let mut online = self.online.clone();
        Adam::new(online.len()).step(&mut online, gradient, config.learning_rate, (*norm, config.clip));
        for p in self.layout.parameters() {
            let range = p.range.clone();
            report.compare(&format!("after.{}", p.name), &online[range.clone()], &self.after[range], TOLERANCE_AFTER);
        }
    }
}

/// Compares the detections of all pairs, exactly, and the flat observation of every node and the flat state if recorded.
fn check_features(config: &Config, episodes: &Episodes, tensors: &mut Tensors<'_>, report: &mut Report) -> Checked<()> {
    let Dims { uavs: m, users: n, env: EnvParams { slots: k, detection_range: range, .. } } = config.dims;
    let (b, nodes, width) = (episodes.len, m + n, 2 * m + 3 * n);
    // With one layer, the geometry has the detections of users too.
    let wanted =
        GeometryConfig { ranges: range.into(), episode_slots: k, layers: 1, self_loops: config.agent.self_loops, hops: 1 };
    let (mut geometry, mut search) = (Geometry::default(), HopSearch::default());
    geometry.clear();
    let mut state = vec![0.0; b * (k + 1) * width];
    for (at, state) in state.chunks_exact_mut(width).enumerate() {
        let uav_xy = &episodes.uav_xy[at * 2 * m..][..2 * m];
        let user_xy = &episodes.user_xy[at / (k + 1) * 2 * n..][..2 * n];
        let aoi = &episodes.aoi[at * n..][..n];
        geometry.push_scene(&wanted, uav_xy, user_xy, aoi);
        flat_state(uav_xy, user_xy, aoi, k, state);
    }
    geometry.finish(&wanted);
    let mut visible = vec![0.0; b * (k + 1) * nodes * nodes];
    let mut observations = vec![0.0_f32; b * (k + 1) * nodes * width];
    let rows = visible.chunks_exact_mut(nodes).zip(observations.chunks_exact_mut(width));
    for (at, (visible, observation)) in rows.enumerate() {
        let view = geometry.view_of_node(at / nodes, at % nodes, &mut search);
        visible[view.node] = 1.0;
        view.detections.iter().for_each(|d| visible[d.target as usize] = 1.0);
        flat_observation(&view, 1.0, observation);
    }
    let golden = tensors.f32("out.visible", &[b, k + 1, nodes, nodes])?;
    if golden != visible {
        return Err(format!("out.visible differs in {} pairs", golden.iter().zip(&visible).filter(|(a, b)| a != b).count()));
    }
    if config.agent.observation == ObservationKind::Flat {
        report.compare("out.obs", &observations, &tensors.f32("out.obs", &[b, k + 1, nodes, width])?, TOLERANCE);
        report.compare("out.state", &state, &tensors.f32("out.state", &[b, k + 1, width])?, TOLERANCE);
    }
    Ok(())
}
