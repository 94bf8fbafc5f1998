//! TLS on both addresses: server and client certificates, protocols, and errors of files.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use axum::body::Body;
use axum::http::{Request, Version};
use hyper_rustls::HttpsConnectorBuilder;
use hyper_util::client::legacy::Client;
use hyper_util::rt::TokioExecutor;
use qedgix::config::{Config, TlsFiles};
use qedgix::server::Listeners;
use qedgix::wire::v1;
use qedgix::wire::v1::policy_service_client::PolicyServiceClient;
use rustls::pki_types::CertificateDer;
use rustls::pki_types::pem::PemObject;
use rustls::{ClientConfig, RootCertStore};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tonic::transport::Channel;

pub use super::super::certificates::{Authority, caller, channel, write};
use super::super::harness::*;
use super::{key, signed};

/// `GET` over TLS: the status and the negotiated HTTP version.
pub async fn get(caller: &ClientConfig, http2: bool, url: &str) -> Result<(u16, Version), String> {
    let builder = HttpsConnectorBuilder::new().with_tls_config(caller.clone()).https_only();
    let connector = if http2 { builder.enable_all_versions().build() } else { builder.enable_http1().build() };
    let client = Client::builder(TokioExecutor::new()).build(connector);
    let request = Request::get(url).body(Body::empty()).unwrap();
    let answer = with_timeout(client.request(request)).await.map_err(|e| format!("{e:?}"))?;
    Ok((answer.status().as_u16(), answer.version()))
}

/// Lists policies. A handshake that the server aborts fails here at the latest.
pub async fn policies(channel: Channel) -> Result<usize, String> {
    let mut client = PolicyServiceClient::new(channel);
    let answer = with_timeout(client.list_policies(v1::ListPoliciesRequest::default())).await;
    answer.map(|answer| answer.into_inner().policies.len()).map_err(|status| format!("{status:?}"))
}

async fn over_tls(dir: &Path, authority: &Authority, clients: Option<&Authority>) -> Server {
    let files = write(dir, &authority.issue(), clients);
    Server::with(|config| config.tls = Some(files)).await
}

#[tokio::test]
async fn both_addresses_use_tls() {
    let (dir, authority) = (tempfile::tempdir().unwrap(), Authority::new("ours"));
    let server = over_tls(dir.path(), &authority, None).await;
    let url = format!("https://localhost:{}/v1/policies", server.endpoints.http.port());
    let trusting = caller(&authority, None);
    assert_eq!(get(&trusting, false, &url).await, Ok((200, Version::HTTP_11)));
    assert_eq!(get(&trusting, true, &url).await, Ok((200, Version::HTTP_2)));
    assert!(policies(channel(&trusting, server.endpoints.grpc).await.unwrap()).await.unwrap() > 5);
    // TLS 1.2 and TLS 1.3.
    for version in [&rustls::version::TLS12, &rustls::version::TLS13] {
        let mut roots = RootCertStore::empty();
        roots.add(CertificateDer::from_pem_slice(authority.pem().as_bytes()).unwrap()).unwrap();
        let builder = ClientConfig::builder_with_provider(Arc::new(rustls::crypto::ring::default_provider()));
        let config = builder.with_protocol_versions(&[version]).unwrap().with_root_certificates(roots).with_no_client_auth();
        assert_eq!(get(&config, false, &url).await, Ok((200, Version::HTTP_11)));
    }
    // A client that trusts another authority refuses the server.
    let stranger = caller(&Authority::new("theirs"), None);
    assert!(get(&stranger, false, &url).await.unwrap_err().contains("UnknownIssuer"));
    assert!(channel(&stranger, server.endpoints.grpc).await.unwrap_err().contains("UnknownIssuer"));
    // API keys work the same with TLS.
    let admin = key(&server, "admin").await;
    assert_eq!(get(&trusting, true, &url).await.unwrap().0, 401);
    let mut client = PolicyServiceClient::new(channel(&trusting, server.endpoints.grpc).await.unwrap());
    client.list_policies(signed(&admin, v1::ListPoliciesRequest::default())).await.unwrap();
}

