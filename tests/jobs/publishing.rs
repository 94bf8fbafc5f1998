//! The end of a job that succeeds: its policy is published and the job ends in one transaction.

use jiff::Timestamp;
use qedgix::checkpoint::{Checkpoint, digest, parameter_layout};
use qedgix::serving::{PolicySpec, VersionSelector};
use qedgix::store::{EndedAttempt, FILE, JobAction, JobState, Lease, NewPolicyVersion, VersionKey, WorkerResult};
use qedgix::train_config::{Algorithm, Preset, TrainConfig};
use qedgix::wire::v1;
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};

use super::harness::{Server, expect, named, signed, with};
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

/// What a job that publishes as `uav` asks for.
fn promotion(rival: &str) -> Value {
    with(&json!({"publish": {"policy": "uav", "alias": "live", "if": {"better_than": rival}}}))
}

async fn live(server: &Server) -> Value {
    server.get("/v1/policies/uav/aliases").await["aliases"].clone()
}

/// Runs a job whose worker reports this comparison, and returns what became of the promotion.
async fn run_compared(server: &mut Server, rival: &str, value: f32, comparison: Option<(&str, f64, Option<f64>)>) -> Value {
    let id = server.submit(&promotion(rival)).await;
    let worker = server.worker().await;
    upload(server, &worker, v1::CheckpointKind::Best, 400, &checkpoint(value)).await;
    let result = comparison.map(|(policy, own, other)| {
        json!({"policy": policy, "layouts": "eval-v1", "episodes": 256, "mean_aoi": own, "rival_mean_aoi": other}).to_string()
    });
    let finish =
        v1::FinishRequest { outcome: v1::Outcome::Succeeded.into(), result: result.unwrap_or_default(), ..Default::default() };
    let mut client = server.worker_client().await;
    client.finish(signed(&worker.launch, &worker.launch.token, finish)).await.unwrap();
    worker.exit("exit code 0");
    let job = server.reaches(&id, "succeeded").await;
    assert_eq!(job["publish"], json!({"policy": "uav", "alias": "live", "if": {"better_than": rival}}));
    server.get(&format!("/v1/jobs/{id}/result")).await["publish"].clone()
}

#[tokio::test]
async fn an_alias_moves_only_to_a_policy_that_is_better_than_the_rival_of_that_moment() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Server::start(dir.path(), 1).await;
    // The first version has no rival.
    let first = run_compared(&mut server, "uav@live", 0.01, None).await;
    assert_eq!(first, json!({"alias": "live", "promoted": true, "reason": null, "comparison": null}));
    assert_eq!(live(&server).await, json!([{"alias": "live", "version": 1}]));
    let better = run_compared(&mut server, "uav@live", 0.02, Some(("uav:1", 7.5, Some(8.0)))).await;
    assert_eq!((&better["promoted"], &better["comparison"]["rival_mean_aoi"]), (&json!(true), &json!(8.0)));
    for (value, rival, comparison) in [
        // Worse, equal, unable to fly, compared with a version that is no longer live, not compared.
        (0.03, "uav@live", Some(("uav:2", 8.5, Some(8.0)))),
        (0.04, "uav@live", Some(("uav:2", 8.0, Some(8.0)))),
        (0.05, "uav@live", Some(("uav:2", 8.0, None))),
        (0.06, "uav@live", Some(("uav:1", 7.0, Some(8.0)))),
        (0.07, "tour", None),
    ] {
        let kept = run_compared(&mut server, rival, value, comparison).await;
        assert!(kept["promoted"] == false && kept["reason"].is_string(), "{kept}");
        assert_eq!(live(&server).await, json!([{"alias": "live", "version": 2}]));
    }
    let versions = server.get("/v1/policies/uav/versions").await;
    assert_eq!(versions["versions"].as_array().unwrap().len(), 7, "all are published");

    for (publish, field) in [
        (json!({"policy": "uav", "if": {"better_than": "uav@live"}}), "publish.alias"),
        (json!({"policy": "uav", "alias": "li ve"}), "publish.alias"),
        (json!({"policy": "tour", "alias": "live"}), "publish.policy"),
        (json!({"policy": "uav", "alias": "live", "if": {"better_than": "uva@live"}}), "publish.if.better_than"),
    ] {
        let request = server.request(Method::POST, "/v1/jobs").json(&with(&json!({"publish": publish})));
        assert_eq!(expect(request, StatusCode::BAD_REQUEST).await["field"], field, "{publish}");
    }
}

#[tokio::test]
async fn a_worker_compares_its_best_checkpoint_with_the_rival() {
    let dir = tempfile::tempdir().unwrap();
    let executor: std::sync::Arc<dyn qedgix::jobs::Executor> =
        std::sync::Arc::new(qedgix::jobs::LocalProcess::new(env!("CARGO_BIN_EXE_qedgix")));
    let server = Server::start_on(dir.path(), 1, |_| {}, Some(executor)).await;
    let mut grpc = server.jobs().await;
    for (rival, policy) in [("uav@live", Value::Null), ("uav@live", json!("uav:1")), ("tour", json!("tour"))] {
        let spec = qedgix::api::convert::structs::to_struct(&promotion(rival));
        let job = grpc.submit_job(v1::SubmitJobRequest { spec, ..Default::default() }).await.unwrap().into_inner();
        server.reaches(&job.id, "succeeded").await;
        let publish = server.get(&format!("/v1/jobs/{}/result", job.id)).await["publish"].clone();
        let comparison = &publish["comparison"];
        assert_eq!(comparison["policy"], policy);
        if policy.is_null() {
            assert_eq!(publish["promoted"], true);
            continue;
        }
        let better = comparison["mean_aoi"].as_f64().unwrap() < comparison["rival_mean_aoi"].as_f64().unwrap();
        assert_eq!(publish["promoted"], better, "{publish}");
    }
}
