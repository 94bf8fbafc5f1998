//! A certificate authority, the TLS files of a server, and clients that trust it.
#![allow(dead_code)] // each test binary uses its part

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use axum::http::Uri;
use hyper_rustls::HttpsConnectorBuilder;
use qedgix::config::TlsFiles;
use rcgen::{BasicConstraints, CertificateParams, CertifiedIssuer, DnType, IsCa, KeyPair};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::{ClientConfig, RootCertStore};
use tonic::transport::{Channel, Endpoint};

/// A certificate authority.
pub struct Authority(CertifiedIssuer<'static, KeyPair>);

/// A certificate and its key, in PEM.
pub struct Identity {
    pub cert: String,
    pub key: String,
}

impl Authority {
    pub fn new(name: &str) -> Self {
        let mut params = CertificateParams::new(Vec::new()).unwrap();
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        params.distinguished_name.push(DnType::CommonName, name);
        Self(CertifiedIssuer::self_signed(params, KeyPair::generate().unwrap()).unwrap())
    }

    pub fn pem(&self) -> String {
        self.0.pem()
    }

    /// Issues a certificate for this machine or for a client.
    pub fn issue(&self) -> Identity {
        let key = KeyPair::generate().unwrap();
        let params = CertificateParams::new(vec!["127.0.0.1".into(), "localhost".into()]).unwrap();
        Identity { cert: params.signed_by(&key, &self.0).unwrap().pem(), key: key.serialize_pem() }
    }
}

/// Writes the TLS files of a server.
pub fn write(dir: &Path, identity: &Identity, client_ca: Option<&Authority>) -> TlsFiles {
    let file = |name: &str, text: &str| -> PathBuf {
        std::fs::write(dir.join(name), text).unwrap();
        dir.join(name)
    };
    TlsFiles {
        cert: file("cert.pem", &identity.cert),
        key: file("key.pem", &identity.key),
        client_ca: client_ca.map(|authority| file("clients.pem", &authority.pem())),
    }
}

/// TLS configuration of a client that trusts `trusted`, with an optional client certificate.
pub fn caller(trusted: &Authority, identity: Option<&Identity>) -> ClientConfig {
    let mut roots = RootCertStore::empty();
    roots.add(CertificateDer::from_pem_slice(trusted.pem().as_bytes()).unwrap()).unwrap();
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let builder = ClientConfig::builder_with_provider(provider).with_safe_default_protocol_versions().unwrap();
    let builder = builder.with_root_certificates(roots);
    let Some(identity) = identity else { return builder.with_no_client_auth() };
    let certs = vec![CertificateDer::from_pem_slice(identity.cert.as_bytes()).unwrap()];
    builder.with_client_auth_cert(certs, PrivateKeyDer::from_pem_slice(identity.key.as_bytes()).unwrap()).unwrap()
}

/// A gRPC channel over TLS to `address`, as `127.0.0.1:50051`.
pub async fn channel(caller: &ClientConfig, address: impl std::fmt::Display) -> Result<Channel, String> {
    let connector = HttpsConnectorBuilder::new().with_tls_config(caller.clone()).https_only().enable_http2().build();
    let uri: Uri = format!("https://{address}").parse().unwrap();
    let connected = tokio::time::timeout(Duration::from_secs(60), Endpoint::from(uri).connect_with_connector(connector)).await;
    connected.expect("connecting does not hang").map_err(|e| format!("{e:?}"))
}
