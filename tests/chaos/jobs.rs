//! The jobs of the test, and what each of them yields when nothing disturbs it.

use std::collections::BTreeMap;
use std::time::Duration;

use serde_json::{Value, json};

use crate::process::rest::{Rest, Rows};
use crate::process::{Process, serve};

/// States that a job does not leave.
pub const ENDED: [&str; 3] = ["succeeded", "cancelled", "failed"];

/// Threads of job number `number`.
pub fn threads(number: usize) -> usize {
    if number % 5 == 4 { 2 } else { 1 }
}

/// Job number `number`, of `steps` environment steps. No two jobs yield the same numbers.
pub fn spec(number: usize, steps: u64) -> Value {
    let algorithm = ["vdn", "qmix"][number % 2];
    json!({
        "name": format!("chaos-{number}"),
        "algorithm": algorithm,
        "seed": number + 1,
        "threads": threads(number),
        "environment": {"slots": 15 + 5 * (number % 3), "uavs": 2, "users": 3 + number % 2},
        "training": {"steps": steps, "envs": 4, "batch": 16, "buffer": 200, "eval_every": steps / 8, "eval_episodes": 8},
    })
}

/// What a job has yielded.
#[derive(Debug, PartialEq)]
pub struct Yield {
    pub rows: Rows,
    /// SHA-256 of the checkpoints, by kind.
    pub checkpoints: BTreeMap<String, String>,
    /// SHA-256 of the version that it published, if it did.
    pub published: Option<String>,
}

impl Yield {
    pub async fn of(rest: &Rest, id: &str) -> Self {
        let job = rest.get(&format!("/v1/jobs/{id}")).await;
        let published = match job["policy"].as_str() {
            Some(policy) => {
                let policy = rest.get(&format!("/v1/policies/{policy}")).await;
                Some(policy["ref"]["digest"].as_str().expect("a version has a digest").to_owned())
            }
            None => None,
        };
        Self { rows: rest.rows(id).await, checkpoints: rest.digests(id).await, published }
    }

    /// How this differs from an undisturbed run, in words; empty if it does not.
    pub fn differs(&self, undisturbed: &Self) -> Vec<String> {
        let mut all = row_differences(&self.rows, &undisturbed.rows);
        all.extend(undisturbed.rows.keys().filter(|key| !self.rows.contains_key(*key)).map(|key| format!("no row {key:?}")));
        if self.checkpoints != undisturbed.checkpoints {
            all.push(format!("checkpoints {:?} instead of {:?}", self.checkpoints, undisturbed.checkpoints));
        }
        if self.published != undisturbed.published {
            all.push(format!("published {:?} instead of {:?}", self.published, undisturbed.published));
        }
        all
    }
}

/// Rows that an undisturbed run does not have, or has with another value.
pub fn row_differences(found: &Rows, undisturbed: &Rows) -> Vec<String> {
    let wrong = found.iter().filter(|(key, value)| undisturbed.get(key) != Some(value));
    wrong.map(|(key, value)| format!("row {key:?} is {value:?} instead of {:?}", undisturbed.get(key))).collect()
}

/// Runs the jobs on a server of their own, which nothing disturbs.
pub async fn undisturbed(specs: &[Value], budget: usize) -> Vec<Yield> {
    let dir = tempfile::tempdir().unwrap();
    let mut command = serve(dir.path());
    command.args(["--cpu-budget", &budget.to_string()]).env("QEDGIX_LOG", "warn");
    let server = Process::start(command).await;
    let rest = Rest::new(format!("http://{}", server.http));
    let mut ids = Vec::new();
    for spec in specs {
        ids.push(rest.submit(spec).await);
    }
    let mut yields = Vec::new();
    for id in &ids {
        let state = loop {
            let state = rest.state(id).await;
            if ENDED.contains(&state.as_str()) {
                break state;
            }
            tokio::time::sleep(Duration::from_millis(50)).await;
        };
        assert_eq!(state, "succeeded", "job {id} succeeds when nothing disturbs it");
        yields.push(Yield::of(&rest, id).await);
    }
    yields
}
