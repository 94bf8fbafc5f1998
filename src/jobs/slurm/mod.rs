//! Runs workers as jobs of a Slurm cluster.
//!
//! A launch has a name that is never used again, and everything is found by that name: Slurm uses numbers of jobs again. Workers
//! outlive the server, and a server that starts again finds them by the names in its database.

mod command;
mod follower;
mod listing;
mod submission;

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use futures::FutureExt;
use futures::future::BoxFuture;
use tokio::sync::Mutex;
use tokio::time::Instant;

use self::command::{CommandError, Commands};
use self::follower::{Follower, Seen, Verdict};
use self::listing::{Phase, SACCT_FORMAT, SQUEUE_FORMAT, SlurmJob};
pub use self::submission::SlurmConfig;
use self::submission::{LaunchFiles, arguments, script};
use super::executor::{Executor, Launch, LogTail, WorkerExit};
use super::worker::Assignment;
use crate::files;

/// How often Slurm is asked, and how long it may take to answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SlurmTimes {
    /// Time limit of a command of Slurm. `sbatch` waits for a busy controller.
    pub command: Duration,
    /// Time between two lists of all jobs.
    pub list: Duration,
    /// That time while Slurm does not answer.
    pub list_after_error: Duration,
    /// Time between two questions to the accounting about a job that is not listed.
    pub sacct: Duration,
}

impl Default for SlurmTimes {
    fn default() -> Self {
        let [command, list, list_after_error, sacct] = [60, 2, 10, 30].map(Duration::from_secs);
        Self { command, list, list_after_error, sacct }
    }
}

/// Time between two reads of the output of a worker.
const OUTPUT_INTERVAL: Duration = Duration::from_millis(500);
/// Time between two tries to cancel a job: the first, which doubles, and the longest.
const KILL_DELAY: [Duration; 2] = [Duration::from_millis(250), Duration::from_secs(30)];

/// Starts `PROGRAM worker` as a Slurm job for each attempt; cheap to clone.
#[derive(Clone, Debug)]
pub struct Slurm(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    config: SlurmConfig,
    program: PathBuf,
    directory: PathBuf,
    commands: Commands,
    /// The last list of all jobs, and when Slurm was asked for it.
    listed: Mutex<Option<(Instant, Listing)>>,
}

/// All jobs of this user, or why they are not known.
type Listing = Arc<Result<Vec<SlurmJob>, String>>;

impl Slurm {
    /// Starts workers from `program`, which has the same path on the nodes. `directory` is shared with them; it is created if it is
    /// missing.
    ///
    /// # Errors
    /// [`io::Error`] when the directory cannot be created.
    pub fn new(config: SlurmConfig, program: PathBuf, directory: PathBuf) -> io::Result<Self> {
        files::create_private_dir(&directory)?;
        let directory = std::path::absolute(directory)?;
        let commands = Commands { directory: config.commands.clone(), timeout: config.times.command };
        Ok(Self(Arc::new(Inner { config, program, directory, commands, listed: Mutex::default() })))
    }

    /// Submits a worker.
    async fn submit(&self, launch: &Launch, files: &LaunchFiles) -> io::Result<()> {
        let Inner { config, program, commands, .. } = &*self.0;
        let assignment = Assignment {
            server: launch.server.clone(),
            job: launch.lease.job_id.to_string(),
            attempt: launch.lease.attempt.to_string(),
            token: launch.token.clone(),
        };
        files::write_private(&files.assignment, assignment.to_json().as_bytes())?;
        let arguments = arguments(config, &launch.name, launch.resources, &files.output);
        let submitted = commands.run("sbatch", &arguments, &script(program, &files.assignment)).await;
        let number = submitted.inspect_err(|error| {
            // After a timeout Slurm may have the job. Its worker must find nothing to do.
            files.remove();
            if matches!(error, CommandError::Timeout { .. }) {
                let (slurm, name) = (self.clone(), launch.name.clone());
                tokio::spawn(async move { slurm.cancel(&name).await });
            }
        });
        // `12`, or `12;cluster`.
        let number = String::from_utf8_lossy(&number.map_err(io::Error::other)?).trim().to_owned();
        tracing::info!(slurm_job = number, name = launch.name, "submitted a worker to Slurm");
        launch.status.set_waiting(Some(format!("Slurm job {number} is submitted")));
        Ok(())
    }

