//! A server in this process, on free loopback ports.

use std::net::SocketAddr;
use std::path::Path;

use tokio::sync::oneshot;
use tokio::task::JoinHandle;

use crate::config::Config;
use crate::server::{self, DataDir, Listeners};
use crate::serving::Clock;

/// A running server.
pub struct LocalServer {
    /// Where gRPC listens.
    pub grpc: SocketAddr,
    /// Where REST listens.
    pub http: SocketAddr,
    stop: oneshot::Sender<()>,
    done: JoinHandle<anyhow::Result<()>>,
}

impl LocalServer {
    /// Starts it on `data_dir`, with the defaults for everything else.
    ///
    /// # Errors
    /// The directory is in use, or cannot be read or written.
    pub async fn start(data_dir: &Path) -> anyhow::Result<Self> {
        let free: SocketAddr = ([127, 0, 0, 1], 0).into();
        let config = Config { grpc_addr: free, http_addr: free, ..Config::new(data_dir) };
        let data = DataDir::take(&config.data_dir)?;
        let listeners = Listeners::bind(&config).await?;
        let endpoints = listeners.endpoints()?;
        let app = server::open(&config, &data, Clock::system()).await?;
        let (stop, stopped) = oneshot::channel();
        let done = tokio::spawn(async move {
            let shutdown = async move { stopped.await.unwrap_or(()) };
            Ok(server::run(&config, &data, app, listeners, shutdown).await?)
        });
        Ok(Self { grpc: endpoints.grpc, http: endpoints.http, stop, done })
    }

    /// Stops it and waits for its end.
    ///
    /// # Errors
    /// It failed before.
    pub async fn stop(self) -> anyhow::Result<()> {
        // It is gone already if nobody listens any more; then `done` says why.
        let _ = self.stop.send(());
        self.done.await?
    }
}
