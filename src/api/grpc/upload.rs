//! Reads uploads: streams of a header followed by chunks of data.

use bytes::Bytes;
use tonic::{Status, Streaming};

use crate::invalid::Invalid;
use crate::service::Error;
use crate::wire::v1;

/// The content of a message of an upload.
pub(super) enum Part<H> {
    /// The first message.
    Header(H),
    /// Every later message.
    Data(Bytes),
}

/// A message of an upload.
pub(super) trait UploadMessage {
    /// What the header declares.
    type Header;

    /// The content; `None` if the message is empty.
    fn part(self) -> Option<Part<Self::Header>>;
}

impl UploadMessage for v1::UploadSnapshotRequest {
    type Header = v1::SnapshotHeader;

    fn part(self) -> Option<Part<Self::Header>> {
        use v1::upload_snapshot_request::Part as Wire;
        Some(match self.part? {
            Wire::Header(header) => Part::Header(header),
            Wire::Data(data) => Part::Data(data),
        })
    }
}

impl UploadMessage for v1::UploadCheckpointRequest {
    type Header = v1::CheckpointHeader;

    fn part(self) -> Option<Part<Self::Header>> {
        use v1::upload_checkpoint_request::Part as Wire;
        Some(match self.part? {
            Wire::Header(header) => Part::Header(header),
            Wire::Data(data) => Part::Data(data),
        })
    }
}

/// Reads the header, the first message of an upload.
///
/// # Errors
/// `INVALID_ARGUMENT` when the first message is not a header, or the status with which the stream ended.
pub(super) async fn header<M: UploadMessage>(messages: &mut Streaming<M>) -> Result<M::Header, Status> {
    match messages.message().await?.and_then(UploadMessage::part) {
        Some(Part::Header(header)) => Ok(header),
        _ => Err(wrong_order().into()),
    }
}

/// Reads the next chunk of data; `None` at the end of the upload.
///
/// # Errors
/// `INVALID_ARGUMENT` when the next message is not a chunk, or the status with which the stream ended.
pub(super) async fn chunk<M: UploadMessage>(messages: &mut Streaming<M>) -> Result<Option<Bytes>, Status> {
    match messages.message().await?.map(UploadMessage::part) {
        None => Ok(None),
        Some(Some(Part::Data(data))) => Ok(Some(data)),
        Some(_) => Err(wrong_order().into()),
    }
}

fn wrong_order() -> Error {
    Invalid::new("part", "parts in another order", "one header, then data").into()
}