    /// Follows a worker until it has ended.
    async fn follow(self, launch: Launch, files: LaunchFiles) -> WorkerExit {
        let begin = Instant::now();
        let mut follower = Follower::new(Duration::ZERO, !launch.started_before);
        let mut output = Output { path: files.output.clone(), read: 0 };
        let mut accounting = Accounting::default();
        let mut called_at = None;
        let exit = loop {
            if launch.status.began().is_some() {
                called_at.get_or_insert_with(Instant::now);
            }
            let (seen, asked_at) = tokio::select! {
                seen = self.find(&launch.name, &mut accounting) => seen,
                () = launch.kill.cancelled() => break self.kill(&launch.name).await,
            };
            match follower.observe(
                begin.elapsed(),
                &seen,
                launch.status.began().is_some(),
                called_at.is_some_and(|at| at < asked_at),
            ) {
                Verdict::Waiting(reason) => launch.status.set_waiting(Some(reason)),
                Verdict::Running => launch.status.set_waiting(None),
                Verdict::Ended(exit) => {
                    if exit.by_host {
                        self.cancel(&launch.name).await;
                    }
                    break exit;
                }
            }
            let next_list = Instant::now() + self.0.config.times.list;
            while Instant::now() < next_list && !launch.kill.is_cancelled() {
                output.copy(&launch.log).await;
                let pause = OUTPUT_INTERVAL.min(self.0.config.times.list);
                let _ = tokio::time::timeout(pause, launch.kill.cancelled()).await;
            }
        };
        launch.status.set_waiting(None);
        output.copy(&launch.log).await;
        files.remove();
        exit
    }

    /// What Slurm says about the job `name`, and when it was asked.
    async fn find(&self, name: &str, accounting: &mut Accounting) -> (Seen, Instant) {
        let (asked_at, listing) = self.list().await;
        let seen = match &*listing {
            Err(reason) => Seen::Unknown(reason.clone()),
            Ok(jobs) => match newest(jobs, name) {
                Some(job) => Seen::Listed(job.clone()),
                None => self.find_ended(name, accounting).await.map_or(Seen::Missing, Seen::Listed),
            },
        };
        (seen, asked_at)
    }

    /// The job `name` in the accounting, which is asked rarely, and may be missing or broken.
    async fn find_ended(&self, name: &str, accounting: &mut Accounting) -> Option<SlurmJob> {
        if accounting.asked.is_some_and(|at| at.elapsed() < self.0.config.times.sacct) {
            return None;
        }
        accounting.asked = Some(Instant::now());
        let of_name = ["--allocations".to_owned(), format!("--name={name}")];
        let json = [&of_name[..], &["--json".to_owned()]].concat();
        let jobs = match self.0.commands.run("sacct", &json, "").await.map(|output| listing::from_json(&output)) {
            Ok(Some(jobs)) => jobs,
            // A cluster may have no accounting.
            Err(error @ CommandError::Start(..)) => {
                tracing::debug!(%error, "the accounting of Slurm cannot be asked");
                return None;
            }
            Err(error @ CommandError::Timeout { .. }) => {
                tracing::warn!(name, %error, "the accounting of Slurm does not answer; trying again");
                return None;
            }
            _ => {
                let columns = ["--noheader", "--parsable2", "--format", SACCT_FORMAT].map(str::to_owned);
                let output = self.0.commands.run("sacct", &[&of_name[..], &columns].concat(), "").await.ok()?;
                listing::from_sacct_text(&String::from_utf8_lossy(&output))
            }
        };
        newest(&jobs, name).cloned()
    }

    /// All jobs of this user, at most as old as [`SlurmTimes::list`]. Followers share one command.
    async fn list(&self) -> (Instant, Listing) {
        let mut listed = self.0.listed.lock().await;
        let SlurmTimes { list, list_after_error, .. } = self.0.config.times;
        if let Some((at, listing)) = &*listed
            && at.elapsed() < if listing.is_ok() { list } else { list_after_error }
        {
            return (*at, listing.clone());
        }
        let asked_at = Instant::now();
        let listing = Arc::new(self.ask().await);
        if let Err(reason) = &*listing {
            tracing::warn!(reason, "the jobs of Slurm cannot be listed; trying again");
        }
        *listed = Some((asked_at, listing.clone()));
        (asked_at, listing)
    }

