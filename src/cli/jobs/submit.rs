//! `qedgix jobs submit`, and the submission of `qedgix train --server`.

use std::io::Read;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, bail, ensure};
use clap::Args;
use serde_json::{Map, Value, json};

use super::reference::{resolve, resolve_all};
use super::screen::{Lines, Screen};
use super::view::JobView;
use super::watch::{self, OnSignal};
use crate::cli::client::{Client, ClientError};
use crate::cli::output::{errln, outln};
use crate::cli::run_args::{RunArgs, count, insert};
use crate::cli::serve::duration;
use crate::cli::toml_file;
use crate::jobs::webhooks::Secret;

/// Flags of `jobs submit`.
#[derive(Args, Debug)]
pub struct SubmitArgs {
    #[command(flatten)]
    run: RunArgs,
    /// The job as a JSON or, if the name ends with .toml, TOML document, as POST /v1/jobs takes it; flags override its fields. -:
    /// JSON from standard input
    #[arg(long, value_name = "FILE")]
    file: Option<PathBuf>,
    /// Submits the experiment of this TOML file, as `qedgix experiment` runs it; --steps, --uavs and --set override the fields of all
    /// runs
    #[arg(long, value_name = "FILE", conflicts_with = "file")]
    experiment: Option<PathBuf>,
    #[command(flatten)]
    of_experiment: OfExperiment,
    #[command(flatten)]
    job: JobArgs,
    /// Follow the job until its end; the exit status is then that of `jobs watch`
    #[arg(long)]
    watch: bool,
}

/// What overrides the file of `--experiment` besides the fields of its runs.
#[derive(Args, Debug)]
struct OfExperiment {
    /// Seeds of the experiment; override those of the file
    #[arg(long, value_delimiter = ',', requires = "experiment")]
    seeds: Option<Vec<u64>>,
    /// Number of seeds of the experiment: the first of the file, and beyond them the next numbers [default: all of the file]
    #[arg(long, value_name = "NUMBER", requires = "experiment", conflicts_with = "seeds")]
    num_seeds: Option<u16>,
    /// Submits only the series with this name; may be repeated
    #[arg(long, value_name = "NAME", requires = "experiment")]
    series: Vec<String>,
    /// Submits only the point with this name; may be repeated
    #[arg(long, value_name = "NAME", requires = "experiment")]
    point: Vec<String>,
}

impl OfExperiment {
    /// The table `overrides` of the document.
    fn overrides(&self) -> Map<String, Value> {
        let mut overrides = Map::new();
        insert(&mut overrides, "seeds", self.seeds.as_ref());
        insert(&mut overrides, "num_seeds", self.num_seeds);
        insert(&mut overrides, "series", Some(&self.series).filter(|names| !names.is_empty()));
        insert(&mut overrides, "points", Some(&self.point).filter(|names| !names.is_empty()));
        overrides
    }
}

/// What a job has besides its training run.
#[derive(Args, Debug)]
pub struct JobArgs {
    /// Name of the job and of the policy that it publishes
    #[arg(long, env = "QEDGIX_NAME")]
    name: Option<String>,
    /// Threads that the job may use [default: 1]
    #[arg(long, env = "QEDGIX_THREADS")]
    threads: Option<usize>,
    /// Label for people; may be repeated
    #[arg(long, value_name = "KEY=VALUE")]
    label: Vec<String>,
    /// Begins with the weights of this policy (NAME, NAME@ALIAS, NAME:VERSION) or of the checkpoint with this id [default: weights are
    /// drawn]
    #[arg(long, env = "QEDGIX_INIT", value_name = "POLICY_OR_ID")]
    init: Option<String>,
    /// Jobs with a higher priority start first, -100 to 100 [default: 0]
    #[arg(long, env = "QEDGIX_PRIORITY", allow_negative_numbers = true)]
    priority: Option<i64>,
    /// Most memory of the worker, as 800M, 2G or a number of bytes; a worker that uses more is ended, and the job has failed [default:
    /// several times the estimate]
    #[arg(long, env = "QEDGIX_MEMORY", value_name = "SIZE", value_parser = size)]
    memory: Option<u64>,
    /// Job that must succeed before this one starts: its id, the beginning of it, or a name; may be repeated
    #[arg(long, value_name = "JOB")]
    after: Vec<String>,
    /// URL to which the server sends a message when the job ends, a POST request; may be repeated
    #[arg(long, value_name = "URL")]
    webhook: Vec<String>,
    /// Key of the signatures of the messages to --webhook; prefer the environment variable [default: messages are not signed]
    #[arg(long, env = "QEDGIX_WEBHOOK_SECRET", hide_env_values = true, value_name = "SECRET")]
    webhook_secret: Option<Secret>,
    /// Time that all attempts together may run, as 90s, 10m or 2h; then the job has failed [default: no limit]
    #[arg(long, env = "QEDGIX_TIMEOUT", value_name = "TIME", value_parser = duration)]
    timeout: Option<Duration>,
}

