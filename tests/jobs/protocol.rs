//! `WorkerService`: tokens, metrics, snapshots, checkpoints.

use std::collections::HashMap;

use qedgix::wire::v1;
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};
use tonic::Code;

use super::harness::{Server, Worker, expect, named, signed, tiny};

fn sign<T>(worker: &Worker, message: T) -> tonic::Request<T> {
    signed(&worker.launch, &worker.launch.token, message)
}

async fn started() -> (tempfile::TempDir, Server, String, Worker) {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Server::start(dir.path(), 2).await;
    let id = server.submit(&tiny()).await;
    let worker = server.worker().await;
    (dir, server, id, worker)
}

#[tokio::test]
async fn token_is_valid_for_its_own_attempt_only() {
    let (_dir, mut server, _, worker) = started().await;
    let mut client = server.worker_client().await;
    client.fetch(sign(&worker, v1::FetchRequest {})).await.unwrap();

    let none = client.fetch(v1::FetchRequest {}).await.unwrap_err();
    assert_eq!(none.code(), Code::Unauthenticated);
    let wrong = client.fetch(signed(&worker.launch, &"0".repeat(64), v1::FetchRequest {})).await.unwrap_err();
    assert_eq!(wrong.code(), Code::Unauthenticated);
    server.submit(&named("other")).await;
    let other = server.worker().await;
    let foreign = client.fetch(signed(&other.launch, &worker.launch.token, v1::FetchRequest {})).await.unwrap_err();
    assert_eq!(foreign.code(), Code::Unauthenticated);

    // After the end of the attempt its token is refused; the token of the new attempt is accepted.
    let old = worker.launch.clone();
    worker.exit("exit code 1");
    let new = server.worker().await;
    assert_eq!(new.launch.lease.attempt, 2);
    let report = v1::ReportRequest { metrics: Vec::new(), step: 9 };
    let late = client.report(signed(&old, &old.token, report.clone())).await.unwrap_err();
    assert_eq!(late.code(), Code::FailedPrecondition);
    client.report(sign(&new, report)).await.unwrap();
}

#[tokio::test]
async fn token_is_not_stored() {
    let (dir, _server, _, worker) = started().await;
    for file in std::fs::read_dir(dir.path()).unwrap() {
        let bytes = std::fs::read(file.unwrap().path()).unwrap();
        let token = worker.launch.token.as_bytes();
        assert!(!bytes.windows(token.len()).any(|window| window == token));
    }
}

#[tokio::test]
async fn repeated_metrics_are_stored_once() {
    let (_dir, server, id, worker) = started().await;
    let mut client = server.worker_client().await;
    let row = |name: &str, step, value| v1::ReportedMetric { name: name.into(), step, value };
    let first = vec![row("loss", 20, 0.5), row("loss", 40, f64::NAN), row("epsilon", 20, 1.0)];
    client.report(sign(&worker, v1::ReportRequest { metrics: first, step: 40 })).await.unwrap();
    let again = vec![row("loss", 40, 0.25), row("loss", 60, 0.125)];
    client.report(sign(&worker, v1::ReportRequest { metrics: again, step: 60 })).await.unwrap();

    let metrics = server.get(&format!("/v1/jobs/{id}/metrics")).await;
    let rows: Vec<Value> =
        metrics["metrics"].as_array().unwrap().iter().map(|m| json!([m["name"], m["step"], m["value"]])).collect();
    assert_eq!(json!(rows), json!([["epsilon", 20, 1.0], ["loss", 20, 0.5], ["loss", 40, 0.25], ["loss", 60, 0.125]]));
    assert_eq!(server.get(&format!("/v1/jobs/{id}")).await["progress"]["step"], 60);

    let unknown = server.request(Method::GET, &format!("/v1/jobs/{id}/metrics?name=los"));
    let problem = expect(unknown, StatusCode::BAD_REQUEST).await;
    assert!(problem["detail"].as_str().unwrap().ends_with("did you mean loss?"), "{problem}");
    let page = server.get(&format!("/v1/jobs/{id}/metrics?name=loss&page_size=2")).await;
    let token = page["next_page_token"].as_str().unwrap();
    let rest = server.get(&format!("/v1/jobs/{id}/metrics?name=loss&page_size=2&page_token={token}")).await;
    assert_eq!((&rest["metrics"][0]["step"], &rest["next_page_token"]), (&json!(60), &json!("")));

    let csv = server.request(Method::GET, &format!("/v1/jobs/{id}/metrics?format=csv&name=loss")).send().await.unwrap();
    let csv = csv.text().await.unwrap();
    assert!(csv.starts_with("name,step,value,at\nloss,20,0.5,20"), "{csv}");
    assert_eq!(csv.lines().count(), 4);

    let mut jobs = server.jobs().await;
    let request = v1::GetJobMetricsRequest { id, name: "loss".into(), ..Default::default() };
    let rows = jobs.get_job_metrics(request).await.unwrap().into_inner().rows;
    assert_eq!(
        rows.iter().map(|r| (r.step, r.value)).collect::<Vec<_>>(),
        [(20, Some(0.5)), (40, Some(0.25)), (60, Some(0.125))]
    );

    let bad = vec![row("lo,ss", 1, 0.0)];
    let status = client.report(sign(&worker, v1::ReportRequest { metrics: bad, step: 60 })).await.unwrap_err();
    assert_eq!(status.code(), Code::InvalidArgument);
}

