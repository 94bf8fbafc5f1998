//! A server's REST interface, as the command line uses it.

use std::time::Duration;

use anyhow::{Context, bail};
use reqwest::header::CONTENT_TYPE;
use serde_json::Value;

/// Time for a checkpoint to go over.
const TRANSFER: Duration = Duration::from_secs(600);

/// A server to talk to.
#[derive(Clone, Debug)]
pub struct Client {
    http: reqwest::Client,
    base: String,
}

impl Client {
    /// For a server at `address`: `HOST:PORT` or `http://HOST:PORT`.
    ///
    /// # Errors
    /// The HTTP client cannot be built.
    pub fn new(address: &str) -> anyhow::Result<Self> {
        let address = address.trim_end_matches('/');
        let base = if address.contains("://") { address.to_owned() } else { format!("http://{address}") };
        let http = reqwest::Client::builder().timeout(Duration::from_secs(60)).build()?;
        Ok(Self { http, base })
    }

    /// `GET path`.
    ///
    /// # Errors
    /// The server cannot be reached or answers with a problem, whose detail is told.
    pub async fn get(&self, path: &str) -> anyhow::Result<Value> {
        self.answer(self.http.get(format!("{}{path}", self.base)), path).await
    }

    /// `POST path` with a JSON body.
    ///
    /// # Errors
    /// As [`Client::get`].
    pub async fn post(&self, path: &str, body: &Value) -> anyhow::Result<Value> {
        self.answer(self.http.post(format!("{}{path}", self.base)).json(body), path).await
    }

    /// `PUT path` with a JSON body.
    ///
    /// # Errors
    /// As [`Client::get`].
    pub async fn put(&self, path: &str, body: &Value) -> anyhow::Result<Value> {
        self.answer(self.http.put(format!("{}{path}", self.base)).json(body), path).await
    }

    /// `DELETE path`.
    ///
    /// # Errors
    /// As [`Client::get`].
    pub async fn delete(&self, path: &str) -> anyhow::Result<Value> {
        self.answer(self.http.delete(format!("{}{path}", self.base)), path).await
    }

    /// `POST path` with a body of bytes, which may take a while.
    ///
    /// # Errors
    /// As [`Client::get`].
    pub async fn upload(&self, path: &str, bytes: Vec<u8>) -> anyhow::Result<Value> {
        let request = self.http.post(format!("{}{path}", self.base)).body(bytes).timeout(TRANSFER);
        self.answer(request.header(CONTENT_TYPE, "application/octet-stream"), path).await
    }

    /// `GET path` of bytes, which may take a while.
    ///
    /// # Errors
    /// As [`Client::get`].
    pub async fn download(&self, path: &str) -> anyhow::Result<Vec<u8>> {
        self.body(self.http.get(format!("{}{path}", self.base)).timeout(TRANSFER), path).await
    }

    async fn answer(&self, request: reqwest::RequestBuilder, path: &str) -> anyhow::Result<Value> {
        let body = self.body(request, path).await?;
        Ok(serde_json::from_slice(&body).unwrap_or(Value::Null))
    }

    async fn body(&self, request: reqwest::RequestBuilder, path: &str) -> anyhow::Result<Vec<u8>> {
        let response = request.send().await.with_context(|| format!("cannot reach {}{path}", self.base))?;
        let status = response.status();
        let body = response.bytes().await.with_context(|| format!("{path}: the answer broke off"))?;
        if !status.is_success() {
            let problem: Value = serde_json::from_slice(&body).unwrap_or(Value::Null);
            bail!("{path}: {}", problem["detail"].as_str().unwrap_or(status.as_str()));
        }
        Ok(body.into())
    }

    /// Waits for a job to end; `tell` is shown the job every quarter of a second.
    ///
    /// # Errors
    /// The server cannot be reached any more, or the job failed or was cancelled.
    pub async fn wait_for_job(&self, id: &str, mut tell: impl FnMut(&Value)) -> anyhow::Result<Value> {
        loop {
            let job = self.get(&format!("/v1/jobs/{id}")).await?;
            tell(&job);
            match job["state"].as_str() {
                Some("succeeded") => return Ok(job),
                Some("failed") => bail!("job {id} failed: {}", job["reason"].as_str().unwrap_or("no reason given")),
                Some("cancelled") => bail!("job {id} was cancelled"),
                _ => tokio::time::sleep(Duration::from_millis(250)).await,
            }
        }
    }
}