    /// Asks Slurm for all jobs of this user, also those that ended a short time ago.
    async fn ask(&self) -> Result<Vec<SlurmJob>, String> {
        let all = [format!("--user={}", rustix::process::getuid().as_raw()), "--states=all".into()];
        let json = [&all[..], &["--json".to_owned()]].concat();
        match self.0.commands.run("squeue", &json, "").await {
            Ok(output) => {
                if let Some(jobs) = listing::from_json(&output) {
                    return Ok(jobs);
                }
            }
            Err(error @ (CommandError::Start(..) | CommandError::Timeout { .. })) => return Err(error.to_string()),
            // This version may not know the flag.
            Err(CommandError::Failed(..)) => {}
        }
        let columns = ["--noheader", "--format", SQUEUE_FORMAT].map(str::to_owned);
        let output =
            self.0.commands.run("squeue", &[&all[..], &columns].concat(), "").await.map_err(|error| error.to_string())?;
        Ok(listing::from_squeue_text(&String::from_utf8_lossy(&output)))
    }

    /// Asks Slurm once to end the job `name` at once. Returns whether Slurm has taken it.
    async fn cancel(&self, name: &str) -> bool {
        let by_name = format!("--name={name}");
        // Without a signal, Slurm gives the worker time to end. Jobs that do not run yet take no signal.
        let signal = ["--signal=KILL".to_owned(), "--full".into(), by_name.clone()];
        let _ = self.0.commands.run("scancel", &signal, "").await;
        match self.0.commands.run("scancel", &[by_name], "").await {
            Ok(_) => true,
            Err(error) => {
                tracing::warn!(name, %error, "a job of Slurm cannot be cancelled; trying again");
                false
            }
        }
    }

    /// Ends the job `name`, and returns when Slurm says that it has ended.
    async fn kill(&self, name: &str) -> WorkerExit {
        let [mut delay, longest] = KILL_DELAY;
        loop {
            if self.cancel(name).await {
                // The shared list may be older than the cancel.
                let ended = self
                    .ask()
                    .await
                    .is_ok_and(|jobs| newest(&jobs, name).is_none_or(|job| matches!(job.phase(), Phase::Ended(_))));
                if ended {
                    return WorkerExit::of_worker("cancelled in Slurm");
                }
            }
            tokio::time::sleep(delay).await;
            delay = (delay * 2).min(longest);
        }
    }
}

impl Executor for Slurm {
    fn start(&self, launch: Launch) -> BoxFuture<'_, io::Result<BoxFuture<'static, WorkerExit>>> {
        async move {
            let files = LaunchFiles::new(&self.0.directory, &launch.name);
            if !launch.started_before {
                self.submit(&launch, &files).await?;
            }
            Ok(self.clone().follow(launch, files).boxed())
        }
        .boxed()
    }

    fn is_cluster(&self) -> bool {
        true
    }
}

/// The newest job with this name. Lists may have those of earlier submissions.
fn newest<'a>(jobs: &'a [SlurmJob], name: &str) -> Option<&'a SlurmJob> {
    jobs.iter().filter(|job| job.name == name).max_by_key(|job| job.id.parse::<u64>().unwrap_or_default())
}

/// When the accounting was asked about a job.
#[derive(Debug, Default)]
struct Accounting {
    asked: Option<Instant>,
}

/// The file with the output of a worker, which Slurm writes.
#[derive(Debug)]
struct Output {
    path: PathBuf,
    /// Bytes that have been read.
    read: u64,
}

impl Output {
    /// Copies new output to the log of the worker, at most as much as the log keeps.
    async fn copy(&mut self, log: &LogTail) {
        let (path, from) = (self.path.clone(), self.read);
        // The file appears when the worker starts, and may be on a file system that does not answer.
        let read = tokio::task::spawn_blocking(move || read_after(&path, from)).await;
        if let Ok(Ok((bytes, end))) = read
            && !bytes.is_empty()
        {
            self.read = end;
            log.push(&bytes);
        }
    }
}

/// The last bytes of a file after the first `from`, at most as many as a log keeps, and the number of bytes up to their end.
fn read_after(path: &Path, from: u64) -> io::Result<(Vec<u8>, u64)> {
    let mut file = File::open(path)?;
    let from = from.max(file.metadata()?.len().saturating_sub(LogTail::LIMIT as u64));
    file.seek(SeekFrom::Start(from))?;
    let mut bytes = Vec::new();
    file.take(LogTail::LIMIT as u64).read_to_end(&mut bytes)?;
    let end = from + bytes.len() as u64;
    Ok((bytes, end))
}
