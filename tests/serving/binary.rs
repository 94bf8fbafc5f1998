//! The program itself, as operators run it: its own process, its logs, its signals.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use qedgix::wire::v1::policy_service_client::PolicyServiceClient;
use serde_json::Value;
use tonic::transport::Channel;

use super::harness::soon;

/// A `qedgix serve` on free ports; killed when dropped.
pub struct Binary {
    child: Child,
    pub grpc: String,
    pub http: String,
    lines: Arc<Mutex<Vec<String>>>,
    reader: Option<std::thread::JoinHandle<()>>,
}

const POLL: Duration = Duration::from_millis(5);

impl Binary {
    pub async fn start(dir: &Path, flags: &[&str]) -> Self {
        let endpoints = dir.join(qedgix::server::ENDPOINTS);
        // What a server that was killed has left.
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
        let reader = std::thread::spawn(move || {
            for line in BufReader::new(stderr).lines().map_while(Result::ok) {
                kept.lock().unwrap().push(line);
            }
        });
        let mut binary = Self { child, grpc: String::new(), http: String::new(), lines, reader: Some(reader) };
        let text = soon(async {
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

    /// The value of the one sample that begins so; 0 where there is none.
    pub async fn sample(&self, beginning: &str) -> f64 {
        let text = self.metrics().await;
        text.lines()
            .find(|line| line.starts_with(beginning))
            .map_or(0.0, |line| line.rsplit_once(' ').unwrap().1.parse().unwrap())
    }

    /// What it has logged so far.
    pub fn lines(&self) -> Vec<String> {
        self.lines.lock().unwrap().clone()
    }

    /// Waits for a line that holds this text.
    pub async fn says(&self, text: &str) -> String {
        soon(async {
            loop {
                if let Some(line) = self.lines().into_iter().find(|line| line.contains(text)) {
                    return line;
                }
                tokio::time::sleep(POLL).await;
            }
        })
        .await
    }

    pub fn signal(&self, name: &str) {
        let sent = Command::new("kill").args([format!("-{name}"), self.child.id().to_string()]).status().unwrap();
        assert!(sent.success());
    }

    /// Waits for its end: exit code and everything it has logged.
    pub async fn ended(mut self) -> (Option<i32>, Vec<String>) {
        let status = soon(async {
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
        // It may have ended before.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
