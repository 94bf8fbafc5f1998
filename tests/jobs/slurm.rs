//! Commands of Slurm that never return: they are given up after a time limit, the reason is shown, and jobs go on when Slurm answers again.
//! The commands are shell scripts of this test; the workers that they start are real.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use qedgix::jobs::{Slurm, SlurmConfig, SlurmTimes};
use serde_json::Value;

use super::harness::*;

/// The commands. `hang.COMMAND` makes a command hang, `hold` keeps jobs pending, `unlisted` hides them from squeue.
const COMMANDS: [(&str, &str); 4] = [
    (
        "sbatch",
        r#"
for argument in "$@"; do
    case $argument in --job-name=*) name=${argument#*=} ;; --output=*) output=${argument#*=} ;; esac
done
mkdir -p "jobs/$name"
cat >"jobs/$name/script"
(
    while [ -e hold ]; do sleep 0.02; done
    sh "jobs/$name/script" &
    echo $! >"jobs/$name/pid"
    wait
    : >"jobs/$name/done"
) </dev/null >"$output" 2>&1 &
echo 1
"#,
    ),
    (
        "squeue",
        r#"
separator=
printf '{"jobs": ['
for job in jobs/*; do
    [ -d "$job" ] && ! [ -e unlisted ] || continue
    state=PENDING
    [ -e "$job/pid" ] && state=RUNNING
    [ -e "$job/done" ] && state=COMPLETED
    printf '%s{"job_id": 1, "name": "%s", "job_state": ["%s"]}' "$separator" "${job#jobs/}" "$state"
    separator=,
done
printf ']}'
"#,
    ),
    ("sacct", r#"printf '{"jobs": []}'"#),
    (
        "scancel",
        r#"
for argument in "$@"; do
    case $argument in --name=*) name=${argument#*=} ;; esac
done
[ -e "jobs/$name/pid" ] && kill -9 "$(cat "jobs/$name/pid")"
exit 0
"#,
    ),
];

/// A server with a cluster of this test.
struct Bed {
    server: Server,
    cluster: PathBuf,
    _dir: tempfile::TempDir,
}

impl Bed {
    /// With a CPU budget of one thread. `marks` are set from the begin.
    async fn start(marks: &[&str]) -> Self {
        let dir = tempfile::tempdir().unwrap();
        let [data, cluster] = ["data", "cluster"].map(|name| dir.path().join(name));
        fs::create_dir_all(cluster.join("jobs")).unwrap();
        for (name, script) in COMMANDS {
            let first =
                format!("#!/bin/sh\ncd '{}'\necho >>called.{name}\n[ -e hang.{name} ] && exec sleep 3600\n", cluster.display());
            let path = cluster.join(name);
            fs::write(&path, first + script).unwrap();
            fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).unwrap();
        }
        let milliseconds = Duration::from_millis;
        let times = SlurmTimes {
            command: milliseconds(2000),
            list: milliseconds(20),
            list_after_error: milliseconds(20),
            sacct: milliseconds(20),
        };
        let config = SlurmConfig { commands: Some(cluster.clone()), times, ..SlurmConfig::default() };
        let slurm = Slurm::new(config, env!("CARGO_BIN_EXE_qedgix").into(), dir.path().join("shared")).unwrap();
        let server = Server::start_on(&data, 1, |_| {}, Some(Arc::new(slurm))).await;
        let bed = Self { server, cluster, _dir: dir };
        marks.iter().for_each(|mark| bed.mark(mark));
        bed
    }

    fn mark(&self, name: &str) {
        fs::write(self.cluster.join(name), "").unwrap();
    }

    fn unmark(&self, name: &str) {
        fs::remove_file(self.cluster.join(name)).unwrap();
    }

    /// How often a command was called.
    fn calls(&self, command: &str) -> usize {
        fs::read_to_string(self.cluster.join(format!("called.{command}"))).unwrap_or_default().lines().count()
    }

    async fn submit(&self) -> String {
        self.server.submit(&tiny()).await
    }

    /// Waits until the job is as wanted.
    async fn reaches(&self, id: &str, wanted: impl Fn(&Value) -> bool) -> Value {
        within(async {
            loop {
                let job = self.server.get(&format!("/v1/jobs/{id}")).await;
                if wanted(&job) {
                    return job;
                }
                tokio::time::sleep(Duration::from_millis(20)).await;
            }
        })
        .await
    }

    /// Waits until the reason for which the job waits names `word`.
    async fn waits_for(&self, id: &str, word: &str) {
        let job = self.reaches(id, |job| job["waiting"]["reason"].as_str().is_some_and(|reason| reason.contains(word))).await;
        assert_eq!((&job["state"], &job["attempts"]), (&"queued".into(), &0.into()), "{job}");
    }

    /// Waits until the job has succeeded, with its first attempt.
    async fn succeeds(&self, id: &str) {
        let job = self.reaches(id, |job| !["queued", "running"].contains(&job["state"].as_str().unwrap())).await;
        assert_eq!((&job["state"], &job["attempts"]), (&"succeeded".into(), &1.into()), "{job}");
    }
}

#[tokio::test]
async fn a_submission_that_hangs_is_repeated() {
    let bed = Bed::start(&["hang.sbatch"]).await;
    let job = bed.submit().await;
    bed.waits_for(&job, "sbatch").await;
    bed.unmark("hang.sbatch");
    bed.succeeds(&job).await;
    assert!(bed.calls("sbatch") >= 2);
}

#[tokio::test]
async fn lists_that_hang_end_no_job() {
    let bed = Bed::start(&["hang.squeue", "hold"]).await;
    let job = bed.submit().await;
    bed.waits_for(&job, "squeue").await;
    bed.unmark("hang.squeue");
    bed.waits_for(&job, "PENDING").await;
    // The list hangs again while the worker runs and ends.
    bed.mark("hang.squeue");
    bed.unmark("hold");
    bed.succeeds(&job).await;
    // The threads of the job are free when Slurm says that its worker has ended.
    let next = bed.submit().await;
    bed.unmark("hang.squeue");
    bed.succeeds(&next).await;
}

#[tokio::test]
async fn an_accounting_that_hangs_holds_up_no_job() {
    let bed = Bed::start(&["hang.sacct", "unlisted", "hold"]).await;
    let job = bed.submit().await;
    within(async {
        while bed.calls("sacct") < 2 {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    })
    .await;
    let waits = bed.reaches(&job, |job| job["waiting"]["reason"].is_string()).await;
    assert_eq!((&waits["state"], &waits["attempts"]), (&"queued".into(), &0.into()), "{waits}");
    bed.unmark("hold");
    bed.succeeds(&job).await;
    bed.unmark("unlisted");
    let next = bed.submit().await;
    bed.succeeds(&next).await;
}
