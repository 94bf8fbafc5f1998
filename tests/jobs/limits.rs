//! What workers may use of the machine: memory and cores.

use std::sync::Arc;

use qedgix::jobs::LocalProcess;
use serde_json::{Value, json};

use super::harness::{Rest, Server, tiny, with, within};
use super::process::{POLL, PROGRAM, workers};

#[tokio::test]
async fn a_worker_that_uses_too_much_memory_ends_and_its_job_has_failed() {
    let dir = tempfile::tempdir().unwrap();
    let server = Server::start_on(dir.path(), 1, |_| {}, Some(Arc::new(LocalProcess::new(PROGRAM)))).await;
    let id = server.submit(&with(&json!({"memory": 1 << 20}))).await;
    let job = server.reaches(&id, "failed").await;
    assert_eq!((&job["memory"], &job["attempts"], &job["failures"]), (&json!(1 << 20), &json!(1), &json!(1)));
    let reason = job["reason"].as_str().unwrap();
    assert!(reason.contains("limit of the job, 1 MiB"), "{reason}");

    let evaluation = json!({"kind": "evaluate", "evaluation": {"policies": ["sweep"], "episodes": 2}});
    let id = server.submit(&evaluation).await;
    assert_eq!(server.reaches(&id, "succeeded").await["memory"], Value::Null);
    // The default is enough, and grows with the replay.
    let id = server.submit(&tiny()).await;
    let small = server.reaches(&id, "succeeded").await["memory"].as_u64().unwrap();
    assert!(small >= 512 << 20, "{small}");
}

/// The cores that the worker of a running job may use, as Linux lists them.
async fn cores(rest: &Rest, id: &str) -> String {
    rest.reaches(id, "running").await;
    within(async {
        loop {
            let status = workers(id).first().and_then(|pid| std::fs::read_to_string(format!("/proc/{pid}/status")).ok());
            let list = status.iter().flat_map(|status| status.lines()).find_map(|line| line.strip_prefix("Cpus_allowed_list:"));
            // The worker confines itself as its first act.
            if let Some(list) = list.map(str::trim).filter(|list| !list.contains(['-', ','])) {
                return list.to_owned();
            }
            tokio::time::sleep(POLL).await;
        }
    })
    .await
}

#[tokio::test]
async fn workers_run_on_as_many_cores_as_their_job_has_threads() {
    if std::thread::available_parallelism().unwrap().get() < 2 {
        println!("skipped: this machine has one core");
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let server = Server::start_on(dir.path(), 2, |_| {}, Some(Arc::new(LocalProcess::new(PROGRAM)))).await;
    let mut endless = tiny();
    endless["training"]["steps"] = json!(1_000_000_000);
    let [first, second] = [server.submit(&endless).await, server.submit(&endless).await];
    let used = [cores(&server, &first).await, cores(&server, &second).await];
    assert_ne!(used[0], used[1]);
    // The next worker gets the core that is free again.
    server.post(&format!("/v1/jobs/{second}/cancel")).await;
    server.reaches(&second, "cancelled").await;
    let third = server.submit(&endless).await;
    assert_eq!(cores(&server, &third).await, used[1]);
    for id in [first, third] {
        server.post(&format!("/v1/jobs/{id}/cancel")).await;
        server.reaches(&id, "cancelled").await;
    }
}
