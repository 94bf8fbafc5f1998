//! Connection flags of commands that use a server: address, certificates and API key.

use std::fmt;
use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context, bail};
use axum::http::{HeaderValue, Uri};
use clap::Args;
use hyper_rustls::{ConfigBuilderExt, HttpsConnector, HttpsConnectorBuilder};
use hyper_util::client::legacy::connect::HttpConnector;
use rustls::crypto::ring;
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::{ClientConfig, RootCertStore};

use super::output::errln;

/// Heading of these flags in the help.
const CONNECTION: &str = "Connection";

/// Connection flags.
#[derive(Args, Clone, Debug, Default)]
pub struct ConnectArgs {
    /// API key; prefer the environment variable, because every user of this machine can see command lines [default: none]
    #[arg(long, help_heading = CONNECTION, env = "QEDGIX_API_KEY", hide_env_values = true, value_name = "KEY")]
    api_key: Option<Secret>,
    /// Certificate authorities to trust (PEM) [default: those of this machine]
    #[arg(long, help_heading = CONNECTION, env = "QEDGIX_CA_CERT", value_name = "FILE")]
    ca_cert: Option<PathBuf>,
    /// Client certificate (PEM) [default: none]
    #[arg(long, help_heading = CONNECTION, env = "QEDGIX_CLIENT_CERT", value_name = "FILE", requires = "client_key")]
    client_cert: Option<PathBuf>,
    /// Private key of the client certificate (PEM)
    #[arg(long, help_heading = CONNECTION, env = "QEDGIX_CLIENT_KEY", value_name = "FILE", requires = "client_cert")]
    client_key: Option<PathBuf>,
    /// Whether the warning about a key without encryption was printed.
    #[arg(skip)]
    warned: Arc<AtomicBool>,
    /// What the names of these flags begin with, for errors: nothing, or `follow-`.
    #[arg(skip)]
    prefix: &'static str,
}

/// Whether a connection to `url` is neither encrypted nor within this machine.
fn is_readable_by_others(url: &Uri) -> bool {
    let host = url.host().unwrap_or_default().trim_matches(['[', ']']);
    let local = host.eq_ignore_ascii_case("localhost") || host.parse::<IpAddr>().is_ok_and(|ip| ip.to_canonical().is_loopback());
    url.scheme_str() != Some("https") && !local
}

/// Text that `Debug` hides.
#[derive(Clone)]
pub(super) struct Secret(String);

impl From<String> for Secret {
    fn from(text: String) -> Self {
        Self(text)
    }
}

impl fmt::Debug for Secret {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("***")
    }
}

/// Opens connections for gRPC, with TLS when the scheme is `https`.
pub type Connector = HttpsConnector<HttpConnector>;

impl ConnectArgs {
    /// The flags `--follow-...` of a replica, for connections to its primary. `client`: certificate and private key.
    pub(super) fn of_follow(api_key: Option<Secret>, ca_cert: Option<PathBuf>, client: Option<(PathBuf, PathBuf)>) -> Self {
        let (client_cert, client_key) = client.unzip();
        Self { api_key, ca_cert, client_cert, client_key, warned: Arc::default(), prefix: "follow-" }
    }

    /// Parses `HOST:PORT` or a URL. Without a scheme, the scheme is `https` when a certificate flag is given, and `http`
    /// otherwise.
    ///
    /// # Errors
    /// `address` is neither.
    pub fn url(&self, address: &str) -> anyhow::Result<Uri> {
        let tls = self.ca_cert.is_some() || self.client_cert.is_some();
        let scheme = if tls { "https" } else { "http" };
        let address = address.trim_end_matches('/');
        let text = if address.contains("://") { address.to_owned() } else { format!("{scheme}://{address}") };
        let url: Uri = text.parse().with_context(|| format!("{address}: not an address"))?;
        if url.host().is_none() || !matches!(url.scheme_str(), Some("http" | "https")) || url.path() != "/" {
            bail!("{address}: not an address; expected HOST:PORT, http://HOST:PORT or https://HOST:PORT");
        }
        Ok(url)
    }

    /// The value of the `authorization` header for `url`, if there is an API key. Warns once if others could read the key on its
    /// way.
    ///
    /// # Errors
    /// The API key contains characters that a header cannot contain.
    pub fn authorization(&self, url: &Uri) -> anyhow::Result<Option<HeaderValue>> {
        let Some(Secret(key)) = &self.api_key else { return Ok(None) };
        if is_readable_by_others(url) && !self.warned.swap(true, Ordering::Relaxed) {
            errln!("warning: the API key is sent to {url} without encryption; use https://");
        }
        // The error of the conversion is dropped, because it could contain the key.
        let value = HeaderValue::try_from(format!("Bearer {}", key.trim()));
        let Ok(mut value) = value else {
            bail!("--{}api-key: not an API key; expected a key that qedgix keys create printed", self.prefix)
        };
        value.set_sensitive(true);
        Ok(Some(value))
    }

