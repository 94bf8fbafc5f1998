//! A server's REST interface, as the command line uses it.

use std::time::Duration;

use anyhow::{Context, bail};
use axum::body::{Body, to_bytes};
use axum::http::{HeaderValue, Method, Request, header};
use hyper_util::client::legacy::Client as Http;
use hyper_util::rt::{TokioExecutor, TokioTimer};
use serde_json::Value;

use super::connect::{ConnectArgs, Connector};

/// Time that a request may take.
const PATIENCE: Duration = Duration::from_secs(60);
/// Time for a checkpoint to go over.
const TRANSFER: Duration = Duration::from_secs(600);
/// Largest answer, in bytes.
const LARGEST: usize = 1 << 30;

/// A server to talk to.
#[derive(Clone, Debug)]
pub struct Client {
    http: Http<Connector, Body>,
    base: String,
    authorization: Option<HeaderValue>,
}

impl Client {
    /// For a server at `address`: `HOST:PORT`, `http://HOST:PORT` or `https://HOST:PORT`.
    ///
    /// # Errors
    /// It is no address, or the API key or a certificate cannot be used.
    pub fn new(address: &str, how: &ConnectArgs) -> anyhow::Result<Self> {
        let url = how.url(address)?;
        let http = Http::builder(TokioExecutor::new()).pool_timer(TokioTimer::new()).build(how.connector(&url, false)?);
        let base = url.to_string().trim_end_matches('/').to_owned();
        Ok(Self { http, base, authorization: how.authorization()? })
    }

    /// `GET path`.
    ///
    /// # Errors
    /// The server cannot be reached or answers with a problem, whose detail is told.
    pub async fn get(&self, path: &str) -> anyhow::Result<Value> {
        self.json(Method::GET, path, None).await
    }

    /// `POST path` with a JSON body.
    ///
    /// # Errors
    /// As [`Client::get`].
    pub async fn post(&self, path: &str, body: &Value) -> anyhow::Result<Value> {
        self.json(Method::POST, path, Some(body)).await
    }

    /// `PUT path` with a JSON body.
    ///
    /// # Errors
    /// As [`Client::get`].
    pub async fn put(&self, path: &str, body: &Value) -> anyhow::Result<Value> {
        self.json(Method::PUT, path, Some(body)).await
    }

    /// `DELETE path`.
    ///
    /// # Errors
    /// As [`Client::get`].
    pub async fn delete(&self, path: &str) -> anyhow::Result<Value> {
        self.json(Method::DELETE, path, None).await
    }

    /// `POST path` with a body of bytes, which may take a while.
    ///
    /// # Errors
    /// As [`Client::get`].
    pub async fn upload(&self, path: &str, bytes: Vec<u8>) -> anyhow::Result<Value> {
        let body = self.bytes(Method::POST, path, Some(("application/octet-stream", bytes)), TRANSFER).await?;
        Ok(serde_json::from_slice(&body).unwrap_or(Value::Null))
    }

    /// `GET path` of bytes, which may take a while.
    ///
    /// # Errors
    /// As [`Client::get`].
    pub async fn download(&self, path: &str) -> anyhow::Result<Vec<u8>> {
        self.bytes(Method::GET, path, None, TRANSFER).await
    }

    async fn json(&self, method: Method, path: &str, body: Option<&Value>) -> anyhow::Result<Value> {
        let body = body.map(|body| ("application/json", body.to_string().into_bytes()));
        let answer = self.bytes(method, path, body, PATIENCE).await?;
        Ok(serde_json::from_slice(&answer).unwrap_or(Value::Null))
    }

    /// Sends a request, with a body and its type, and returns the body of an answer that went well.
    async fn bytes(
        &self,
        method: Method,
        path: &str,
        body: Option<(&str, Vec<u8>)>,
        patience: Duration,
    ) -> anyhow::Result<Vec<u8>> {
        let mut request = Request::builder().method(method).uri(format!("{}{path}", self.base));
        if let Some(value) = &self.authorization {
            request = request.header(header::AUTHORIZATION, value);
        }
        if let Some((kind, _)) = &body {
            request = request.header(header::CONTENT_TYPE, *kind);
        }
        let request = request.body(body.map_or_else(Body::empty, |(_, bytes)| Body::from(bytes)))?;
        let answered = async {
            let answer = self.http.request(request).await.with_context(|| format!("cannot reach {}{path}", self.base))?;
            let (head, body) = answer.into_parts();
            let body = to_bytes(Body::new(body), LARGEST).await.with_context(|| format!("{path}: the answer broke off"))?;
            anyhow::Ok((head.status, body))
        };
        let answered = tokio::time::timeout(patience, answered).await;
        let (status, body) = answered.with_context(|| format!("{}{path}: no answer in {patience:?}", self.base))??;
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
