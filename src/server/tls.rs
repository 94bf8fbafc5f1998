//! TLS of both listeners: files to a configuration, again whenever asked.

use std::path::Path;
use std::sync::{Arc, PoisonError, RwLock};

use rustls::crypto::ring;
use rustls::pki_types::pem::{self, PemObject};
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::server::WebPkiClientVerifier;
use rustls::{RootCertStore, ServerConfig};

use crate::config::TlsFiles;
use crate::invalid::Invalid;

/// The protocol that HTTP/2 is called in handshakes.
pub(super) const H2: &[u8] = b"h2";

/// TLS as it is now.
#[derive(Debug)]
pub struct Tls {
    files: TlsFiles,
    now: RwLock<Configs>,
}

/// The same certificate for either listener: what they speak inside differs.
#[derive(Clone, Debug)]
pub(super) struct Configs {
    pub(super) grpc: Arc<ServerConfig>,
    pub(super) http: Arc<ServerConfig>,
}

impl Tls {
    /// Reads the files.
    ///
    /// # Errors
    /// One that cannot be read or used; flag and path are named.
    pub fn open(files: TlsFiles) -> Result<Self, Invalid> {
        let now = RwLock::new(read(&files)?);
        Ok(Self { files, now })
    }

    /// Reads the files again. New connections use what is in them now, those that exist go on. Files that cannot be used change
    /// nothing and are told to the log.
    pub fn reload(&self) {
        match read(&self.files) {
            Ok(new) => {
                *self.now.write().unwrap_or_else(PoisonError::into_inner) = new;
                tracing::info!(cert = %self.files.cert.display(), "certificates were read again");
            }
            Err(error) => tracing::error!(%error, "certificates were not read again; those from before stay in use"),
        }
    }

    pub(super) fn now(&self) -> Configs {
        self.now.read().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

fn read(files: &TlsFiles) -> Result<Configs, Invalid> {
    let certs = certificates("--tls-cert", &files.cert)?;
    let key = PrivateKeyDer::from_pem_file(&files.key);
    let key = key.map_err(|e| unusable("--tls-key", &files.key, why(e), "a PEM file with an unencrypted private key"))?;
    let provider = Arc::new(ring::default_provider());
    let builder = ServerConfig::builder_with_provider(provider.clone());
    let builder = builder.with_safe_default_protocol_versions().expect("the provider knows TLS 1.2 and 1.3");
    let builder = match &files.client_ca {
        None => builder.with_no_client_auth(),
        Some(path) => {
            const FLAG: &str = "--tls-client-ca";
            let expected = "a PEM file with certificates of authorities";
            let mut roots = RootCertStore::empty();
            for root in certificates(FLAG, path)? {
                roots.add(root).map_err(|e| unusable(FLAG, path, e, expected))?;
            }
            let verifier = WebPkiClientVerifier::builder_with_provider(Arc::new(roots), provider).build();
            builder.with_client_cert_verifier(verifier.map_err(|e| unusable(FLAG, path, e, expected))?)
        }
    };
    let grpc = builder.with_single_cert(certs, key);
    let mut grpc = grpc.map_err(|e| unusable("--tls-key", &files.key, e, "the key of the certificate in --tls-cert"))?;
    let mut http = grpc.clone();
    grpc.alpn_protocols = vec![H2.to_vec()];
    http.alpn_protocols = vec![H2.to_vec(), b"http/1.1".to_vec()];
    Ok(Configs { grpc: Arc::new(grpc), http: Arc::new(http) })
}

/// The certificates of a PEM file, at least one.
fn certificates(flag: &str, path: &Path) -> Result<Vec<CertificateDer<'static>>, Invalid> {
    let expected = "a PEM file with certificates";
    let read = CertificateDer::pem_file_iter(path).and_then(Iterator::collect::<Result<Vec<_>, _>>);
    match read {
        Ok(certs) if certs.is_empty() => Err(unusable(flag, path, "it holds none", expected)),
        Ok(certs) => Ok(certs),
        Err(e) => Err(unusable(flag, path, why(e), expected)),
    }
}

/// What is wrong with a PEM file, without anything of what is in it.
fn why(error: pem::Error) -> String {
    match error {
        pem::Error::Io(e) => e.to_string(),
        pem::Error::NoItemsFound => "it holds none".to_owned(),
        _ => "it is not PEM".to_owned(),
    }
}

fn unusable(flag: &str, path: &Path, why: impl std::fmt::Display, expected: &str) -> Invalid {
    Invalid::new(flag, path.display(), format!("{expected} ({why})"))
}
