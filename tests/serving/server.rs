//! The whole server: health, reflection, draining, data directory, settings.

use std::sync::Arc;

use bytes::Bytes;
use qedgix::config::Config;
use qedgix::server::{self, DataDir, ENDPOINTS};
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;
use tonic_health::pb::{HealthCheckRequest, HealthCheckResponse};
use tonic_reflection::pb::v1::server_reflection_request::MessageRequest;
use tonic_reflection::pb::v1::server_reflection_response::MessageResponse;
use tonic_reflection::pb::{v1, v1alpha};

use super::harness::*;

#[tokio::test]
async fn draining_completes_requests_in_flight() {
    let mut server = Server::start().await;
    let gate = Arc::new(Gate::default());
    server.add("slow", 1, Arc::new(TestPolicy::Wait(gate.clone())));
    let mut flying = server.grpc().await;
    let mut health = HealthClient::new(server.channel().await);
    let watch = HealthCheckRequest { service: "qedgix.v1.PolicyService".into() };
    let mut states = health.watch(watch).await.unwrap().into_inner();
    let state = |state: Option<HealthCheckResponse>| state.unwrap().status();
    assert_eq!(state(states.message().await.unwrap()), ServingStatus::Serving);
    let in_flight = tokio::spawn(async move { flying.act(held("slow", Bytes::new(), scene(2, 2, 0))).await });
    gate.reached(1).await;
    let endpoints = server.dir.path().join(ENDPOINTS);
    assert!(std::fs::read_to_string(&endpoints).unwrap().contains(&server.endpoints.grpc.to_string()));
    server.begin_stop();
    assert_eq!(state(with_timeout(states.message()).await.unwrap()), ServingStatus::NotServing);
    drop(states);
    assert!(server.app.ready().await.is_err());
    gate.open();
    assert_eq!(with_timeout(in_flight).await.unwrap().unwrap().into_inner().actions.len(), 2);
    with_timeout(server.stopped()).await;
    assert!(!endpoints.exists());
}

#[tokio::test]
async fn new_work_is_refused_while_draining() {
    let server = Server::start().await;
    let mut client = server.grpc().await;
    client.open_session(open("sweep", "s")).await.unwrap();
    server.app.draining.begin();
    for refusal in [
        refused(client.act(in_session("s", None, scene(2, 2, 0))).await),
        refused(client.act(held("sweep", Bytes::new(), scene(2, 2, 0))).await),
        refused(client.open_session(open("sweep", "t")).await),
    ] {
        assert_eq!((refusal.0, refusal.1.as_str()), (tonic::Code::Unavailable, "draining"));
    }
}

#[tokio::test]
async fn health_reports_every_service() {
    let server = Server::start().await;
    let mut health = HealthClient::new(server.channel().await);
    for service in ["", "qedgix.v1.PolicyService", "qedgix.v1.EnvironmentService", "inference.GRPCInferenceService"] {
        let answer = health.check(HealthCheckRequest { service: service.into() }).await.unwrap().into_inner();
        assert_eq!(answer.status(), ServingStatus::Serving, "{service}");
    }
    let unknown = health.check(HealthCheckRequest { service: "no.such.Service".into() }).await;
    assert_eq!(unknown.unwrap_err().code(), tonic::Code::NotFound);
}

#[tokio::test]
async fn reflection_works_in_both_versions() {
    let server = Server::start().await;
    let ask = || MessageRequest::ListServices(String::new());
    let request = v1::ServerReflectionRequest { host: String::new(), message_request: Some(ask()) };
    let mut client = v1::server_reflection_client::ServerReflectionClient::new(server.channel().await);
    let stream = client.server_reflection_info(tokio_stream::once(request)).await.unwrap();
    let answer = stream.into_inner().message().await.unwrap().unwrap().message_response.unwrap();
    let MessageResponse::ListServicesResponse(list) = answer else { panic!("not a list: {answer:?}") };
    for name in ["qedgix.v1.PolicyService", "inference.GRPCInferenceService"] {
        assert!(list.service.iter().any(|s| s.name == name), "{list:?}");
    }

    let ask = v1alpha::server_reflection_request::MessageRequest::FileContainingSymbol("qedgix.v1.ActRequest".into());
    let request = v1alpha::ServerReflectionRequest { host: String::new(), message_request: Some(ask) };
    let mut client = v1alpha::server_reflection_client::ServerReflectionClient::new(server.channel().await);
    let stream = client.server_reflection_info(tokio_stream::once(request)).await.unwrap();
    let answer = stream.into_inner().message().await.unwrap().unwrap().message_response.unwrap();
    assert!(matches!(answer, v1alpha::server_reflection_response::MessageResponse::FileDescriptorResponse(_)), "{answer:?}");
}

