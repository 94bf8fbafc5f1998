//! A client of the REST interface for commands that use a server.

use std::time::Duration;

use anyhow::{Context, bail};
use axum::http::{HeaderMap, Method, header};
use reqwest::redirect::Policy;
use serde_json::Value;

use super::connect::ConnectArgs;

/// Timeout of a request.
const TIMEOUT: Duration = Duration::from_secs(60);
/// Timeout of an upload or download of a checkpoint.
const TRANSFER_TIMEOUT: Duration = Duration::from_secs(600);
/// Time between two queries of a job's state.
const JOB_POLL: Duration = Duration::from_millis(250);

/// A client of one server.
#[derive(Clone, Debug)]
pub struct Client {
    http: reqwest::Client,
    base: String,
}

impl Client {
    /// Creates a client of the server at `address`: `HOST:PORT`, `http://HOST:PORT` or `https://HOST:PORT`.
    ///
    /// # Errors
    /// The address, the API key or a certificate is invalid.
    pub fn new(address: &str, args: &ConnectArgs) -> anyhow::Result<Self> {
        let url = args.url(address)?;
        let headers: HeaderMap = args.authorization(&url)?.map(|value| (header::AUTHORIZATION, value)).into_iter().collect();
        let http = reqwest::Client::builder()
            .tls_backend_preconfigured(args.tls(&url)?)
            .default_headers(headers)
            .redirect(Policy::none())
            .no_proxy()
            .build()
            .context("cannot create an HTTP client")?;
        Ok(Self { http, base: url.to_string().trim_end_matches('/').to_owned() })
    }

    /// `GET path`.
    ///
    /// # Errors
    /// The server cannot be reached, or returns an error, whose detail and code the message contains.
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

    /// `POST path` with a binary body. The timeout is 10 minutes.
    ///
    /// # Errors
    /// As [`Client::get`].
    pub async fn upload(&self, path: &str, bytes: Vec<u8>) -> anyhow::Result<Value> {
        let body = self.send(Method::POST, path, Some(("application/octet-stream", bytes)), TRANSFER_TIMEOUT).await?;
        Ok(serde_json::from_slice(&body).unwrap_or(Value::Null))
    }

    /// `GET path`, which returns binary data. The timeout is 10 minutes.
    ///
    /// # Errors
    /// As [`Client::get`].
    pub async fn download(&self, path: &str) -> anyhow::Result<Vec<u8>> {
        self.send(Method::GET, path, None, TRANSFER_TIMEOUT).await
    }

    async fn json(&self, method: Method, path: &str, body: Option<&Value>) -> anyhow::Result<Value> {
        let body = body.map(|body| ("application/json", body.to_string().into_bytes()));
        let response = self.send(method, path, body, TIMEOUT).await?;
        Ok(serde_json::from_slice(&response).unwrap_or(Value::Null))
    }

    /// Sends a request, with the media type and bytes of its body, and returns the body of a successful response.
    async fn send(
        &self,
        method: Method,
        path: &str,
        body: Option<(&str, Vec<u8>)>,
        timeout: Duration,
    ) -> anyhow::Result<Vec<u8>> {
        let url = format!("{}{path}", self.base);
        let mut request = self.http.request(method, &url).timeout(timeout);
        if let Some((media_type, bytes)) = body {
            request = request.header(header::CONTENT_TYPE, media_type).body(bytes);
        }
        let failed = |error: reqwest::Error| {
            let problem = if error.is_timeout() {
                format!("{url}: no response within {} s", timeout.as_secs())
            } else if error.is_body() || error.is_decode() {
                format!("{url}: the response is incomplete")
            } else {
                format!("cannot reach {url}")
            };
            anyhow::Error::new(error.without_url()).context(problem)
        };
        let response = request.send().await.map_err(failed)?;
        let status = response.status();
        let body = response.bytes().await.map_err(failed)?;
        if !status.is_success() {
            let problem: Value = serde_json::from_slice(&body).unwrap_or(Value::Null);
            let code = problem["code"].as_str().map(|code| format!(" ({code})")).unwrap_or_default();
            bail!("{path}: {}{code}", problem["detail"].as_str().unwrap_or(status.as_str()));
        }
        Ok(body.into())
    }

    /// Waits until a job has ended, and calls `report` with the job at every poll.
    ///
    /// # Errors
    /// The server cannot be reached, or the job failed or was cancelled.
    pub async fn wait_for_job(&self, id: &str, mut report: impl FnMut(&Value)) -> anyhow::Result<Value> {
        loop {
            let job = self.get(&format!("/v1/jobs/{id}")).await?;
            report(&job);
            match job["state"].as_str() {
                Some("succeeded") => return Ok(job),
                Some("failed") => bail!("job {id} failed: {}", job["reason"].as_str().unwrap_or("no reason given")),
                Some("cancelled") => bail!("job {id} was cancelled"),
                _ => tokio::time::sleep(JOB_POLL).await,
            }
        }
    }
}
