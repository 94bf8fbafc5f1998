//! `qedgix jobs`: submits, finds, follows, changes, compares and exports jobs of a server over REST.

mod chart;
pub mod compare;
mod export;
mod follow;
mod list;
mod logs;
mod reference;
pub mod screen;
pub mod submit;
mod tensorboard;
pub mod view;
pub mod watch;

use anyhow::bail;
use clap::{Args, Subcommand};
use serde_json::{Value, json};

use self::reference::{resolve, resolve_all};
use self::screen::{Lines, Screen};
use self::view::JobView;
use self::watch::OnSignal;
use super::client::{Client, RestArgs};
use super::output::{errln, outln};

pub use self::export::{checkpoint, write_verified};

/// Flags of `jobs`.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  qedgix jobs submit --algorithm qmix --steps 4e5 --name my-policy --label team=a
  qedgix jobs list --state running --label team=a --sort best:eval/mean_aoi
  qedgix jobs watch my-policy                       # ctrl-c leaves; the job goes on
  qedgix jobs logs -f 01a202d1-93be
  qedgix jobs cancel 01a202d1-93be 01a202d1-93bf
  qedgix jobs continue my-policy --steps 2e5        # a new job with the same configuration
  qedgix jobs compare --label sweep=rates --svg rates.svg
  qedgix jobs export my-policy --out my-policy --tensorboard
  qedgix jobs submit --file my-policy/config.json --set training.learning_rate=3e-4

JOB is an id, a beginning of an id that only one job has, or a name that only one job has.

Exit status: 0 done; 1 an error; 2 wrong flags. watch and submit --watch: 0 the job succeeded; 3 it failed; 4 it was cancelled; 130
or 143 ctrl-c or SIGTERM ended the command, and the job goes on.")]
pub struct JobsArgs {
    #[command(subcommand)]
    command: Command,
    #[command(flatten)]
    server: RestArgs,
    /// Print JSON; watch prints a line per event
    #[arg(long, global = true)]
    json: bool,
}

#[derive(Debug, Subcommand)]
#[allow(clippy::large_enum_variant, reason = "one value per process")]
enum Command {
    /// Submit a job and print its id
    Submit(submit::SubmitArgs),
    /// List jobs
    List(list::ListArgs),
    /// Show a job: state, metrics, checkpoints and the whole configuration
    Show {
        /// Id of the job, the beginning of it, or a name
        job: String,
    },
    /// Follow a job until its end: curve, speed and time left
    Watch {
        /// Id of the job, the beginning of it, or a name
        job: String,
    },
    /// Print the output of the workers of a job
    Logs(logs::LogsArgs),
    /// Cancel jobs
    Cancel(Jobs),
    /// Pause jobs; a running job saves a snapshot first
    Pause(Jobs),
    /// Put paused jobs back into the queue
    Resume(Jobs),
    /// Put failed jobs back into the queue; they continue from their snapshots
    Retry(Jobs),
    /// Train a job that has ended further, in a new job: from its snapshot if that is kept, or else from its last weights
    Continue(submit::ContinueArgs),
    /// Delete jobs that have ended, with their metrics, logs and checkpoints
    Delete(Jobs),
    /// Compare jobs: how their configurations differ, best and last values of a metric, means over seeds, and curves as SVG
    Compare(compare::CompareArgs),
    /// Write the configuration, the metrics and the checkpoints of a job into a directory
    Export(export::ExportArgs),
}

/// Jobs to change.
#[derive(Args, Debug)]
struct Jobs {
    /// Ids of jobs, beginnings of ids, or names
    #[arg(required = true, value_name = "JOB")]
    jobs: Vec<String>,
}

/// Runs the command.
///
/// # Errors
/// The server cannot be reached or refuses the request, a job is not found, or a job that is followed does not succeed.
pub async fn run(args: JobsArgs) -> anyhow::Result<()> {
    let client = args.server.client()?;
    let json = args.json;
    match args.command {
        Command::Submit(args) => submit::run(&client, args, json).await,
        Command::List(args) => list::run(&client, args, json).await,
        Command::Show { job } => list::show(&client, &job, json).await,
        Command::Watch { job } => watch_job(&client, &job, json).await,
        Command::Logs(args) => logs::run(&client, args, json).await,
        Command::Cancel(jobs) => change(&client, "cancel", &jobs.jobs, json).await,
        Command::Pause(jobs) => change(&client, "pause", &jobs.jobs, json).await,
        Command::Resume(jobs) => change(&client, "resume", &jobs.jobs, json).await,
        Command::Retry(jobs) => change(&client, "retry", &jobs.jobs, json).await,
        Command::Continue(args) => submit::continue_job(&client, args, json).await,
        Command::Delete(jobs) => change(&client, "delete", &jobs.jobs, json).await,
        Command::Compare(args) => compare::run(&client, args, json).await,
        Command::Export(args) => export::run(&client, args, json).await,
    }
}

async fn watch_job(client: &Client, reference: &str, json: bool) -> anyhow::Result<()> {
    let id = resolve(client, reference).await?;
    let ended = if json {
        watch::print_events(client, &id).await?
    } else {
        let job = client.get(&format!("/v1/jobs/{id}")).await?;
        let mut screen = Screen::new(JobView::new(&job), Lines::Out);
        let ended = watch::follow(client, &mut screen, OnSignal::Leave).await?;
        if screen.was_drawn() {
            outln!("{}", screen.summary())?;
        }
        ended
    };
    ended.into_result(client, &id)
}

/// Applies a verb to jobs. One that is refused does not keep the others from it.
async fn change(client: &Client, verb: &str, references: &[String], json: bool) -> anyhow::Result<()> {
    let ids = resolve_all(client, references).await?;
    let (mut changed, mut refused) = (Vec::new(), 0);
    for id in &ids {
        let path = format!("/v1/jobs/{id}");
        let response = match verb {
            "delete" => client.delete(&path).await.map(|_| json!({"id": id, "state": "deleted"})),
            _ => client.post(&format!("{path}/{verb}"), &Value::Null).await,
        };
        match response {
            Ok(job) if json => changed.push(job),
            Ok(job) => outln!("{id}  {}", list::state(&job))?,
            Err(error) => {
                refused += 1;
                errln!("error: {:#}", anyhow::Error::new(error));
            }
        }
    }
    if json {
        outln!("{:#}", json!({"jobs": changed}))?;
    }
    if refused > 0 {
        bail!("{verb}: {refused} of {} jobs were refused", ids.len());
    }
    Ok(())
}