/// Parses a size in bytes: a number, which may have the unit K, M, G or T (powers of 1024).
fn size(text: &str) -> Result<u64, String> {
    let expected = || "expected a number of bytes, or a number with a unit, as 800M or 2G".to_owned();
    let (number, unit) = match text.char_indices().last() {
        Some((at, 'K' | 'k')) => (&text[..at], 1 << 10),
        Some((at, 'M' | 'm')) => (&text[..at], 1 << 20),
        Some((at, 'G' | 'g')) => (&text[..at], 1 << 30),
        Some((at, 'T' | 't')) => (&text[..at], 1 << 40),
        _ => (text, 1),
    };
    count(number).ok().and_then(|number| number.checked_mul(unit)).ok_or_else(expected)
}

impl JobArgs {
    /// A job with a name, threads and initial weights only.
    pub fn new(name: Option<String>, threads: Option<usize>, init: Option<String>) -> Self {
        Self {
            name,
            threads,
            label: Vec::new(),
            init,
            priority: None,
            memory: None,
            after: Vec::new(),
            webhook: Vec::new(),
            webhook_secret: None,
            timeout: None,
        }
    }
}

/// The body of a submission.
///
/// # Errors
/// A flag is malformed.
pub fn body(mut document: Map<String, Value>, run: &RunArgs, job: &JobArgs) -> anyhow::Result<Value> {
    run.write_into(&mut document)?;
    insert(&mut document, "name", job.name.as_deref());
    insert(&mut document, "threads", job.threads);
    insert(&mut document, "priority", job.priority);
    insert(&mut document, "memory", job.memory);
    insert(&mut document, "after", Some(&job.after).filter(|ids| !ids.is_empty()));
    if !job.webhook.is_empty() {
        let webhook = |url: &String| json!({"url": url, "secret": job.webhook_secret});
        document.insert("webhooks".into(), job.webhook.iter().map(webhook).collect());
    }
    insert(&mut document, "timeout", job.timeout.map(|time| time.as_secs_f64().ceil() as u64));
    if let Some(init) = &job.init {
        ensure!(
            !Path::new(init).is_file(),
            "--init {init}: a server takes policies and ids of checkpoints; publish the file first: qedgix policies upload NAME {init}"
        );
        let field = if uuid::Uuid::try_parse(init).is_ok() { "checkpoint" } else { "policy" };
        document.insert("init".into(), json!({field: init}));
    }
    if !job.label.is_empty() {
        let labels = document.entry("labels").or_insert_with(|| Map::new().into());
        let labels = labels.as_object_mut().context("labels: expected an object")?;
        for label in &job.label {
            let (key, value) = label.split_once('=').with_context(|| format!("--label {label}: expected KEY=VALUE"))?;
            labels.insert(key.to_owned(), value.into());
        }
    }
    Ok(document.into())
}

/// Submits a job and returns it. A repetition, after a response that was lost, does not make a second job.
///
/// # Errors
/// The server cannot be reached, or refuses the job.
pub async fn submit(client: &Client, body: &Value) -> Result<Value, ClientError> {
    add(client, "/v1/jobs", body).await
}