    /// The connector of a gRPC channel to `url`.
    ///
    /// # Errors
    /// As [`ConnectArgs::tls`].
    pub fn connector(&self, url: &Uri) -> anyhow::Result<Connector> {
        let mut tcp = HttpConnector::new();
        tcp.set_nodelay(true);
        tcp.enforce_http(false);
        let builder = HttpsConnectorBuilder::new().with_tls_config(self.tls(url)?).https_or_http();
        Ok(builder.enable_http2().wrap_connector(tcp))
    }

    /// The TLS configuration for `url`. The certificate authorities of this machine are loaded only for `https`, because a
    /// machine may have none.
    ///
    /// # Errors
    /// A certificate or private key cannot be read or used.
    pub fn tls(&self, url: &Uri) -> anyhow::Result<ClientConfig> {
        let https = url.scheme_str() == Some("https");
        let flag = |name: &str| format!("--{}{name}", self.prefix);
        let builder = ClientConfig::builder_with_provider(Arc::new(ring::default_provider()));
        let builder = builder.with_safe_default_protocol_versions()?;
        let builder = match &self.ca_cert {
            Some(path) => {
                let mut roots = RootCertStore::empty();
                for cert in certificates(&flag("ca-cert"), path)? {
                    roots.add(cert).with_context(|| format!("{} {}", flag("ca-cert"), path.display()))?;
                }
                builder.with_root_certificates(roots)
            }
            None if https => {
                let hint = || format!("cannot load the certificate authorities of this machine; use {}", flag("ca-cert"));
                builder.with_native_roots().with_context(hint)?
            }
            None => builder.with_root_certificates(RootCertStore::empty()),
        };
        let Some((cert, key)) = self.client_cert.as_deref().zip(self.client_key.as_deref()) else {
            return Ok(builder.with_no_client_auth());
        };
        let certs = certificates(&flag("client-cert"), cert)?;
        let of_key = || format!("{} {}", flag("client-key"), key.display());
        let private_key = PrivateKeyDer::from_pem_file(key).with_context(of_key)?;
        builder.with_client_auth_cert(certs, private_key).with_context(of_key)
    }
}

/// The certificates of a PEM file, at least one.
fn certificates(flag: &str, path: &Path) -> anyhow::Result<Vec<CertificateDer<'static>>> {
    let read = CertificateDer::pem_file_iter(path).and_then(Iterator::collect::<Result<Vec<_>, _>>);
    let certs = read.with_context(|| format!("{flag} {}", path.display()))?;
    if certs.is_empty() {
        bail!("{flag} {}: no PEM certificate in the file", path.display());
    }
    Ok(certs)
}

#[cfg(test)]
mod tests {
    use clap::{CommandFactory, Parser};

    use super::*;

    #[derive(Debug, Parser)]
    struct Line {
        #[command(flatten)]
        connect: ConnectArgs,
    }

    #[test]
    fn debug_output_and_errors_do_not_contain_the_key() {
        let line = Line::try_parse_from(["x", "--api-key", "qdx_id_SECRET"]).unwrap();
        assert!(!format!("{line:?}").contains("SECRET"));
        let value = line.connect.authorization(&Uri::from_static("http://localhost")).unwrap().unwrap();
        assert_eq!(value, "Bearer qdx_id_SECRET");
        assert!(!format!("{value:?}").contains("SECRET"));
        let broken = Line::try_parse_from(["x", "--api-key", "SECRET\n1"])
            .unwrap()
            .connect
            .authorization(&Uri::from_static("http://localhost"))
            .unwrap_err();
        assert!(!format!("{broken:?}").contains("SECRET"), "{broken:?}");
        let command = Line::command();
        let key = command.get_arguments().find(|a| a.get_id() == "api_key").unwrap();
        assert!(key.is_hide_env_values_set());
    }

    #[test]
    fn a_key_that_others_can_read_is_warned_about_once() {
        let connect = Line::try_parse_from(["x", "--api-key", "k"]).unwrap().connect;
        let again = connect.clone();
        for (url, warned) in [
            ("http://127.0.0.1:8080", false),
            ("http://[::1]:8080", false),
            ("http://localhost", false),
            ("https://server", false),
            ("http://10.0.0.1:8080", true),
        ] {
            connect.authorization(&url.parse().unwrap()).unwrap();
            assert_eq!(again.warned.load(Ordering::Relaxed), warned, "{url}");
        }
    }

    #[test]
    fn addresses_become_urls() {
        let plain = ConnectArgs::default();
        let tls = ConnectArgs { ca_cert: Some("ca.pem".into()), ..ConnectArgs::default() };
        assert_eq!(plain.url("127.0.0.1:8080").unwrap(), "http://127.0.0.1:8080/");
        assert_eq!(tls.url("server:8080").unwrap(), "https://server:8080/");
        assert_eq!(tls.url("http://server:8080/").unwrap(), "http://server:8080/");
        assert_eq!(plain.url("https://server").unwrap(), "https://server/");
        for wrong in ["", "a b", "ftp://server", "http://server/path", "/path"] {
            assert!(plain.url(wrong).is_err(), "{wrong}");
        }
    }
}
