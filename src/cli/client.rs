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
/// Largest answer, in bytes.
const LARGEST: usize = 256 << 20;

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
        self.answer(Method::GET, path, Body::empty()).await
    }

    /// `POST path` with a JSON body.
    ///
    /// # Errors
    /// As [`Client::get`].
    pub async fn post(&self, path: &str, body: &Value) -> anyhow::Result<Value> {
        self.answer(Method::POST, path, Body::from(body.to_string())).await
    }

    async fn answer(&self, method: Method, path: &str, body: Body) -> anyhow::Result<Value> {
        let mut request = Request::builder().method(method).uri(format!("{}{path}", self.base));
        request = request.header(header::CONTENT_TYPE, "application/json");
        if let Some(value) = &self.authorization {
            request = request.header(header::AUTHORIZATION, value);
        }
        let request = request.body(body)?;
        let answered = async {
            let answer = self.http.request(request).await.with_context(|| format!("cannot reach {}{path}", self.base))?;
            let (head, body) = answer.into_parts();
            let body = to_bytes(Body::new(body), LARGEST).await.with_context(|| format!("{path}: the answer broke off"))?;
            anyhow::Ok((head.status, body))
        };
        let answered = tokio::time::timeout(PATIENCE, answered).await;
        let (status, body) = answered.with_context(|| format!("{}{path}: no answer in {PATIENCE:?}", self.base))??;
        let json: Value = serde_json::from_slice(&body).unwrap_or(Value::Null);
        if !status.is_success() {
            bail!("{path}: {}", json["detail"].as_str().unwrap_or(status.as_str()));
        }
        Ok(json)
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
