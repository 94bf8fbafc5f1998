//! The end of a job that succeeds: its policy is published and the job ends in one transaction.

use jiff::Timestamp;
use qedgix::checkpoint::{Checkpoint, digest, parameter_layout};
use qedgix::serving::{PolicySpec, VersionSelector};
use qedgix::store::{EndedAttempt, FILE, JobAction, JobState, Lease, NewPolicyVersion, VersionKey, WorkerResult};
use qedgix::train_config::{Algorithm, Preset, TrainConfig};
use qedgix::wire::v1;
use serde_json::json;

use super::harness::{Server, named, signed};
use super::protocol::upload;
use super::space::running_job;

/// A checkpoint whose parameters are all `value`.
fn checkpoint(value: f32) -> Vec<u8> {
    let mut config = TrainConfig::preset(Algorithm::Qmix, Preset::Practical);
    config.environment.reward_scale = Some(1.0);
    let parameters = vec![value; parameter_layout(&config).len()];
    Checkpoint::new(config, 400, None, parameters).unwrap().to_bytes()
}

fn success(lease: Lease, digest: &str) -> EndedAttempt<'_> {
    let now = Timestamp::UNIX_EPOCH;
    let (name, checkpoint, info, any_name) = ("mine", b"weights", "{}", false);
    let new = NewPolicyVersion { name, digest, checkpoint, info, now, alias: None, by: None, owner: None, any_name };
    EndedAttempt { lease, result: &WorkerResult::Succeeded, publish: Some(new), document: None, max_attempts: 3, now }
}

#[tokio::test]
async fn a_transaction_that_fails_neither_publishes_nor_ends() {
    let dir = tempfile::tempdir().unwrap();
    let (store, lease) = running_job(dir.path()).await;
    let digest = digest(b"weights");
    // Fails at the last statement of the transaction, as a full disk or a killed server would.
    let file = format!("sqlite://{}", dir.path().join(FILE).display());
    let other = sqlx::SqlitePool::connect(&file).await.unwrap();
    let fault = "CREATE TRIGGER fault BEFORE INSERT ON events BEGIN SELECT raise(ABORT, 'fault'); END";
    sqlx::query(fault).execute(&other).await.unwrap();
    store.end_attempt(success(lease, &digest)).await.unwrap_err();
    assert_eq!(store.policy_versions().await.unwrap(), []);
    assert_eq!(store.job(lease.job_id).await.unwrap().unwrap().state, JobState::Running);

    sqlx::query("DROP TRIGGER fault").execute(&other).await.unwrap();
    let (job, published) = store.end_attempt(success(lease, &digest)).await.unwrap().unwrap();
    assert_eq!((job.state, job.policy.as_deref()), (JobState::Succeeded, Some("mine:1")));
    assert!(published.unwrap().new);
    // A worker that did not see the response tries again.
    assert!(store.end_attempt(success(lease, &digest)).await.unwrap().is_none());
    let mine = VersionKey { name: "mine".into(), version: 1, digest };
    assert_eq!(store.policy_versions().await.unwrap(), [mine]);
}

#[tokio::test]
async fn an_acknowledged_cancel_publishes_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let (store, lease) = running_job(dir.path()).await;
    store.change_job(lease.job_id, JobAction::Cancel, Timestamp::UNIX_EPOCH).await.unwrap();
    let digest = digest(b"weights");
    let (job, published) = store.end_attempt(success(lease, &digest)).await.unwrap().unwrap();
    assert_eq!((job.state, job.policy, published), (JobState::Cancelled, None, None));
    assert_eq!(store.policy_versions().await.unwrap(), []);
}

#[tokio::test]
async fn a_cancel_at_the_moment_of_publishing_is_either_before_or_after_it() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Server::start(dir.path(), 1).await;
    for round in 1..=10_u16 {
        let name = format!("round-{round}");
        let id = server.submit(&named(&name)).await;
        let worker = server.worker().await;
        upload(&server, &worker, v1::CheckpointKind::Best, 400, &checkpoint(f32::from(round) / 100.0)).await;
        let mut client = server.worker_client().await;
        let finished = v1::FinishRequest { outcome: v1::Outcome::Succeeded.into(), ..Default::default() };
        let cancel = server.request(reqwest::Method::POST, &format!("/v1/jobs/{id}/cancel"));
        let (finished, cancelled) =
            tokio::join!(client.finish(signed(&worker.launch, &worker.launch.token, finished)), cancel.send());
        finished.unwrap();
        let (job, acknowledged) = (server.get(&format!("/v1/jobs/{id}")).await, cancelled.unwrap().status().is_success());
        assert_eq!(job["state"], if acknowledged { "cancelled" } else { "succeeded" }, "{job}");
        let live = server.app.registry.describe(&PolicySpec { name: name.clone(), version: VersionSelector::Newest }).is_ok();
        let stored = server.app.store.policy_versions().await.unwrap().iter().any(|stored| stored.name == name);
        assert_eq!((live, stored), (!acknowledged, !acknowledged));
        assert_eq!(job["policy"], if acknowledged { json!(null) } else { json!(format!("{name}:1")) });
        worker.exit("exit code 0");
    }
}
