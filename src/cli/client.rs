//! A client of the REST interface for commands that use a server.

use std::io::Write;
use std::time::Duration;

use anyhow::Context;
use axum::http::{HeaderMap, Method, Uri, header};
use clap::Args;
use indicatif::ProgressBar;
use reqwest::Response;
use reqwest::redirect::Policy;
use serde_json::Value;

use super::connect::ConnectArgs;
use super::ports;
use super::upload::Upload;

/// Timeout of a request.
const TIMEOUT: Duration = Duration::from_secs(60);
/// Timeout of an upload or download of a checkpoint.
const TRANSFER_TIMEOUT: Duration = Duration::from_secs(600);
/// Timeout for opening a connection.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(20);

/// The REST address of a server, and how to connect to it.
#[derive(Args, Debug)]
pub struct RestArgs {
    /// REST address of the server
    #[arg(long, global = true, env = "QEDGIX_SERVER", default_value = "127.0.0.1:8080", value_name = "HOST:PORT")]
    server: String,
    #[command(flatten)]
    connect: ConnectArgs,
}

impl RestArgs {
    /// A client of the server.
    ///
    /// # Errors
    /// As [`Client::new`].
    pub fn client(&self) -> anyhow::Result<Client> {
        Client::new(&self.server, &self.connect)
    }
}

/// A client of one server.
#[derive(Clone, Debug)]
pub struct Client {
    http: reqwest::Client,
    url: Uri,
    base: String,
    connect: ConnectArgs,
}

/// Why a request failed.
#[derive(Debug, thiserror::Error)]
pub enum ClientError {
    /// The server refused it.
    #[error("{path}: {detail}{}", in_brackets(.code))]
    Refused {
        /// Path of the request.
        path: String,
        /// HTTP status.
        status: u16,
        /// Code of the error; empty if the response has none.
        code: String,
        /// What is wrong.
        detail: String,
    },
    /// No response arrived, or not all of it.
    #[error("{problem}")]
    Unreachable {
        /// What happened, with the address.
        problem: String,
        /// The cause.
        #[source]
        source: reqwest::Error,
    },
    /// The address is that of another port.
    #[error("{0} is the gRPC port of the server; expected its REST port (--http-addr of `qedgix serve`)")]
    GrpcPort(String),
}

fn in_brackets(code: &str) -> String {
    if code.is_empty() { String::new() } else { format!(" ({code})") }
}

impl ClientError {
    /// Whether the same request may succeed later: the server restarts, drains, or has too much to do.
    pub fn is_temporary(&self) -> bool {
        match self {
            Self::Refused { status, .. } => matches!(status, 429 | 502 | 503 | 504),
            Self::Unreachable { .. } => true,
            Self::GrpcPort(_) => false,
        }
    }
}

/// A request: its method, path, and body with its media type.
struct Request<'a> {
    method: Method,
    path: &'a str,
    body: Option<(&'a str, reqwest::Body)>,
    idempotency_key: Option<&'a str>,
    /// None: the response may take for ever.
    timeout: Option<Duration>,
}

impl<'a> Request<'a> {
    fn new(method: Method, path: &'a str) -> Self {
        Self { method, path, body: None, idempotency_key: None, timeout: Some(TIMEOUT) }
    }

