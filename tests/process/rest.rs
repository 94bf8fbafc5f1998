//! A client of the REST interface, and what it reads of a job.

use std::collections::BTreeMap;
use std::time::Duration;

use reqwest::{Method, StatusCode};
use serde_json::Value;

use super::{POLL, within};

/// A client of the REST interface of one server; cheap to clone.
#[derive(Clone)]
pub struct Rest {
    http: String,
    client: reqwest::Client,
}

/// Bits of the metrics by name and step; `None` for measured speeds, which differ between runs.
pub type Rows = BTreeMap<(String, u64), Option<u64>>;

/// The value of a row.
pub fn bits(name: &str, value: f64) -> Option<u64> {
    (name != "env_steps_per_s").then_some(value.to_bits())
}

impl Rest {
    /// `http`: as `http://127.0.0.1:8080`.
    pub fn new(http: String) -> Self {
        // The client requires a TLS provider even for plain HTTP; a later call finds the first one installed.
        let _ = rustls::crypto::ring::default_provider().install_default();
        Self { http, client: reqwest::Client::builder().connect_timeout(Duration::from_secs(5)).build().unwrap() }
    }

    /// The address, as `http://127.0.0.1:8080`.
    pub fn address(&self) -> &str {
        &self.http
    }

    pub fn request(&self, method: Method, path: &str) -> reqwest::RequestBuilder {
        self.client.request(method, format!("{}{path}", self.http))
    }

    pub async fn get(&self, path: &str) -> Value {
        expect(self.request(Method::GET, path), StatusCode::OK).await
    }

    pub async fn post(&self, path: &str) -> Value {
        expect(self.request(Method::POST, path), StatusCode::OK).await
    }

    /// Submits a job and returns its id.
    pub async fn submit(&self, spec: &Value) -> String {
        let job = expect(self.request(Method::POST, "/v1/jobs").json(spec), StatusCode::CREATED).await;
        job["id"].as_str().unwrap().to_owned()
    }

    pub async fn state(&self, id: &str) -> String {
        self.get(&format!("/v1/jobs/{id}")).await["state"].as_str().unwrap().to_owned()
    }

    /// Waits until the job is in this state, and returns it.
    pub async fn reaches(&self, id: &str, state: &str) -> Value {
        within(async {
            loop {
                let job = self.get(&format!("/v1/jobs/{id}")).await;
                if job["state"] == state {
                    return job;
                }
                tokio::time::sleep(POLL).await;
            }
        })
        .await
    }

    /// All metrics of a job, from CSV, which is exact.
    pub async fn rows(&self, id: &str) -> Rows {
        let table =
            self.request(Method::GET, &format!("/v1/jobs/{id}/metrics?format=csv&page_size=100000")).send().await.unwrap();
        let mut rows = Rows::new();
        for line in table.text().await.unwrap().lines().skip(1) {
            let [name, step, value, _] = line.split(',').collect::<Vec<_>>()[..] else { panic!("{line}") };
            let row = bits(name, value.parse().unwrap());
            assert!(rows.insert((name.to_owned(), step.parse().unwrap()), row).is_none(), "{name} at {step} is duplicated");
        }
        rows
    }

    /// SHA-256 of the checkpoints of a job, by kind.
    pub async fn digests(&self, id: &str) -> BTreeMap<String, String> {
        let list = self.get(&format!("/v1/jobs/{id}/checkpoints")).await;
        let text = |value: &Value| value.as_str().unwrap().to_owned();
        list["checkpoints"].as_array().unwrap().iter().map(|c| (text(&c["kind"]), text(&c["sha256"]))).collect()
    }
}

pub async fn expect(request: reqwest::RequestBuilder, status: StatusCode) -> Value {
    let response = request.send().await.unwrap();
    let (got, text) = (response.status(), response.text().await.unwrap());
    assert_eq!(got, status, "{text}");
    serde_json::from_str(&text).unwrap_or(Value::Null)
}
