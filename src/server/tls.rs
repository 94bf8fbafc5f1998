//! TLS of both listeners: reads certificate files into rustls configurations and reloads them on request.

use std::path::Path;
use std::sync::{Arc, PoisonError, RwLock};

use jiff::Timestamp;
use rustls::crypto::ring;
use rustls::pki_types::pem::{self, PemObject};
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::server::WebPkiClientVerifier;
use rustls::{RootCertStore, ServerConfig};

use crate::config::TlsFiles;
use crate::invalid::Invalid;

/// ALPN name of HTTP/2.
pub(super) const H2: &[u8] = b"h2";

/// The TLS configuration in use and the files it comes from.
#[derive(Debug)]
pub struct Tls {
    files: TlsFiles,
    current: RwLock<Configs>,
}

/// Configurations of the two listeners. Both use the same certificate and differ in ALPN.
#[derive(Clone, Debug)]
pub(super) struct Configs {
    pub(super) grpc: Arc<ServerConfig>,
    pub(super) http: Arc<ServerConfig>,
    /// When the certificate expires, if it says so in a way that is understood.
    expires: Option<Timestamp>,
}

/// Days before a certificate expires from which a start or reload warns.
const WARN_DAYS: i64 = 14;

impl Tls {
    /// Reads the files.
    ///
    /// # Errors
    /// [`Invalid`], naming flag and path, when a file cannot be read or used.
    pub fn open(files: TlsFiles) -> Result<Self, Invalid> {
        let current = RwLock::new(read(&files)?);
        Ok(Self { files, current })
    }

    /// Reads the files again. New connections use the new certificates; open connections stay as they are. When a file cannot be
    /// used, the previous certificates stay in use and the error is logged.
    pub fn reload(&self) {
        match read(&self.files) {
            Ok(new) => {
                *self.current.write().unwrap_or_else(PoisonError::into_inner) = new;
                tracing::info!(cert = %self.files.cert.display(), "TLS certificates reloaded");
                self.report_expiry();
            }
            Err(error) => tracing::error!(%error, "cannot reload TLS certificates; the previous ones stay in use"),
        }
    }

    /// Sets the metric of the expiry of the certificate, and logs a warning if it is near or past.
    pub(super) fn report_expiry(&self) {
        let Some(expires) = self.current().expires else { return };
        metrics::gauge!("qedgix_tls_certificate_expiry_timestamp_seconds").set(expires.as_second() as f64);
        if let Some(state) = expiry_warning(expires, Timestamp::now()) {
            tracing::warn!(cert = %self.files.cert.display(), %expires, "the TLS certificate {state}");
        }
    }

    pub(super) fn current(&self) -> Configs {
        self.current.read().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

fn read(files: &TlsFiles) -> Result<Configs, Invalid> {
    let certs = certificates("--tls-cert", &files.cert)?;
    let key = PrivateKeyDer::from_pem_file(&files.key);
    let key =
        key.map_err(|e| invalid_file("--tls-key", &files.key, pem_problem(e), "a PEM file with an unencrypted private key"))?;
    let provider = Arc::new(ring::default_provider());
    let builder = ServerConfig::builder_with_provider(provider.clone());
    let builder = builder.with_safe_default_protocol_versions().expect("ring supports TLS 1.2 and 1.3");
    let builder = match &files.client_ca {
        None => builder.with_no_client_auth(),
        Some(path) => {
            const FLAG: &str = "--tls-client-ca";
            let expected = "a PEM file with certificates of authorities";
            let mut roots = RootCertStore::empty();
            for root in certificates(FLAG, path)? {
                roots.add(root).map_err(|e| invalid_file(FLAG, path, e, expected))?;
            }
            let verifier = WebPkiClientVerifier::builder_with_provider(Arc::new(roots), provider).build();
            builder.with_client_cert_verifier(verifier.map_err(|e| invalid_file(FLAG, path, e, expected))?)
        }
    };
    let expires = certs.first().and_then(|cert| expiry(cert));
    let grpc = builder.with_single_cert(certs, key);
    let mut grpc = grpc.map_err(|e| invalid_file("--tls-key", &files.key, e, "the key of the certificate in --tls-cert"))?;
    let mut http = grpc.clone();
    grpc.alpn_protocols = vec![H2.to_vec()];
    http.alpn_protocols = vec![H2.to_vec(), b"http/1.1".to_vec()];
    Ok(Configs { grpc: Arc::new(grpc), http: Arc::new(http), expires })
}

/// When a certificate expires.
fn expiry(cert: &[u8]) -> Option<Timestamp> {
    let (_, cert) = x509_parser::parse_x509_certificate(cert).ok()?;
    Timestamp::from_second(cert.validity().not_after.timestamp()).ok()
}

/// What to warn of at the time `now`.
fn expiry_warning(expires: Timestamp, now: Timestamp) -> Option<&'static str> {
    if expires <= now {
        return Some("has expired: clients refuse it");
    }
    (expires.as_second() - now.as_second() < WARN_DAYS * 86_400).then_some("expires within 14 days")
}

/// The certificates of a PEM file, at least one.
fn certificates(flag: &str, path: &Path) -> Result<Vec<CertificateDer<'static>>, Invalid> {
    let expected = "a PEM file with certificates";
    let read = CertificateDer::pem_file_iter(path).and_then(Iterator::collect::<Result<Vec<_>, _>>);
    match read {
        Ok(certs) if certs.is_empty() => Err(invalid_file(flag, path, "no certificate or key in it", expected)),
        Ok(certs) => Ok(certs),
        Err(e) => Err(invalid_file(flag, path, pem_problem(e), expected)),
    }
}

/// Describes a PEM error without quoting the content of the file.
fn pem_problem(error: pem::Error) -> String {
    match error {
        pem::Error::Io(e) => e.to_string(),
        pem::Error::NoItemsFound => "no certificate or key in it".to_owned(),
        _ => "not PEM".to_owned(),
    }
}

fn invalid_file(flag: &str, path: &Path, problem: impl std::fmt::Display, expected: &str) -> Invalid {
    Invalid::new(flag, path.display(), format!("{expected} ({problem})"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_certificate_that_expires_soon_is_warned_of() {
        let now = Timestamp::from_second(1_800_000_000).unwrap();
        let in_days = |days: i64| expiry_warning(Timestamp::from_second(now.as_second() + days * 86_400).unwrap(), now);
        assert_eq!([in_days(14), in_days(400)], [None, None]);
        assert_eq!(in_days(13), Some("expires within 14 days"));
        assert_eq!([in_days(0), in_days(-1)], [Some("has expired: clients refuse it"); 2]);
    }

    #[test]
    fn the_expiry_of_a_certificate_is_read() {
        let key = rcgen::KeyPair::generate().unwrap();
        let mut params = rcgen::CertificateParams::new(["localhost".to_owned()]).unwrap();
        params.not_after = rcgen::date_time_ymd(2031, 2, 3);
        let cert = params.self_signed(&key).unwrap();
        assert_eq!(expiry(cert.der()), Some("2031-02-03T00:00:00Z".parse().unwrap()));
        assert_eq!(expiry(b"nothing"), None);
    }
}
