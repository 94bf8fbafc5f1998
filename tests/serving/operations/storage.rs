//! A database that cannot be written: refusals, readiness, and that everything goes on afterwards.

use std::path::{Path, PathBuf};
use std::process::Command;

use qedgix::service::operations;
use qedgix::wire::v1;
use qedgix::wire::v1::job_service_client::JobServiceClient;
use reqwest::StatusCode;
use serde_json::{Value, json};
use sqlx::sqlite::{SqliteConnectOptions, SqliteConnection};
use sqlx::{ConnectOptions, Connection};
use tonic::Code;
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;

use super::super::harness::*;

fn database(server: &Server) -> PathBuf {
    server.dir.path().join(qedgix::store::FILE)
}

async fn get(server: &Server, path: &str) -> StatusCode {
    reqwest::get(server.url(path)).await.unwrap().status()
}

/// Status and code of a submission over REST.
async fn submit(server: &Server) -> (StatusCode, String) {
    let job = json!({"algorithm": "vdn", "training": {"steps": 100}});
    let response = reqwest::Client::new().post(server.url("/v1/jobs")).json(&job).send().await.unwrap();
    let status = response.status();
    if status == StatusCode::INSUFFICIENT_STORAGE {
        assert!(response.headers().contains_key("retry-after"));
    }
    let body: Value = response.json().await.unwrap();
    (status, body["code"].as_str().unwrap_or_default().to_owned())
}

/// What the metrics say: whether the server is ready, and whether the database can be written. Not read from `/metrics`, because the
/// servers of other tests in this process share the recorder.
async fn gauges(server: &Server) -> (bool, bool) {
    let metrics = operations::server_metrics(&server.app).await;
    (metrics.ready, metrics.database_writable)
}

/// A server whose jobs stay in the queue.
async fn server() -> Server {
    let server = Server::with(|config| config.worker = Some("/bin/false".into())).await;
    assert_eq!(submit(&server).await.0, StatusCode::CREATED);
    server
}

/// Waits until the server is ready again, and checks that it stores jobs.
async fn recovers(server: &Server) {
    with_timeout(async { while get(server, "/readyz").await != StatusCode::OK {} }).await;
    assert_eq!(gauges(server).await, (true, true));
    assert_eq!(submit(server).await.0, StatusCode::CREATED);
}

/// Checks that all interfaces agree that the database cannot be written, and that everything else works.
async fn refuses_writes(server: &Server, code: &str, grpc: Code) {
    with_timeout(async { while submit(server).await.0 == StatusCode::CREATED {} }).await;
    assert_eq!(submit(server).await, (StatusCode::INSUFFICIENT_STORAGE, code.to_owned()));
    let mut jobs = JobServiceClient::new(server.channel().await);
    let refusal = refused(jobs.submit_job(v1::SubmitJobRequest::default()).await);
    assert_eq!((refusal.0, refusal.1.as_str()), (grpc, code));
    for ready in ["/readyz", "/v2/health/ready"] {
        assert_eq!(get(server, ready).await, StatusCode::SERVICE_UNAVAILABLE, "{ready}");
    }
    assert_eq!(gauges(server).await, (false, false));
    let mut health = HealthClient::new(server.channel().await);
    let mut watch = health.watch(HealthCheckRequest { service: "qedgix.v1.JobService".into() }).await.unwrap().into_inner();
    with_timeout(async { while watch.message().await.unwrap().unwrap().status() != ServingStatus::NotServing {} }).await;
    assert_eq!(get(server, "/v1/jobs").await, StatusCode::OK);
    server.grpc().await.act(held("sweep", bytes::Bytes::new(), scene(2, 3, 0))).await.unwrap();
}

#[tokio::test]
async fn a_deleted_or_replaced_file_is_not_written_until_it_is_back() {
    let server = server().await;
    let (database, aside) = (database(&server), server.dir.path().join("aside"));
    for file in [database.clone(), log_of(&database)] {
        std::fs::rename(&file, &aside).unwrap();
        refuses_writes(&server, "storage_failed", Code::Unavailable).await;
        // Another file in its place is not the database.
        std::fs::copy(&aside, &file).unwrap();
        assert_eq!(submit(&server).await.1, "storage_failed");
        std::fs::rename(&aside, &file).unwrap();
        recovers(&server).await;
    }
}

/// Path of the write-ahead log.
fn log_of(database: &Path) -> PathBuf {
    database.with_file_name(format!("{}-wal", qedgix::store::FILE))
}

