//! A training run as a job of a server, with the same files at the end as a run in this process.

use std::fmt::Write as _;
use std::path::Path;

use anyhow::{Context, bail};
use serde_json::{Map, Value};

use super::{TrainArgs, local};
use crate::checkpoint::Checkpoint;
use crate::cli::client::Client;
use crate::cli::files::{check_distinct, check_writable, write_atomic};
use crate::cli::jobs::screen::{Lines, Screen};
use crate::cli::jobs::submit::{JobArgs, body, submit};
use crate::cli::jobs::view::JobView;
use crate::cli::jobs::watch::{Ended, OnSignal, follow};
use crate::cli::jobs::{checkpoint, write_verified};
use crate::cli::output::{errln, outln};
use crate::cli::run_args::all_cores;

/// Submits the run of the flags, follows it, and downloads its files.
///
/// # Errors
/// A file cannot be written, the server cannot be reached or refuses the job, or the job does not succeed.
pub async fn run(args: &TrainArgs, address: &str) -> anyhow::Result<()> {
    let out = args.out.as_deref().unwrap_or(Path::new(super::OUT));
    let mut files = vec![("--out", out)];
    files.extend(args.metrics.as_deref().map(|path| ("--metrics", path)));
    check_distinct(&files)?;
    for (flag, path) in files {
        check_writable(path).context(flag)?;
    }
    let client = Client::new(address, &args.connect)?;
    let body = body(Map::new(), &args.run, &JobArgs::new(args.name.clone(), args.threads, args.init.clone()))?;
    let job = submit(&client, &body).await?;
    let id = job["id"].as_str().context("the response of the server has no job id")?.to_owned();
    outln!("job {id}")?;
    errln!("to come back: qedgix jobs watch {id} --server {}", client.base());
    let ended = follow(&client, &mut Screen::new(JobView::new(&job), Lines::Error), OnSignal::Ask).await?;
    if let Ended::Left(_) = ended {
        return ended.into_result(&client, &id);
    }
    if let Some(path) = &args.metrics {
        let rows = client.download(&format!("/v1/jobs/{id}/metrics?format=csv")).await?;
        write_atomic(path, curve(&String::from_utf8(rows)?)?.as_bytes())?;
    }
    let Some(best) = checkpoint(&client, &id, "best").await? else {
        // A job that ended before its first evaluation.
        return ended.into_result(&client, &id);
    };
    let best = Checkpoint::from_bytes(&write_verified(&client, &best, out).await?)?;
    if ended == Ended::Succeeded {
        let job = client.get(&format!("/v1/jobs/{id}")).await?;
        outln!("policy {}", job["policy"].as_str().unwrap_or("none"))?;
        local::report(best.config(), &best, out, all_cores())?;
    }
    ended.into_result(&client, &id)
}

/// The rows of a server (name, step, value, at; by name) as those of `--metrics` (step, name, value; by step).
fn curve(csv: &str) -> anyhow::Result<String> {
    let mut rows = Vec::new();
    for line in csv.lines().skip(1) {
        let [name, step, value, _] = line.split(',').collect::<Vec<_>>()[..] else {
            bail!("the server sent {line:?}; expected a metric: name,step,value,at")
        };
        rows.push((step.parse::<u64>().with_context(|| format!("the server sent {line:?}"))?, name, value));
    }
    rows.sort_by_key(|row| row.0);
    let mut text = super::curve::HEADER.to_owned();
    for (step, name, value) in rows {
        let value = if value.is_empty() { "NaN" } else { value };
        writeln!(text, "{step},{name},{value}").expect("a string takes what is written");
    }
    Ok(text)
}

/// Submits a job and follows it until its end, for a command that shows it.
///
/// # Errors
/// The server rejects the job, or the job does not succeed.
pub async fn run_job(client: &Client, body: &Value) -> anyhow::Result<Value> {
    let job = submit(client, body).await?;
    let id = job["id"].as_str().context("the response of the server has no job id")?.to_owned();
    let ended = follow(client, &mut Screen::new(JobView::new(&job), Lines::Error), OnSignal::Leave).await?;
    ended.into_result(client, &id)?;
    Ok(client.get(&format!("/v1/jobs/{id}")).await?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_are_ordered_by_step() {
        let csv = "name,step,value,at\nloss,0,1,x\nloss,80,0.5,x\nq_tot,0,,x\n";
        assert_eq!(curve(csv).unwrap(), "step,name,value\n0,loss,1\n0,q_tot,NaN\n80,loss,0.5\n");
        assert!(curve("name,step,value,at\nloss,1").is_err());
    }
}
