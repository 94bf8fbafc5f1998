//! The faults: what each of them does to the server, its workers, its files and its jobs.

use std::process::Command;
use std::time::Duration;

use futures::future::join_all;
use rand::RngExt;
use rand::seq::{IndexedRandom, SliceRandom};
use reqwest::Method;
use sqlx::{Connection, SqliteConnection};

use super::{Chaos, LEASE};
use crate::process::{Process, signal};

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    KillWorker,
    KillServer,
    StopServer,
    PauseWorker,
    PauseServer,
    FullDisk,
    FileDescriptors,
    DatabaseLock,
    CancelStorm,
    PauseStorm,
    ClockStep,
}

impl Fault {
    pub const ALL: [Self; 11] = [
        Self::KillWorker,
        Self::KillServer,
        Self::StopServer,
        Self::PauseWorker,
        Self::PauseServer,
        Self::FullDisk,
        Self::FileDescriptors,
        Self::DatabaseLock,
        Self::CancelStorm,
        Self::PauseStorm,
        Self::ClockStep,
    ];

    /// Faults of a moment, which may also happen while another fault lasts.
    const MOMENTS: [Self; 4] = [Self::KillWorker, Self::KillServer, Self::CancelStorm, Self::PauseStorm];
}

/// Requests that a storm sends at once for a job.
const STORM: usize = 12;

impl Chaos {
    /// Injects a fault and ends it.
    pub async fn inject(&mut self, fault: Fault) {
        match fault {
            Fault::KillWorker => self.kill_worker().await,
            Fault::KillServer => {
                self.kill_server();
                self.doze(0.0, 1.0).await;
                self.start_server(None).await;
            }
            Fault::StopServer => self.stop_server().await,
            Fault::PauseWorker => self.pause_worker().await,
            Fault::PauseServer => self.pause_server().await,
            Fault::FullDisk => self.fill_disk().await,
            Fault::FileDescriptors => self.exhaust_descriptors().await,
            Fault::DatabaseLock => self.lock_database().await,
            Fault::CancelStorm => self.cancel_storm().await,
            Fault::PauseStorm => self.pause_storm().await,
            Fault::ClockStep => self.step_clock().await,
        }
    }

    async fn doze(&mut self, from: f64, to: f64) {
        let seconds = self.rng.random_range(from..to);
        tokio::time::sleep(Duration::from_secs_f64(seconds)).await;
    }

    /// Lets a fault last. Sometimes another one happens meanwhile.
    async fn last(&mut self, seconds: f64) {
        tokio::time::sleep(Duration::from_secs_f64(seconds / 2.0)).await;
        if self.rng.random_range(0..4) == 0 {
            let also = *Fault::MOMENTS.choose(&mut self.rng).unwrap();
            self.say(&format!("  meanwhile {also:?}"));
            match also {
                Fault::KillWorker => self.kill_worker().await,
                // It starts again when the fault has ended.
                Fault::KillServer => self.kill_server(),
                // Nobody waits for an answer now.
                _ => self.storm(Method::POST, &["pause", "resume"], Duration::from_secs(1)).await,
            }
        }
        tokio::time::sleep(Duration::from_secs_f64(seconds / 2.0)).await;
    }

    async fn kill_worker(&mut self) {
        let Some(worker) = self.some_worker().await else { return };
        signal("KILL", worker.pid);
    }

    fn kill_server(&mut self) {
        if let Some(mut server) = self.server.take() {
            server.kill();
        }
    }

    async fn stop_server(&mut self) {
        let Some(mut server) = self.server.take() else { return };
        let status = server.terminate().await;
        if !status.success() {
            self.violation(format!("the server ended with {status} on SIGTERM"));
        }
        self.start_server(None).await;
    }

    /// Stops a worker for longer than its lease.
    async fn pause_worker(&mut self) {
        let Some(worker) = self.some_worker().await else { return };
        signal("STOP", worker.pid);
        let seconds = LEASE.as_secs_f64() + self.rng.random_range(0.3..1.5);
        self.last(seconds).await;
        // The server has killed it by now.
        signal("CONT", worker.pid);
        self.start_server(None).await;
    }

    /// Stops the server for longer than a lease, now and then for longer than its workers wait for it.
    async fn pause_server(&mut self) {
        let Some(pid) = self.server.as_ref().map(Process::pid) else { return };
        signal("STOP", pid);
        let long = self.full && self.rng.random_range(0..4) == 0;
        let seconds = if long { 13.0 } else { LEASE.as_secs_f64() + self.rng.random_range(0.3..1.5) };
        self.say(&format!("  for {seconds:.1} s"));
        self.last(seconds).await;
        signal("CONT", pid);
        self.start_server(None).await;
    }

    async fn fill_disk(&mut self) {
        if !self.disk.can_be_filled() {
            return self.skip("filling the disk: this user cannot mount one");
        }
        self.disk.fill();
        for _ in 0..self.rng.random_range(1..4) {
            self.last(1.0).await;
            // Space that a checkpoint of the database has given back.
            self.disk.fill();
        }
        self.disk.free();
        self.start_server(None).await;
    }

