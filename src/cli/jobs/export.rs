//! `qedgix jobs export`: what a job has made, as files.

use std::fs::{self, File};
use std::io::{BufReader, BufWriter, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use clap::Args;
use serde_json::{Map, Value, json};

use super::reference::resolve;
use super::tensorboard::{self, Attempt};
use crate::checkpoint::digest;
use crate::cli::client::{Client, ClientError};
use crate::cli::files::write_atomic;
use crate::cli::output::outln;
use crate::cli::rest::{items, text};
use crate::files::{partial_path, replace};

/// Flags of `jobs export`.
#[derive(Args, Debug)]
pub struct ExportArgs {
    /// Id of the job, the beginning of it, or a name
    job: String,
    /// Directory for config.json, job.json, metrics.csv, best.safetensors, last.safetensors and result.json, as far as the job has them
    /// [default: the id of the job]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Also write the metrics as event files of TensorBoard, one per attempt, into the directory `tensorboard` in DIR
    #[arg(long)]
    tensorboard: bool,
}

/// Runs the command.
pub(super) async fn run(client: &Client, args: ExportArgs, print_json: bool) -> anyhow::Result<()> {
    let id = resolve(client, &args.job).await?;
    let dir = args.out.unwrap_or_else(|| id.clone().into());
    fs::create_dir_all(&dir).with_context(|| format!("cannot create {}", dir.display()))?;
    let job = client.get(&format!("/v1/jobs/{id}")).await?;
    let mut files = Vec::new();
    for (name, document) in [("job.json", &job), ("config.json", &config(&job))] {
        write_atomic(&dir.join(name), format!("{document:#}\n").as_bytes())?;
        files.push(name.to_owned());
    }
    metrics(client, &id, &dir.join("metrics.csv")).await?;
    files.push("metrics.csv".to_owned());
    if args.tensorboard {
        let csv = BufReader::new(File::open(dir.join("metrics.csv"))?);
        let written = tensorboard::write(&dir.join("tensorboard"), csv, &attempts(client, &id).await?)?;
        files.extend(written.iter().map(|name| format!("tensorboard/{name}")));
    }
    for kind in ["best", "last"] {
        if let Some(details) = checkpoint(client, &id, kind).await? {
            let name = format!("{kind}.safetensors");
            write_verified(client, &details, &dir.join(&name)).await?;
            files.push(name);
        }
    }
    if let Some(result) = result(client, &id).await? {
        write_atomic(&dir.join("result.json"), format!("{result:#}\n").as_bytes())?;
        files.push("result.json".to_owned());
    }
    if print_json {
        outln!("{:#}", json!({"job": id, "directory": dir, "files": files}))?;
    } else {
        outln!("wrote {} to {}", files.join(", "), dir.display())?;
    }
    Ok(())
}

/// The result of a job: a report, the means of a sweep; `None` if it has none.
async fn result(client: &Client, id: &str) -> anyhow::Result<Option<Value>> {
    match client.get(&format!("/v1/jobs/{id}/result")).await {
        Ok(result) => Ok(Some(result)),
        Err(ClientError::Refused { code, .. }) if code == "wrong_state" => Ok(None),
        Err(error) => Err(error.into()),
    }
}

/// What to submit to run the same job again. What it came after is left out, because that has ended.
fn config(job: &Value) -> Value {
    let fields = [
        "kind",
        "name",
        "labels",
        "notes",
        "threads",
        "priority",
        "max_attempts",
        "timeout",
        "backoff",
        "memory",
        "stop",
        "publish",
        "algorithm",
        "preset",
        "environment",
        "training",
        "evaluation",
        "sweep",
        "experiment",
        "seed",
    ];
    let given = fields.iter().filter(|field| !job[**field].is_null());
    let mut config: Map<_, _> = given.map(|field| ((*field).to_owned(), job[*field].clone())).collect();
    for source in ["policy", "checkpoint"] {
        if !job["init"][source].is_null() {
            config.insert("init".into(), json!({source: job["init"][source]}));
        }
    }
    if job["evaluation"].is_object() {
        let (evaluation, environment) = evaluation(&job["evaluation"]);
        config.extend([("evaluation".into(), evaluation), ("environment".into(), environment)]);
    }
    if job["sweep"].is_object() {
        config.extend(sweep(&job["sweep"]));
    }
    config.into()
}

/// The request of an evaluation, and its environment.
fn evaluation(stored: &Value) -> (Value, Value) {
    let mut request = Map::new();
    for field in ["policies", "layouts", "episodes", "plan"] {
        request.insert(field.into(), stored[field].clone());
    }
    for field in ["lose", "position_noise"] {
        request.insert(field.into(), stored["disturbance"][field].clone());
    }
    request.retain(|_, value| !value.is_null());
    (request.into(), stored["environment"].clone())
}

/// The fields of the request of a sweep: its combinations, and what all of its jobs share. Older servers did not store that.
fn sweep(stored: &Value) -> Map<String, Value> {
    let mut request: Map<_, _> = stored["base"].as_object().cloned().unwrap_or_default();
    request.retain(|_, value| !value.is_null());
    request.insert("sweep".into(), json!({"list": stored["points"], "seeds": stored["seeds"]}));
    request
}

/// The attempts of a job in the order of their begin.
async fn attempts(client: &Client, id: &str) -> anyhow::Result<Vec<Attempt>> {
    let response = client.get(&format!("/v1/jobs/{id}/logs")).await?;
    let attempt = |attempt: &Value| Some((attempt["attempt"].as_u64()?, attempt["started_at"].as_str()?.parse().ok()?));
    items(&response, "attempts")
        .map(|value| attempt(value).with_context(|| format!("the server sent the attempt {value}")))
        .collect()
}

/// Writes the metrics as the server has them: name, step, value, at.
async fn metrics(client: &Client, id: &str, path: &Path) -> anyhow::Result<()> {
    let partial = partial_path(path);
    let cannot = || format!("cannot write {}", path.display());
    let mut file = BufWriter::new(File::create(&partial).with_context(cannot)?);
    let written = client.download_into(&format!("/v1/jobs/{id}/metrics?format=csv"), &mut file).await;
    let written = written.and_then(|()| {
        file.flush()?;
        file.get_ref().sync_all()?;
        Ok(replace(&partial, path)?)
    });
    if written.is_err() {
        let _ = fs::remove_file(&partial);
    }
    written.with_context(cannot)
}

/// The checkpoint of a job of this kind, `best` or `last`, without its bytes; `None` if the job has none.
///
/// # Errors
/// The server cannot be reached or refuses.
pub async fn checkpoint(client: &Client, id: &str, kind: &str) -> anyhow::Result<Option<Value>> {
    let response = client.get(&format!("/v1/jobs/{id}/checkpoints")).await?;
    Ok(items(&response, "checkpoints").find(|checkpoint| checkpoint["kind"] == kind).cloned())
}

/// Downloads a checkpoint, checks its digest, and writes it.
///
/// # Errors
/// The server cannot be reached, the bytes are others than announced, or the file cannot be written.
pub async fn write_verified(client: &Client, checkpoint: &Value, path: &Path) -> anyhow::Result<Vec<u8>> {
    let id = text(&checkpoint["id"]);
    let bytes = client.download(&format!("/v1/checkpoints/{id}")).await?;
    ensure!(checkpoint["sha256"] == digest(&bytes).as_str(), "checkpoint {id}: the downloaded bytes do not have its digest");
    write_atomic(path, &bytes)?;
    Ok(bytes)
}