#[tokio::test]
async fn an_external_lock_refuses_writes_until_it_is_released() {
    let server = server().await;
    let mut other: SqliteConnection = SqliteConnectOptions::new().filename(database(&server)).connect().await.unwrap();
    sqlx::query("BEGIN IMMEDIATE").execute(&mut other).await.unwrap();
    refuses_writes(&server, "storage_failed", Code::Unavailable).await;
    sqlx::query("ROLLBACK").execute(&mut other).await.unwrap();
    recovers(&server).await;
}

/// A file system of 16 MiB, if this user may mount one.
struct SmallDisk(tempfile::TempDir);

impl SmallDisk {
    fn mount() -> Option<Self> {
        let dir = tempfile::tempdir().unwrap();
        let mounted = Command::new("mount").args(["-t", "tmpfs", "-o", "size=16m", "tmpfs"]).arg(dir.path()).status();
        if !mounted.is_ok_and(|status| status.success()) {
            eprintln!("skipped: only root may mount a small file system");
            return None;
        }
        Some(Self(dir))
    }

    fn remount(&self, how: &str) {
        let done = Command::new("mount").args(["-o", &format!("remount,{how}")]).arg(self.0.path()).status().unwrap();
        assert!(done.success());
    }

    fn server_directory(&self) -> tempfile::TempDir {
        tempfile::tempdir_in(self.0.path()).unwrap()
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        // Lazily: a server of a failed test may still use it.
        let _ = Command::new("umount").arg("--lazy").arg(self.0.path()).status();
    }
}

/// Writes zeros until the disk is full.
fn fill(path: &Path) {
    let mut file = std::fs::File::create(path).unwrap();
    while std::io::Write::write_all(&mut file, &[0; 4096]).is_ok() {}
}

#[tokio::test]
async fn a_full_disk_refuses_writes_until_there_is_space() {
    let Some(disk) = SmallDisk::mount() else { return };
    let server = Server::on(disk.server_directory(), |config| config.worker = Some("/bin/false".into())).await;
    let filler = disk.0.path().join("filler");
    for _ in 0..2 {
        fill(&filler);
        refuses_writes(&server, "storage_full", Code::ResourceExhausted).await;
        std::fs::remove_file(&filler).unwrap();
        recovers(&server).await;
    }
}

#[tokio::test]
async fn a_file_system_that_turns_read_only_refuses_writes_until_it_is_writable() {
    let Some(disk) = SmallDisk::mount() else { return };
    let mount = disk.0.path().to_owned();
    // A file system turns read-only only while no file is open for writing; a bind mount can do so at any time.
    let server = Server::on(disk.server_directory(), |config| config.worker = Some("/bin/false".into())).await;
    let read_only = Command::new("mount").args(["-o", "remount,ro"]).arg(&mount).stderr(std::process::Stdio::null()).status();
    if !read_only.unwrap().success() {
        eprintln!("skipped: the file system cannot turn read-only while files are open");
        return;
    }
    refuses_writes(&server, "storage_failed", Code::Unavailable).await;
    disk.remount("rw");
    recovers(&server).await;
}

#[tokio::test]
async fn a_stopped_server_leaves_one_file_that_can_be_copied() {
    let mut server = server().await;
    let (dir, copy) = (server.dir.path().to_owned(), tempfile::tempdir().unwrap());
    let file = database(&server);
    server.begin_stop();
    with_timeout(server.ended()).await;
    let left: Vec<_> = std::fs::read_dir(&dir).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    assert!(!left.iter().any(|name| name.to_string_lossy().ends_with("-wal")), "{left:?}");
    let copied = copy.path().join("copy");
    std::fs::copy(&file, &copied).unwrap();
    let mut copy = SqliteConnectOptions::new().filename(&copied).connect().await.unwrap();
    let jobs: i64 = sqlx::query_scalar("SELECT count(*) FROM jobs").fetch_one(&mut copy).await.unwrap();
    assert_eq!(jobs, 1);
    copy.close().await.unwrap();
}

#[tokio::test]
async fn a_server_starts_although_its_addresses_cannot_be_written() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::create_dir(dir.path().join(qedgix::server::ENDPOINTS)).unwrap();
    let server = Server::on(dir, |_| {}).await;
    assert_eq!(get(&server, "/readyz").await, StatusCode::OK);
}