fn snapshot(step: u64, bytes: &[u8], sha256: String) -> impl futures::Stream<Item = v1::UploadSnapshotRequest> + use<> {
    use v1::upload_snapshot_request::Part;
    let header = Part::Header(v1::SnapshotHeader { step, size: bytes.len() as u64, sha256 });
    let data: Vec<Part> = bytes.chunks(1 << 20).map(|chunk| Part::Data(chunk.to_vec().into())).collect();
    futures::stream::iter(std::iter::once(header).chain(data).map(|part| v1::UploadSnapshotRequest { part: Some(part) }))
}

#[tokio::test]
async fn snapshot_is_returned_unchanged_and_a_corrupt_upload_changes_nothing() {
    let (_dir, mut server, _, worker) = started().await;
    let mut client = server.worker_client().await;
    let absent = client.download_snapshot(sign(&worker, v1::DownloadSnapshotRequest {})).await.unwrap_err();
    assert_eq!(absent.code(), Code::NotFound);

    let bytes: Vec<u8> = (0..3_500_000_u32).map(|i| (i.wrapping_mul(i) >> 7) as u8).collect();
    let sha256 = hex::encode(Sha256::digest(&bytes));
    client.upload_snapshot(sign(&worker, snapshot(100, &bytes, sha256.clone()))).await.unwrap();
    client.upload_snapshot(sign(&worker, snapshot(200, &bytes, sha256))).await.unwrap();
    let broken = client.upload_snapshot(sign(&worker, snapshot(300, &bytes, "0".repeat(64)))).await.unwrap_err();
    assert_eq!(broken.code(), Code::InvalidArgument);

    worker.exit("killed by signal 9");
    let next = server.worker().await;
    let work = client.fetch(sign(&next, v1::FetchRequest {})).await.unwrap().into_inner();
    assert_eq!(work.snapshot_step, Some(200));
    let mut chunks = client.download_snapshot(sign(&next, v1::DownloadSnapshotRequest {})).await.unwrap().into_inner();
    let mut received = Vec::new();
    while let Some(chunk) = chunks.message().await.unwrap() {
        assert!(chunk.data.len() <= 1 << 20);
        received.extend_from_slice(&chunk.data);
    }
    assert!(received == bytes);
}

pub async fn upload(server: &Server, worker: &Worker, kind: v1::CheckpointKind, step: u64, bytes: &[u8]) -> String {
    use v1::upload_checkpoint_request::Part;
    let header = v1::CheckpointHeader {
        kind: kind.into(),
        step,
        size: bytes.len() as u64,
        sha256: hex::encode(Sha256::digest(bytes)),
        metrics: HashMap::from([("eval/mean_aoi".to_owned(), 12.5)]),
    };
    let parts = [Part::Header(header), Part::Data(bytes.to_vec().into())];
    let parts = futures::stream::iter(parts.map(|part| v1::UploadCheckpointRequest { part: Some(part) }));
    server.worker_client().await.upload_checkpoint(sign(worker, parts)).await.unwrap().into_inner().id
}

#[tokio::test]
async fn best_and_last_checkpoints_are_kept() {
    let (_dir, server, id, worker) = started().await;
    let first = upload(&server, &worker, v1::CheckpointKind::Best, 200, b"first").await;
    let again = upload(&server, &worker, v1::CheckpointKind::Best, 200, b"first").await;
    assert_eq!(first, again, "a repeated upload of a checkpoint changes nothing");
    let better = upload(&server, &worker, v1::CheckpointKind::Best, 300, b"better").await;
    let last = upload(&server, &worker, v1::CheckpointKind::Last, 400, b"last").await;

    let list = server.get(&format!("/v1/jobs/{id}/checkpoints")).await;
    let shown: Vec<Value> =
        list["checkpoints"].as_array().unwrap().iter().map(|c| json!([c["id"], c["kind"], c["step"]])).collect();
    assert_eq!(json!(shown), json!([[better, "best", 300], [last, "last", 400]]));
    assert_eq!(list["checkpoints"][0]["metrics"]["eval/mean_aoi"], 12.5);
    assert_eq!(list["checkpoints"][0]["config"]["training"]["steps"], 400);

    let response = server.request(Method::GET, &format!("/v1/checkpoints/{better}")).send().await.unwrap();
    assert_eq!(response.headers()["etag"], format!("\"{}\"", hex::encode(Sha256::digest(b"better"))));
    assert_eq!(response.bytes().await.unwrap().as_ref(), b"better");
    expect(server.request(Method::GET, &format!("/v1/checkpoints/{first}")), StatusCode::NOT_FOUND).await;
}
