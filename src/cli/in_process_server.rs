//! A server inside this process, on free loopback ports, for `demo` and `bench act`.

use std::net::SocketAddr;
use std::path::Path;

use tokio::sync::oneshot;
use tokio::task::JoinHandle;

use crate::clock::Clock;
use crate::config::Config;
use crate::server::{self, DataDir, Listeners};

/// A running server.
pub struct InProcessServer {
    /// Address of gRPC.
    pub grpc: SocketAddr,
    /// Address of REST.
    pub http: SocketAddr,
    stop: oneshot::Sender<()>,
    done: JoinHandle<anyhow::Result<()>>,
}

impl InProcessServer {
    /// Starts a server on `data_dir` with default settings.
    ///
    /// # Errors
    /// The directory is in use by another server, or cannot be read or written.
    pub async fn start(data_dir: &Path) -> anyhow::Result<Self> {
        let free: SocketAddr = ([127, 0, 0, 1], 0).into();
        let config = Config { grpc_addr: free, http_addr: free, ..Config::new(data_dir) };
        let data = DataDir::lock(&config.data_dir)?;
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

    /// Stops the server and waits until it has stopped.
    ///
    /// # Errors
    /// The server has failed.
    pub async fn stop(self) -> anyhow::Result<()> {
        // Sending fails when the server has already failed; `done` then returns its error.
        let _ = self.stop.send(());
        self.done.await?
    }
}