/// Posts a request that adds a job, as [`submit`] does.
async fn add(client: &Client, path: &str, body: &Value) -> Result<Value, ClientError> {
    const TRIES: u32 = 4;
    let key = uuid::Uuid::now_v7().to_string();
    for tried in 1.. {
        let error = match client.post_once(path, body, &key).await {
            Ok(job) => return Ok(job),
            Err(error) => error,
        };
        // A server that does not run is told at once.
        let absent = matches!(&error, ClientError::Unreachable { source, .. } if source.is_connect());
        if absent || !error.is_temporary() || tried == TRIES {
            return Err(error);
        }
        tokio::time::sleep(Duration::from_millis(250 << tried)).await;
    }
    unreachable!("the last try returns")
}

/// Runs the command.
pub(super) async fn run(client: &Client, mut args: SubmitArgs, json: bool) -> anyhow::Result<()> {
    args.job.after = resolve_all(client, &args.job.after).await?;
    let document = args.file.as_deref().map(read).transpose()?.unwrap_or_default();
    let mut body = body(document, &args.run, &args.job)?;
    if let Some(path) = &args.experiment {
        body = experiment(read(path)?, args.of_experiment.overrides(), body);
    }
    let job = submit(client, &body).await?;
    print_and_watch(client, &job, json, args.watch).await
}

/// A job of the kind `experiment`, with `overrides` and the fields of `body` for all runs.
fn experiment(mut document: Map<String, Value>, mut overrides: Map<String, Value>, mut body: Value) -> Value {
    if let Value::Object(body) = &mut body {
        for section in ["environment", "training"] {
            overrides.extend(body.remove_entry(section));
        }
    }
    if !overrides.is_empty() {
        document.insert("overrides".into(), overrides.into());
    }
    (body["kind"], body["experiment"]) = ("experiment".into(), document.into());
    body
}

/// Flags of `jobs continue`.
#[derive(Args, Debug)]
pub struct ContinueArgs {
    /// Id of a training job that has ended, the beginning of it, or a name
    job: String,
    /// Environment steps to train further, as 400000, 400_000 or 4e5
    #[arg(long, value_parser = count)]
    steps: u64,
    /// Follow the new job until its end; the exit status is then that of `jobs watch`
    #[arg(long)]
    watch: bool,
}

/// Runs `jobs continue`.
pub(super) async fn continue_job(client: &Client, args: ContinueArgs, json: bool) -> anyhow::Result<()> {
    let id = resolve(client, &args.job).await?;
    let job = add(client, &format!("/v1/jobs/{id}/continue"), &json!({"steps": args.steps})).await?;
    let what = if job["init"]["from"] == "snapshot" { "the snapshot" } else { "the last weights" };
    errln!("continues with {what} of job {id}, from step {}", job["init"]["step"]);
    print_and_watch(client, &job, json, args.watch).await
}

/// Prints a job that was added, and follows it.
async fn print_and_watch(client: &Client, job: &Value, json: bool, watch: bool) -> anyhow::Result<()> {
    let id = job["id"].as_str().context("the response of the server has no job id")?.to_owned();
    match (json, watch) {
        (true, _) => outln!("{job:#}")?,
        (false, true) => errln!("job {id}"),
        (false, false) => outln!("{id}")?,
    }
    if !watch {
        return Ok(());
    }
    let lines = if json { Lines::Error } else { Lines::Out };
    let ended = watch::follow(client, &mut Screen::new(JobView::new(job), lines), OnSignal::Leave).await?;
    ended.into_result(client, &id)
}

/// Reads a job as an object.
fn read(path: &Path) -> anyhow::Result<Map<String, Value>> {
    let name = path.display();
    let mut text = String::new();
    if path == Path::new("-") {
        std::io::stdin().read_to_string(&mut text).context("cannot read standard input")?;
    } else {
        text = std::fs::read_to_string(path).with_context(|| format!("cannot read {name}"))?;
    }
    let document: Value = if path.extension().is_some_and(|extension| extension == "toml") {
        toml_file::parse(&name.to_string(), &text)?
    } else {
        serde_json::from_str(&text).with_context(|| name.to_string())?
    };
    let Value::Object(document) = document else { bail!("{name}: expected an object, the body of POST /v1/jobs") };
    Ok(document)
}
