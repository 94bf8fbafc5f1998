//! Streams of messages from clients.

use std::future::ready;
use std::sync::Arc;

use futures::stream::{Stream, StreamExt};
use tonic::{Status, Streaming};

use super::call::with_code;
use crate::service::App;

/// The messages of a stream until the server drains. Messages received before are answered; then the stream ends, so that it
/// does not delay the shutdown. The stream also ends after the first error, because tonic would repeat the error for ever.
pub(super) fn requests<T: Send + 'static>(app: Arc<App>, messages: Streaming<T>) -> impl Stream<Item = Result<T, Status>> {
    let until_drained = messages.take_until(async move { app.draining.wait().await });
    until_drained.scan(false, |over, message| {
        let last = std::mem::replace(over, message.is_err());
        let message = message.map_err(|status| with_code(&status).unwrap_or(status));
        ready((!last).then_some(message))
    })
}