#[tokio::test]
async fn a_data_directory_is_locked_by_one_server() {
    let server = Server::start().await;
    let second = DataDir::lock(server.dir.path()).unwrap_err();
    assert!(matches!(&second, server::Error::InUse(path) if path == server.dir.path()), "{second}");
    assert!(second.to_string().contains("--data-dir"), "{second}");
    let file = server.dir.path().join("lock");
    assert!(matches!(DataDir::lock(&file), Err(server::Error::File { .. })), "a file is not a directory");
    // Neither a deleted lock file nor another path of the directory lets a second server in.
    std::fs::remove_file(&file).unwrap();
    let link = tempfile::tempdir().unwrap().path().join("link");
    std::fs::create_dir_all(link.parent().unwrap()).unwrap();
    std::os::unix::fs::symlink(server.dir.path(), &link).unwrap();
    for path in [server.dir.path(), &link] {
        assert!(matches!(DataDir::lock(path), Err(server::Error::InUse(_))), "{}", path.display());
    }
    std::fs::remove_dir_all(link.parent().unwrap()).unwrap();
}

#[test]
fn settings_are_validated() {
    let refused = |change: fn(&mut Config)| {
        let mut config = Config::new("unused");
        change(&mut config);
        config.validate().unwrap_err().field
    };
    assert!(Config::new("unused").validate().is_ok());
    assert_eq!(refused(|c| c.cpu_budget = 0), "--cpu-budget");
    assert_eq!(refused(|c| c.max_sessions = 0), "--max-sessions");
    assert_eq!(refused(|c| c.max_environments = 0), "--max-environments");
    assert_eq!(refused(|c| c.environment_memory = 1), "--environment-memory");
    assert_eq!(refused(|c| c.session_memory = 1), "--session-memory");
    assert_eq!(refused(|c| c.environment_ttl = std::time::Duration::ZERO), "--environment-ttl");
    assert_eq!(refused(|c| c.max_connections = 0), "--max-connections");
    assert_eq!(refused(|c| c.max_streams = 0), "--max-streams");
    assert_eq!(refused(|c| c.read_timeout = std::time::Duration::ZERO), "--read-timeout");
    assert_eq!(refused(|c| c.drain_timeout = std::time::Duration::from_secs(10_000_000_000)), "--drain-timeout");
    assert_eq!(refused(|c| c.key_rate = Some(0.0)), "--key-rate");
    assert_eq!(refused(|c| c.key_burst = Some(f64::NAN)), "--key-burst");

    let mut far = Config::new("unused");
    assert!(far.validate_exposure(false).is_ok());
    far.grpc_addr = "0.0.0.0:50051".parse().unwrap();
    assert_eq!(far.validate_exposure(false).unwrap_err().field, "--grpc-addr");
    (far.grpc_addr, far.http_addr) = ("[::1]:50051".parse().unwrap(), "192.0.2.1:80".parse().unwrap());
    assert_eq!(far.validate_exposure(false).unwrap_err().field, "--http-addr");
    assert!(far.validate_exposure(true).is_ok(), "API keys are required");
    far.insecure = true;
    assert!(far.validate_exposure(false).is_ok());
}

/// A process of the binary; killed when dropped.
struct Process(std::process::Child);

impl Process {
    fn start(dir: &std::path::Path, flags: &[&str]) -> Self {
        let child = std::process::Command::new(env!("CARGO_BIN_EXE_qedgix"))
            .args(["serve", "--grpc-addr", "127.0.0.1:0"])
            .args(flags)
            .env("QEDGIX_HTTP_ADDR", "127.0.0.1:0")
            .env("QEDGIX_DATA_DIR", dir)
            .stdout(std::process::Stdio::piped())
            .stderr(std::process::Stdio::piped())
            .spawn();
        Self(child.unwrap())
    }

    /// Waits for the exit and returns the exit code and standard error.
    fn ended(mut self) -> (Option<i32>, String) {
        let mut text = String::new();
        std::io::Read::read_to_string(self.0.stderr.as_mut().unwrap(), &mut text).unwrap();
        (self.0.wait().unwrap().code(), text)
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[test]
fn the_binary_prints_its_addresses_and_drains_on_sigterm() {
    use std::io::BufRead;
    let dir = tempfile::tempdir().unwrap();
    let mut first = Process::start(dir.path(), &[]);
    let mut stdout = std::io::BufReader::new(first.0.stdout.take().unwrap()).lines().map(Result::unwrap);
    assert!(stdout.next().unwrap().starts_with("qedgix "));
    let grpc = stdout.next().unwrap();
    assert!(grpc.starts_with("gRPC       127.0.0.1:") && !grpc.ends_with(":0"), "{grpc}");
    assert!(stdout.next().unwrap().starts_with("REST       http://127.0.0.1:"));
    assert!(stdout.next().unwrap().starts_with("dashboard  http://127.0.0.1:"));

    let (code, text) = Process::start(dir.path(), &[]).ended();
    assert_eq!(code, Some(1));
    assert!(text.contains("in use by another qedgix server"), "{text}");
    let other = tempfile::tempdir().unwrap();
    let (code, text) = Process::start(other.path(), &["--http-addr=0.0.0.0:0"]).ended();
    assert_eq!(code, Some(1));
    assert!(text.contains("--http-addr") && text.contains("--insecure") && text.contains("qedgix keys create"), "{text}");

    let signalled = std::process::Command::new("kill").args(["-TERM", &first.0.id().to_string()]).status().unwrap();
    assert!(signalled.success());
    let (code, text) = first.ended();
    assert_eq!(code, Some(0), "{text}");
    assert!(text.contains("draining") && text.contains("stopped"), "{text}");
}
