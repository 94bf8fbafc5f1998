//! The same inputs on the way that remote callers take: over TLS to the listeners of a server that requires API keys. One request
//! in 16 has a key with one wrong letter.

use std::convert::Infallible;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use axum::body::Body;
use axum::http::{HeaderValue, Request, Response, Uri, header};
use hyper_rustls::{HttpsConnector, HttpsConnectorBuilder};
use hyper_util::client::legacy::Client;
use hyper_util::client::legacy::connect::HttpConnector;
use hyper_util::rt::TokioExecutor;
use qedgix::clock::Clock;
use qedgix::config::Config;
use qedgix::server::{self, DataDir, Endpoints, Listeners};
use qedgix::service::App;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tower::util::BoxCloneSyncService;

use super::certificates::{self, Authority};
use super::process;

/// A server that requires keys, and callers that trust it.
pub struct Secured {
    pub app: Arc<App>,
    key: Arc<str>,
    caller: rustls::ClientConfig,
    endpoints: Endpoints,
}

impl Secured {
    /// Serves on free ports until the runtime ends.
    pub async fn start(dir: &Path, mut config: Config) -> Self {
        let authority = Authority::new("fuzz");
        config.tls = Some(certificates::write(dir, &authority.issue(), None));
        config.grpc_addr.set_port(0);
        config.http_addr.set_port(0);
        let key = process::create_key(dir, "admin").into();
        let data = DataDir::lock(dir).unwrap();
        let listeners = Listeners::bind(&config).await.unwrap();
        let endpoints = listeners.endpoints().unwrap();
        let app = server::open(&config, &data, Clock::system()).await.unwrap();
        let shared = app.clone();
        tokio::spawn(async move { server::run(&config, &data, shared, listeners, std::future::pending()).await.unwrap() });
        Self { app, key, caller: certificates::caller(&authority, None), endpoints }
    }

    fn connector(&self, http2: bool) -> HttpsConnector<HttpConnector> {
        let builder = HttpsConnectorBuilder::new().with_tls_config(self.caller.clone()).https_only();
        let mut connector = HttpConnector::new();
        connector.enforce_http(false);
        // A body after its head would wait for an acknowledgement.
        connector.set_nodelay(true);
        if http2 { builder.enable_http2().wrap_connector(connector) } else { builder.enable_http1().wrap_connector(connector) }
    }

    /// A service that sends requests of REST or, with HTTP/2, of gRPC to the server.
    pub fn service(&self, http2: bool) -> BoxCloneSyncService<Request<Body>, Response<Body>, Infallible> {
        let client = Client::builder(TokioExecutor::new()).http2_only(http2).build(self.connector(http2));
        let address = if http2 { self.endpoints.grpc } else { self.endpoints.http };
        let (key, number) = (Arc::clone(&self.key), Arc::new(AtomicU64::new(0)));
        BoxCloneSyncService::new(tower::service_fn(move |mut request: Request<Body>| {
            let number = number.fetch_add(1, Ordering::Relaxed);
            let wrong = number.is_multiple_of(16);
            direct(&mut request, address, &if wrong { misspelt(&key, number / 16) } else { key.to_string() });
            let answer = client.request(request);
            async move {
                let response = answer.await.unwrap_or_else(|e| panic!("the server cut a connection: {e:?}"));
                let refused =
                    response.status() == 401 || response.headers().get("grpc-status").is_some_and(|status| status == "16");
                assert_eq!(refused, wrong, "{response:?}");
                Ok(response.map(Body::new))
            }
        }))
    }

    /// A handshake, spoilt by `spoil`; what the server answers to it.
    pub async fn shake_hands(&self, spoil: impl FnOnce(&[u8]) -> Vec<u8>) -> (Vec<u8>, String) {
        let name = rustls::pki_types::ServerName::try_from("localhost").unwrap();
        let mut client = rustls::ClientConnection::new(Arc::new(self.caller.clone()), name).unwrap();
        let mut hello = Vec::new();
        client.write_tls(&mut hello).unwrap();
        let input = spoil(&hello);
        let mut stream = TcpStream::connect(self.endpoints.grpc).await.unwrap();
        // The server may have closed the connection already.
        let _ = stream.write_all(&input).await;
        let _ = stream.shutdown().await;
        let mut answer = Vec::new();
        let _ = stream.read_to_end(&mut answer).await;
        let kind = match answer.first() {
            None => "closed",
            Some(21) => "an alert",
            Some(22) => "a handshake",
            Some(_) => "something else",
        };
        (input, kind.to_owned())
    }
}

/// Makes the request one to `address` with this key.
fn direct(request: &mut Request<Body>, address: SocketAddr, key: &str) {
    *request.uri_mut() = format!("https://{address}{}", request.uri().path()).parse::<Uri>().unwrap();
    request.headers_mut().insert(header::AUTHORIZATION, HeaderValue::from_str(&format!("Bearer {key}")).unwrap());
}

/// The key with another letter at a place that depends on `number`.
fn misspelt(key: &str, number: u64) -> String {
    let mut bytes = key.as_bytes().to_vec();
    let at = number as usize % bytes.len();
    bytes[at] = if bytes[at] == b'x' { b'y' } else { b'x' };
    String::from_utf8(bytes).unwrap()
}