    /// The server cannot open one more file.
    async fn exhaust_descriptors(&mut self) {
        let Some(pid) = self.server.as_ref().map(Process::pid) else { return };
        let open = std::fs::read_dir(format!("/proc/{pid}/fd")).map_or(0, Iterator::count);
        let limits = std::fs::read_to_string(format!("/proc/{pid}/limits")).unwrap_or_default();
        let soft = limits.lines().find_map(|line| line.strip_prefix("Max open files")?.split_whitespace().next()?.parse().ok());
        let limit = |files: usize| {
            let files = format!("--nofile={files}:");
            let status = Command::new("prlimit").args([format!("--pid={pid}"), files]).status();
            status.is_ok_and(|status| status.success())
        };
        let Some(soft) = soft.filter(|_| limit(open)) else { return self.skip("file descriptors: prlimit does not work here") };
        // The worker that replaces the killed one needs descriptors.
        self.kill_worker().await;
        let seconds = self.rng.random_range(1.0..4.0);
        self.last(seconds).await;
        limit(soft);
        self.start_server(None).await;
    }

    /// Another process writes to the database, now and then for longer than the server waits for it.
    async fn lock_database(&mut self) {
        let file = self.disk.data_dir().join(qedgix::store::FILE);
        let mut other = SqliteConnection::connect(&format!("sqlite://{}", file.display())).await.unwrap();
        if let Err(e) = sqlx::query("BEGIN IMMEDIATE").execute(&mut other).await {
            return self.say(&format!("  the database could not be locked: {e}"));
        }
        let long = self.full && self.rng.random_range(0..4) == 0;
        let seconds = if long { 13.0 } else { self.rng.random_range(0.5..4.0) };
        self.say(&format!("  for {seconds:.1} s"));
        self.last(seconds).await;
        sqlx::query("ROLLBACK").execute(&mut other).await.unwrap();
        // Not its last connection as long as the server lives.
        other.close().await.unwrap();
        self.start_server(None).await;
    }

    /// Cancels one of the jobs that may be cancelled, while others want it to pause and to go on.
    async fn cancel_storm(&mut self) {
        let candidates = self.unfinished().await;
        let Some(victim) = candidates.into_iter().find(|&number| number % 5 == 0 && !self.jobs[number].cancelled) else {
            return self.pause_storm().await;
        };
        let path = |verb: &str| format!("/v1/jobs/{}/{verb}", self.jobs[victim].id);
        let verbs = ["cancel", "pause", "resume", "cancel", "resume", "pause", "cancel", "resume"];
        join_all(verbs.map(|verb| self.ask(Method::POST, path(verb), Duration::from_secs(5)))).await;
        let cancel = path("cancel");
        let answer = self.insist(Method::POST, &cancel, |status| status == 200 || status == 409).await;
        self.say(&format!("  job {victim}: {answer}"));
        // Refused: it had ended before, cancelled by the storm or by itself.
        let job = self.read(victim).await;
        self.jobs[victim].cancelled = answer == 200 || job["state"] == "cancelled";
    }

    async fn pause_storm(&mut self) {
        self.storm(Method::POST, &["pause", "resume"], Duration::from_secs(5)).await;
    }

    /// Sends many of these requests at once for some of the jobs. Whatever they lead to, paused jobs are resumed at the end.
    async fn storm(&mut self, method: Method, verbs: &[&str], timeout: Duration) {
        let mut jobs: Vec<usize> = (0..self.jobs.len()).filter(|&number| !self.jobs[number].ended).collect();
        jobs.shuffle(&mut self.rng);
        jobs.truncate(2);
        let mut paths = Vec::new();
        for number in jobs {
            for _ in 0..STORM {
                let verb = verbs.choose(&mut self.rng).unwrap();
                paths.push(format!("/v1/jobs/{}/{verb}", self.jobs[number].id));
            }
        }
        join_all(paths.into_iter().map(|path| self.ask(method.clone(), path, timeout))).await;
    }

    /// The server starts again with another monotonic time. Only a virtual machine could move the wall time of one process.
    async fn step_clock(&mut self) {
        let usable = Command::new("unshare").args(["--time", "true"]).status().is_ok_and(|status| status.success());
        if !usable {
            return self.skip("clock steps: this user cannot create time namespaces");
        }
        self.kill_server();
        let uptime = std::fs::read_to_string("/proc/uptime").unwrap();
        let uptime: f64 = uptime.split(' ').next().unwrap().parse().unwrap();
        let back = self.rng.random_bool(0.5);
        let step = if back { -self.rng.random_range(0.0..uptime / 2.0) } else { self.rng.random_range(0.0..1e6) } as i64;
        self.say(&format!("  by {step} s"));
        self.start_server(Some(step)).await;
    }
}
