//! Sends what training tells, in order: metrics in batches, a snapshot only when all rows before it have arrived.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use bytes::Bytes;
use sha2::{Digest, Sha256};
use tokio::sync::mpsc::UnboundedReceiver;

use super::client::{Client, Lost};
use super::training::Item;
use crate::wire::v1;

/// Pause in which rows gather into a batch.
const GATHER: Duration = Duration::from_millis(100);
/// Most rows in a batch.
const BATCH: usize = 2000;

/// Sends everything until training has dropped its end of the queue. `snapshot_pending` is cleared when a snapshot is sent.
pub(super) async fn forward(
    client: &Client,
    mut inbox: UnboundedReceiver<Item>,
    snapshot_pending: &AtomicBool,
) -> Result<(), Lost> {
    let mut items = Vec::new();
    let mut report = v1::ReportRequest::default();
    while inbox.recv_many(&mut items, BATCH).await > 0 {
        for item in items.drain(..) {
            match item {
                Item::Metrics { step, rows } => {
                    report.step = step;
                    let rows = rows.into_iter();
                    report.metrics.extend(rows.map(|(step, name, value)| v1::ReportedMetric { name: name.into(), step, value }));
                    if report.metrics.len() >= BATCH {
                        flush(client, &mut report).await?;
                    }
                }
                Item::Snapshot { step, bytes } => {
                    flush(client, &mut report).await?;
                    let (sha256, bytes) = digest(bytes).await;
                    let header = v1::SnapshotHeader { step, size: bytes.len() as u64, sha256 };
                    match client.upload_snapshot(&header, &bytes).await {
                        Ok(()) => tracing::debug!(step, size = bytes.len(), "snapshot sent"),
                        Err(over @ Lost::Over(_)) => return Err(over),
                        // The former one still stands; more is repeated after a crash, and nothing is lost.
                        Err(e) => tracing::warn!(error = %e, step, "a snapshot could not be sent"),
                    }
                    snapshot_pending.store(false, Ordering::Release);
                }
                Item::Checkpoint { kind, step, bytes, metrics } => {
                    flush(client, &mut report).await?;
                    let (sha256, bytes) = digest(bytes).await;
                    let size = bytes.len() as u64;
                    let metrics = metrics.into_iter().map(|(name, value)| (name.to_owned(), value)).collect();
                    let header = v1::CheckpointHeader { kind: kind.into(), step, size, sha256, metrics };
                    client.upload_checkpoint(&header, &bytes).await?;
                }
            }
        }
        flush(client, &mut report).await?;
        if !inbox.is_closed() {
            tokio::time::sleep(GATHER).await;
        }
    }
    Ok(())
}

async fn flush(client: &Client, report: &mut v1::ReportRequest) -> Result<(), Lost> {
    if !report.metrics.is_empty() {
        client.report(report).await?;
        report.metrics.clear();
    }
    Ok(())
}

/// The SHA-256 of what is sent, computed aside: heartbeats go on meanwhile.
async fn digest(bytes: Vec<u8>) -> (String, Bytes) {
    let hash = move || (hex::encode(Sha256::digest(&bytes)), Bytes::from(bytes));
    tokio::task::spawn_blocking(hash).await.expect("hashing does not panic")
}
