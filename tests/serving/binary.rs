//! `qedgix serve` as a process, with its log and signals.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use qedgix::wire::v1::policy_service_client::PolicyServiceClient;
use serde_json::Value;
use tonic::transport::Channel;

use super::harness::{install_tls_provider, with_timeout};

/// A `qedgix serve` on free ports; killed when dropped.
pub struct Binary {
    child: Child,
    pub grpc: String,
    pub http: String,
    lines: Arc<Mutex<Vec<String>>>,
    reader: Option<std::thread::JoinHandle<()>>,
    close: Arc<AtomicBool>,
}

const POLL: Duration = Duration::from_millis(5);

impl Binary {
    pub async fn start(dir: &Path, flags: &[&str]) -> Self {
        install_tls_provider();
        let endpoints = dir.join(qedgix::server::ENDPOINTS);
        // A killed server leaves its file behind.
        let _ = std::fs::remove_file(&endpoints);
        let mut child = Command::new(env!("CARGO_BIN_EXE_qedgix"))
            .args(["serve", "--grpc-addr", "127.0.0.1:0", "--http-addr", "127.0.0.1:0", "--data-dir"])
            .arg(dir)
            .args(flags)
            .env_remove("QEDGIX_LOG")
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let lines = Arc::new(Mutex::new(Vec::new()));
        let (stderr, kept) = (child.stderr.take().unwrap(), lines.clone());
        let close = Arc::new(AtomicBool::new(false));
        let closed = close.clone();
        let reader = std::thread::spawn(move || {
            for line in BufReader::new(stderr).lines().map_while(Result::ok) {
                kept.lock().unwrap().push(line);
                if closed.load(Ordering::Relaxed) {
                    break;
                }
            }
        });
        let mut binary = Self { child, grpc: String::new(), http: String::new(), lines, reader: Some(reader), close };
        let text = with_timeout(async {
            loop {
                if let Ok(text) = std::fs::read_to_string(&endpoints) {
                    break text;
                }
                assert!(binary.child.try_wait().unwrap().is_none(), "it ended: {:?}", binary.lines());
                tokio::time::sleep(POLL).await;
            }
        });
        let endpoints: Value = serde_json::from_str(&text.await).unwrap();
        let url = |name: &str| format!("http://{}", endpoints[name].as_str().unwrap());
        (binary.grpc, binary.http) = (url("grpc"), url("http"));
        binary
    }

    pub async fn channel(&self) -> Channel {
        Channel::from_shared(self.grpc.clone()).unwrap().connect().await.unwrap()
    }

    pub async fn policies(&self) -> PolicyServiceClient<Channel> {
        PolicyServiceClient::new(self.channel().await)
    }

    pub async fn metrics(&self) -> String {
        reqwest::get(format!("{}/metrics", self.http)).await.unwrap().text().await.unwrap()
    }

    /// The value of the sample whose line has this prefix; 0 if there is none.
    pub async fn sample(&self, beginning: &str) -> f64 {
        let text = self.metrics().await;
        text.lines()
            .find(|line| line.starts_with(beginning))
            .map_or(0.0, |line| line.rsplit_once(' ').unwrap().1.parse().unwrap())
    }

    /// The log so far.
    pub fn lines(&self) -> Vec<String> {
        self.lines.lock().unwrap().clone()
    }

    /// Waits for a log line that contains `text`.
    pub async fn says(&self, text: &str) -> String {
        with_timeout(async {
            loop {
                if let Some(line) = self.lines().into_iter().find(|line| line.contains(text)) {
                    return line;
                }
                tokio::time::sleep(POLL).await;
            }
        })
        .await
    }

    /// Closes the log after its next line.
    pub fn close_log(&self) {
        self.close.store(true, Ordering::Relaxed);
    }

    pub fn signal(&self, name: &str) {
        let sent = Command::new("kill").args([format!("-{name}"), self.child.id().to_string()]).status().unwrap();
        assert!(sent.success());
    }

    /// Waits for the exit and returns the exit code and the whole log.
    pub async fn ended(mut self) -> (Option<i32>, Vec<String>) {
        let status = with_timeout(async {
            loop {
                if let Some(status) = self.child.try_wait().unwrap() {
                    break status;
                }
                tokio::time::sleep(POLL).await;
            }
        });
        let code = status.await.code();
        self.reader.take().unwrap().join().unwrap();
        (code, self.lines())
    }
}

impl Drop for Binary {
    fn drop(&mut self) {
        // The process may have exited already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
