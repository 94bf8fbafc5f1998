//! Draining on signals: orderly shutdown, the drain timeout, and the second signal.

use qedgix::wire::v1;
use qedgix::wire::v1::job_service_client::JobServiceClient;
use tokio::sync::mpsc;
use tokio_stream::wrappers::UnboundedReceiverStream;
use tonic::Code;
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;
use tonic_reflection::pb::v1::server_reflection_client::ServerReflectionClient;

use super::super::binary::Binary;
use super::super::harness::*;

/// An `Act` that waits in the engine for a larger batch.
async fn in_flight(binary: &Binary) -> tokio::task::JoinHandle<Result<tonic::Response<v1::ActResponse>, tonic::Status>> {
    let mut client = binary.policies().await;
    loop {
        let mut flying = client.clone();
        let act = tokio::spawn(async move { flying.act(held("sweep", bytes::Bytes::new(), scene(2, 3, 0))).await });
        while !act.is_finished() {
            if binary.sample("qedgix_engine_queue_depth").await == 1.0 {
                return act;
            }
        }
        // It was answered before the metric was read.
        act.await.unwrap().unwrap();
        client = binary.policies().await;
    }
}

#[tokio::test]
async fn sigterm_ends_streams_and_completes_requests_in_flight() {
    let dir = tempfile::tempdir().unwrap();
    let binary = Binary::start(dir.path(), &["--max-batch-delay", "3s", "--cpu-budget", "1"]).await;
    let mut jobs = JobServiceClient::new(binary.channel().await);
    // A paused job neither runs nor ends.
    let spec = serde_json::json!({
        "algorithm": "vdn",
        "threads": 1,
        "environment": {"slots": 10, "uavs": 2, "users": 2},
        "training": {"steps": 1_000_000_000, "envs": 2, "batch": 2, "buffer": 20, "eval_every": 200, "eval_episodes": 2},
    });
    let spec = qedgix::api::convert::structs::to_struct(&spec);
    let job = jobs.submit_job(v1::SubmitJobRequest { spec, ..Default::default() }).await.unwrap().into_inner();
    jobs.pause_job(v1::PauseJobRequest { id: job.id.clone() }).await.unwrap();
    with_timeout(async {
        while jobs.get_job(v1::GetJobRequest { id: job.id.clone() }).await.unwrap().into_inner().state() != v1::JobState::Paused {
            tokio::task::yield_now().await;
        }
    })
    .await;
    let mut watch = jobs.watch_job(v1::WatchJobRequest { id: job.id.clone(), after: 0 }).await.unwrap().into_inner();
    watch.message().await.unwrap().unwrap();
    let mut events = reqwest::get(format!("{}/v1/jobs/{}/events", binary.http, job.id)).await.unwrap();
    events.chunk().await.unwrap().unwrap();
    let mut health = HealthClient::new(binary.channel().await);
    let mut states = health.watch(HealthCheckRequest::default()).await.unwrap().into_inner();
    assert_eq!(states.message().await.unwrap().unwrap().status(), ServingStatus::Serving);
    let (asking, requests) = mpsc::unbounded_channel();
    let mut answers = binary.policies().await.act_stream(UnboundedReceiverStream::new(requests)).await.unwrap().into_inner();
    // The reflection service of the crate does not know about draining.
    let mut reflection = ServerReflectionClient::new(binary.channel().await);
    let (_open, requests_of_reflection) = mpsc::unbounded_channel();
    let mut described =
        reflection.server_reflection_info(UnboundedReceiverStream::new(requests_of_reflection)).await.unwrap().into_inner();
    // A connection without any request.
    let idle = tokio::net::TcpStream::connect(binary.http.trim_start_matches("http://")).await.unwrap();
    let act = in_flight(&binary).await;

    binary.signal("TERM");
    assert_eq!(with_timeout(states.message()).await.unwrap().unwrap().status(), ServingStatus::NotServing);
    assert!(with_timeout(states.message()).await.unwrap().is_none());
    assert!(with_timeout(answers.message()).await.unwrap().is_none(), "the server ends the stream");
    assert!(with_timeout(described.message()).await.unwrap().is_none());
    let watch_status = with_timeout(async {
        loop {
            if let Err(status) = watch.message().await {
                return status;
            }
        }
    });
    assert_eq!(watch_status.await.code(), Code::Unavailable);
    with_timeout(async { while events.chunk().await.unwrap().is_some() {} }).await;
    let answer = with_timeout(act).await.unwrap().unwrap().into_inner();
    assert_eq!(answer.actions.len(), 2);
    let (code, lines) = binary.ended().await;
    assert_eq!(code, Some(0), "{lines:?}");
    assert!(!lines.iter().any(|line| line.contains("drain timeout")), "{lines:?}");
    assert!(!dir.path().join(qedgix::server::ENDPOINTS).exists());
    drop((asking, idle));
}

#[tokio::test]
async fn a_second_signal_ends_the_process_at_once() {
    for (signal, code) in [("TERM", 143), ("INT", 130)] {
        let dir = tempfile::tempdir().unwrap();
        let binary = Binary::start(dir.path(), &["--max-batch-delay", "10s"]).await;
        let act = in_flight(&binary).await;
        binary.signal("TERM");
        binary.says("draining").await;
        binary.signal(signal);
        let (ended, lines) = binary.ended().await;
        assert_eq!(ended, Some(code), "{lines:?}");
        assert!(with_timeout(act).await.unwrap().is_err());
        // Another server can start on the same directory.
        let binary = Binary::start(dir.path(), &[]).await;
        let ready = reqwest::get(format!("{}/readyz", binary.http)).await.unwrap();
        assert_eq!(ready.status(), 200);
    }
}

#[tokio::test]
async fn sighup_without_tls_changes_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let binary = Binary::start(dir.path(), &[]).await;
    binary.signal("HUP");
    binary.says("SIGHUP: no certificate to reload").await;
    assert_eq!(reqwest::get(format!("{}/readyz", binary.http)).await.unwrap().status(), 200);
}

#[tokio::test]
async fn requests_are_closed_after_the_drain_timeout() {
    let dir = tempfile::tempdir().unwrap();
    let binary = Binary::start(dir.path(), &["--max-batch-delay", "10s", "--drain-timeout", "50ms"]).await;
    let act = in_flight(&binary).await;
    binary.signal("TERM");
    let (code, lines) = binary.ended().await;
    assert_eq!(code, Some(0), "{lines:?}");
    assert!(lines.iter().any(|line| line.contains("drain timeout")), "{lines:?}");
    assert!(with_timeout(act).await.unwrap().is_err());
}