#[tokio::test]
async fn client_certificates_are_required_and_verified() {
    let (dir, ours, clients) = (tempfile::tempdir().unwrap(), Authority::new("ours"), Authority::new("clients"));
    let server = over_tls(dir.path(), &ours, Some(&clients)).await;
    let url = format!("https://localhost:{}/livez", server.endpoints.http.port());
    let (known, unknown) = (clients.issue(), ours.issue());
    let with = |identity| caller(&ours, identity);
    assert_eq!(get(&with(Some(&known)), false, &url).await.map(|answer| answer.0), Ok(200));
    let connected = channel(&with(Some(&known)), server.endpoints.grpc).await.unwrap();
    assert!(policies(connected).await.is_ok());
    // Missing and foreign certificates are refused, and the server continues.
    for identity in [None, Some(&unknown)] {
        assert!(get(&with(identity), false, &url).await.is_err());
        let refused = match channel(&with(identity), server.endpoints.grpc).await {
            Ok(channel) => policies(channel).await.map(drop),
            Err(e) => Err(e),
        };
        assert!(refused.is_err());
    }
    assert_eq!(get(&with(Some(&known)), true, &url).await.map(|answer| answer.0), Ok(200));
}

/// Sends bytes and returns what the server sends until it closes the connection.
async fn send(address: std::net::SocketAddr, bytes: &[u8]) -> Vec<u8> {
    let mut stream = TcpStream::connect(address).await.unwrap();
    stream.write_all(bytes).await.unwrap();
    let mut answer = Vec::new();
    // A reset counts as closed.
    let _ = with_timeout(stream.read_to_end(&mut answer)).await;
    answer
}

#[tokio::test]
async fn connections_without_tls_are_closed() {
    let (dir, authority) = (tempfile::tempdir().unwrap(), Authority::new("ours"));
    let server = over_tls(dir.path(), &authority, None).await;
    for address in [server.endpoints.grpc, server.endpoints.http] {
        for bytes in [&b"GET / HTTP/1.1\r\nhost: x\r\n\r\n"[..], b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n", &[0; 1000], &[0x16; 5000]] {
            let answer = send(address, bytes).await;
            assert!(!answer.starts_with(b"HTTP/1.1 2"), "{answer:?}");
        }
    }
    // TLS sent to a server without TLS.
    let plain = Server::start().await;
    let trusting = caller(&authority, None);
    assert!(get(&trusting, false, &format!("https://{}/livez", plain.endpoints.http)).await.is_err());
    assert!(channel(&trusting, plain.endpoints.grpc).await.is_err());
    assert_eq!(reqwest::get(plain.url("/livez")).await.unwrap().status(), 200);
    let url = format!("https://{}/livez", server.endpoints.http);
    assert_eq!(get(&trusting, false, &url).await.map(|answer| answer.0), Ok(200));
}

#[tokio::test]
async fn errors_of_tls_files_name_flag_and_path() {
    let dir = tempfile::tempdir().unwrap();
    let (authority, other) = (Authority::new("ours"), Authority::new("others"));
    let good = write(dir.path(), &authority.issue(), Some(&other));
    let path = |name: &str| dir.path().join(name);
    std::fs::write(path("empty.pem"), "").unwrap();
    std::fs::write(path("garbage.pem"), "-----BEGIN CERTIFICATE-----\nqdx\n-----END CERTIFICATE-----\n").unwrap();
    std::fs::write(path("other.pem"), authority.issue().key).unwrap();
    type Change = fn(&mut TlsFiles, PathBuf);
    let cases: [(&str, &str, Change); 7] = [
        ("--tls-cert", "missing.pem", |files, path| files.cert = path),
        ("--tls-cert", "empty.pem", |files, path| files.cert = path),
        ("--tls-cert", "key.pem", |files, path| files.cert = path),
        ("--tls-key", "cert.pem", |files, path| files.key = path),
        ("--tls-key", "other.pem", |files, path| files.key = path),
        ("--tls-client-ca", "missing.pem", |files, path| files.client_ca = Some(path)),
        ("--tls-client-ca", "garbage.pem", |files, path| files.client_ca = Some(path)),
    ];
    for (flag, name, change) in cases {
        let mut config = Config::new(dir.path());
        (config.grpc_addr, config.http_addr) = (([127, 0, 0, 1], 0).into(), ([127, 0, 0, 1], 0).into());
        let mut files = good.clone();
        change(&mut files, path(name));
        config.tls = Some(files);
        let error = Listeners::bind(&config).await.unwrap_err();
        let qedgix::server::Error::Config(invalid) = error else { panic!("{error}") };
        assert_eq!((invalid.field.as_str(), invalid.value), (flag, Some(path(name).display().to_string())));
    }
}