    fn json(method: Method, path: &'a str, body: &Value) -> Self {
        Self { body: Some(("application/json", body.to_string().into())), ..Self::new(method, path) }
    }
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
            .connect_timeout(CONNECT_TIMEOUT)
            .no_proxy()
            .build()
            .context("cannot create an HTTP client")?;
        Ok(Self { http, base: url.to_string().trim_end_matches('/').to_owned(), url, connect: args.clone() })
    }

    /// The URL of the server.
    pub fn base(&self) -> &str {
        &self.base
    }

    /// `GET path`.
    ///
    /// # Errors
    /// The server cannot be reached, or returns an error, whose detail and code the message contains.
    pub async fn get(&self, path: &str) -> Result<Value, ClientError> {
        self.value(Request::new(Method::GET, path)).await
    }

    /// `POST path` with a JSON body.
    ///
    /// # Errors
    /// As [`Client::get`].
    pub async fn post(&self, path: &str, body: &Value) -> Result<Value, ClientError> {
        self.value(Request::json(Method::POST, path, body)).await
    }

    /// `POST path` with a JSON body and an idempotency key.
    ///
    /// # Errors
    /// As [`Client::get`].
    pub async fn post_once(&self, path: &str, body: &Value, key: &str) -> Result<Value, ClientError> {
        self.value(Request { idempotency_key: Some(key), ..Request::json(Method::POST, path, body) }).await
    }

    /// `PUT path` with a JSON body.
    ///
    /// # Errors
    /// As [`Client::get`].
    pub async fn put(&self, path: &str, body: &Value) -> Result<Value, ClientError> {
        self.value(Request::json(Method::PUT, path, body)).await
    }

    /// `DELETE path`.
    ///
    /// # Errors
    /// As [`Client::get`].
    pub async fn delete(&self, path: &str) -> Result<Value, ClientError> {
        self.value(Request::new(Method::DELETE, path)).await
    }

    /// `POST path` with a binary body, which moves the bar. The timeout is 10 minutes.
    ///
    /// # Errors
    /// As [`Client::get`].
    pub async fn upload(&self, path: &str, bytes: Vec<u8>, bar: &ProgressBar) -> Result<Value, ClientError> {
        let body = reqwest::Body::wrap(Upload { bytes: bytes.into(), bar: bar.clone() });
        let body = Some(("application/octet-stream", body));
        self.value(Request { body, timeout: Some(TRANSFER_TIMEOUT), ..Request::new(Method::POST, path) }).await
    }

    /// `GET path`, which returns binary data. The timeout is 10 minutes.
    ///
    /// # Errors
    /// As [`Client::get`].
    pub async fn download(&self, path: &str) -> Result<Vec<u8>, ClientError> {
        let response = self.send(Request { timeout: Some(TRANSFER_TIMEOUT), ..Request::new(Method::GET, path) }).await?;
        Ok(response.bytes().await.map_err(|error| self.unreachable(path, error))?.into())
    }

    /// `GET path`, and writes the response to `out` as it arrives. The timeout is 10 minutes.
    ///
    /// # Errors
    /// As [`Client::get`]; or `out` cannot be written.
    pub async fn download_into(&self, path: &str, out: &mut impl Write) -> anyhow::Result<()> {
        let mut response = self.send(Request { timeout: Some(TRANSFER_TIMEOUT), ..Request::new(Method::GET, path) }).await?;
        while let Some(bytes) = response.chunk().await.map_err(|error| self.unreachable(path, error))? {
            out.write_all(&bytes)?;
        }
        Ok(())
    }

    /// `GET path`, whose response is read as it arrives and may take for ever.
    ///
    /// # Errors
    /// As [`Client::get`].
    pub async fn stream(&self, path: &str) -> Result<Response, ClientError> {
        self.send(Request { timeout: None, ..Request::new(Method::GET, path) }).await
    }

    async fn value(&self, request: Request<'_>) -> Result<Value, ClientError> {
        let path = request.path.to_owned();
        let body = self.send(request).await?.bytes().await.map_err(|error| self.unreachable(&path, error))?;
        Ok(serde_json::from_slice(&body).unwrap_or(Value::Null))
    }

    /// Sends a request and returns a successful response.
    async fn send(&self, request: Request<'_>) -> Result<Response, ClientError> {
        let Request { method, path, body, idempotency_key, timeout } = request;
        let mut sent = self.http.request(method, format!("{}{path}", self.base));
        if let Some(timeout) = timeout {
            sent = sent.timeout(timeout);
        }
        if let Some((media_type, body)) = body {
            sent = sent.header(header::CONTENT_TYPE, media_type).body(body);
        }
        if let Some(key) = idempotency_key {
            sent = sent.header("idempotency-key", key);
        }
        let response = match sent.send().await {
            Ok(response) => response,
            // Something listens there, and does not speak HTTP/1.
            Err(error) if !error.is_connect() && !error.is_timeout() && ports::is_grpc(&self.url, &self.connect).await => {
                return Err(ClientError::GrpcPort(self.base.clone()));
            }
            Err(error) => return Err(self.unreachable(path, error)),
        };
        let status = response.status();
        if status.is_success() {
            return Ok(response);
        }
        let body = response.bytes().await.map_err(|error| self.unreachable(path, error))?;
        let problem: Value = serde_json::from_slice(&body).unwrap_or(Value::Null);
        Err(ClientError::Refused {
            path: path.to_owned(),
            status: status.as_u16(),
            code: problem["code"].as_str().unwrap_or_default().to_owned(),
            detail: problem["detail"].as_str().unwrap_or(status.as_str()).to_owned(),
        })
    }

    fn unreachable(&self, path: &str, error: reqwest::Error) -> ClientError {
        let url = format!("{}{path}", self.base);
        let problem = if error.is_timeout() {
            format!("{url}: no response in time")
        } else if error.is_body() || error.is_decode() {
            format!("{url}: the response is incomplete")
        } else {
            format!("cannot reach {url}")
        };
        ClientError::Unreachable { problem, source: error.without_url() }
    }
}
