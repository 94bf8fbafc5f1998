//! Sends the reports of training in order: metrics in batches, and a snapshot only after all metrics before it.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use bytes::Bytes;
use sha2::{Digest, Sha256};
use tokio::sync::mpsc::Receiver;

use super::client::{Client, ClientError};
use super::training::Report;
use crate::wire::v1;

/// Time in which metrics are collected for a batch.
const BATCH_DELAY: Duration = Duration::from_millis(100);
/// Maximum number of metrics in a batch.
const BATCH_SIZE: usize = 2000;

/// Sends all reports until training has closed the queue. Clears `snapshot_pending` after each snapshot.
pub(super) async fn send_all(
    client: &Client,
    mut reports: Receiver<Report>,
    snapshot_pending: &AtomicBool,
) -> Result<(), ClientError> {
    let mut received = Vec::new();
    let mut batch = v1::ReportRequest::default();
    while reports.recv_many(&mut received, BATCH_SIZE).await > 0 {
        for report in received.drain(..) {
            match report {
                Report::Metrics { step, rows } => {
                    batch.step = step;
                    let rows = rows.into_iter();
                    batch.metrics.extend(rows.map(|(step, name, value)| v1::ReportedMetric { name: name.into(), step, value }));
                    if batch.metrics.len() >= BATCH_SIZE {
                        flush(client, &mut batch).await?;
                    }
                }
                Report::Progress { step } => {
                    batch.step = step;
                    client.report(&batch).await?;
                    batch.metrics.clear();
                }
                Report::Snapshot { step, bytes } => {
                    flush(client, &mut batch).await?;
                    let (sha256, bytes) = digest(bytes).await;
                    let header = v1::SnapshotHeader { step, size: bytes.len() as u64, sha256 };
                    match client.upload_snapshot(&header, &bytes).await {
                        Ok(()) => tracing::debug!(step, size = bytes.len(), "snapshot uploaded"),
                        Err(ended @ ClientError::AttemptEnded(_)) => return Err(ended),
                        // The server keeps the previous snapshot. A crash would repeat more steps, but lose none.
                        Err(e) => tracing::warn!(error = %e, step, "a snapshot could not be uploaded"),
                    }
                    snapshot_pending.store(false, Ordering::Release);
                }
                Report::Checkpoint { kind, step, bytes, metrics } => {
                    flush(client, &mut batch).await?;
                    let (sha256, bytes) = digest(bytes).await;
                    let size = bytes.len() as u64;
                    let metrics = metrics.into_iter().map(|(name, value)| (name.to_owned(), value)).collect();
                    let header = v1::CheckpointHeader { kind: kind.into(), step, size, sha256, metrics };
                    client.upload_checkpoint(&header, &bytes).await?;
                }
            }
        }
        flush(client, &mut batch).await?;
        if !reports.is_closed() {
            tokio::time::sleep(BATCH_DELAY).await;
        }
    }
    Ok(())
}

async fn flush(client: &Client, batch: &mut v1::ReportRequest) -> Result<(), ClientError> {
    if !batch.metrics.is_empty() {
        client.report(batch).await?;
        batch.metrics.clear();
    }
    Ok(())
}

/// Computes the SHA-256 of an upload on another thread, so that heartbeats continue.
async fn digest(bytes: Vec<u8>) -> (String, Bytes) {
    let hash = move || (hex::encode(Sha256::digest(&bytes)), Bytes::from(bytes));
    tokio::task::spawn_blocking(hash).await.expect("hashing does not panic")
}
