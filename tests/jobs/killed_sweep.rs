//! A sweep whose server is killed while its jobs run.

use std::collections::BTreeMap;
use std::process::Command;

use serde_json::{Value, json};

use super::harness::{Rest, with, within};
use super::process::rest::Rows;
use super::process::{POLL, PROGRAM, Process, serve};

/// Twelve short trainings: two values, six seeds.
fn sweep() -> Value {
    with(&json!({"kind": "sweep", "name": "twelve", "sweep": {"grid": {"training.gamma": [0.5, 0.9]}, "seeds": 6}}))
}

async fn start(data: &std::path::Path) -> (Process, Rest) {
    let mut command = serve(data);
    command.args(["--cpu-budget", "2", "--snapshot-every", "0.01"]);
    let process = Process::start(command).await;
    let rest = Rest::new(format!("http://{}", process.http));
    (process, rest)
}

/// Waits until so many jobs of the sweep have succeeded and another one runs.
async fn done(rest: &Rest, sweep: &str, jobs: u64) {
    within(async {
        loop {
            let states = rest.get(&format!("/v1/jobs/{sweep}/result")).await["states"].clone();
            if states["succeeded"].as_u64() >= Some(jobs) && states["running"].is_number() {
                return;
            }
            tokio::time::sleep(POLL).await;
        }
    })
    .await;
}

/// The numbers of a sweep: of each job the metrics and the digests of its checkpoints, and the means over seeds.
type Numbers = (Vec<(Rows, BTreeMap<String, String>)>, Vec<Value>);

async fn numbers(rest: &Rest, sweep: &str) -> Numbers {
    let jobs = rest.get(&format!("/v1/jobs?parent={sweep}&sort=created")).await["jobs"].as_array().unwrap().clone();
    let mut all = Vec::new();
    for job in &jobs {
        let id = job["id"].as_str().unwrap();
        all.push((rest.rows(id).await, rest.digests(id).await));
    }
    let result = rest.get(&format!("/v1/jobs/{sweep}/result")).await;
    (all, result["points"].as_array().unwrap().iter().map(|point| point["metrics"].clone()).collect())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_sweep_whose_server_is_killed_twice_has_the_numbers_of_one_left_alone() {
    let mut all = Vec::new();
    for kills in [&[][..], &[2, 6]] {
        let dir = tempfile::tempdir().unwrap();
        let (mut process, mut rest) = start(dir.path()).await;
        let id = rest.submit(&sweep()).await;
        for jobs in kills {
            done(&rest, &id, *jobs).await;
            process.kill();
            (process, rest) = start(dir.path()).await;
        }
        let job = within(async {
            loop {
                let job = rest.get(&format!("/v1/jobs/{id}")).await;
                if job["state"] != "running" {
                    return job;
                }
                tokio::time::sleep(POLL).await;
            }
        })
        .await;
        assert_eq!(job["state"], "succeeded", "{job}");
        let found = numbers(&rest, &id).await;
        assert!(found.0.len() == 12 && found.0.iter().all(|(rows, digests)| rows.len() > 4 && digests.len() == 2));
        all.push(found);
        let mut compare = Command::new(PROGRAM);
        compare.args(["jobs", "compare", "--json", "--parent", &id, "--server", &process.http]).current_dir(dir.path());
        let output = compare.output().unwrap();
        let compared: Value = serde_json::from_slice(&output.stdout).unwrap();
        let groups = compared["groups"].as_array().unwrap();
        assert_eq!(groups.len(), 2, "{compared}");
    }
    assert!(all[0] == all[1]);
}
