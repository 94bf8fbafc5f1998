//! Whether the server is shutting down: one flag for all layers.

use tokio_util::sync::CancellationToken;

/// The flag; cheap to clone. Once set it stays set: new work is refused, work in flight continues.
#[derive(Clone, Debug, Default)]
pub struct Draining(CancellationToken);

impl Draining {
    /// Sets the flag.
    pub fn begin(&self) {
        self.0.cancel();
    }

    /// Whether the flag is set.
    pub fn begun(&self) -> bool {
        self.0.is_cancelled()
    }

    /// Returns when the flag is set.
    pub async fn wait(&self) {
        self.0.cancelled().await;
    }
}
