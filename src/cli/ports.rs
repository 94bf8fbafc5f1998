//! Which of its two ports a server was addressed by, so that an error can say that it is the wrong one.

use std::time::Duration;

use anyhow::bail;
use axum::http::Uri;
use reqwest::redirect::Policy;
use tonic::Code;
use tonic::transport::Endpoint;
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_client::HealthClient;

use super::connect::ConnectArgs;

/// Timeout of a look.
const TIMEOUT: Duration = Duration::from_secs(3);

/// Checks that `address` is not the REST port of a server, for a command that needs its gRPC port.
///
/// # Errors
/// It is; or the address is invalid.
pub async fn expect_grpc(address: &str, args: &ConnectArgs) -> anyhow::Result<()> {
    let url = args.url(address)?;
    if !is_grpc(&url, args).await && is_rest(&url, args).await {
        bail!("{address} is the REST port of the server; expected its gRPC port (--grpc-addr of `qedgix serve`)");
    }
    Ok(())
}

/// Whether gRPC is served at `url`.
pub async fn is_grpc(url: &Uri, args: &ConnectArgs) -> bool {
    let Ok(connector) = args.connector(url) else { return false };
    let look = async {
        let channel = Endpoint::from(url.clone()).connect_with_connector(connector).await.ok()?;
        let health = HealthClient::new(channel).check(HealthCheckRequest::default()).await;
        // A server that requires keys may say so; another server does not know the service.
        health.map_or_else(|status| (status.code() == Code::Unauthenticated).then_some(()), |_| Some(()))
    };
    tokio::time::timeout(TIMEOUT, look).await.is_ok_and(|served| served.is_some())
}

/// Whether REST is served at `url`.
async fn is_rest(url: &Uri, args: &ConnectArgs) -> bool {
    let Ok(tls) = args.tls(url) else { return false };
    let client = reqwest::Client::builder().tls_backend_preconfigured(tls).redirect(Policy::none()).no_proxy().build();
    let Ok(client) = client else { return false };
    let live = client.get(format!("{}/livez", url.to_string().trim_end_matches('/'))).timeout(TIMEOUT).send().await;
    live.is_ok_and(|response| response.status().is_success())
}
