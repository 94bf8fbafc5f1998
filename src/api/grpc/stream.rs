//! Streams of requests from clients.

use std::future::ready;
use std::sync::Arc;

use futures::stream::{Stream, StreamExt};
use tonic::{Status, Streaming};

use super::call::with_code;
use crate::service::App;

/// The messages of a stream. The stream ends when the server drains, after the messages already received, so that it does not
/// delay the shutdown. It also ends after the first error, because tonic would repeat that error without end.
pub(super) fn requests<T: Send + 'static>(app: Arc<App>, messages: Streaming<T>) -> impl Stream<Item = Result<T, Status>> {
    let until_drained = messages.take_until(async move { app.draining.wait().await });
    until_drained.scan(false, |over, message| {
        let last = std::mem::replace(over, message.is_err());
        let message = message.map_err(|status| with_code(&status).unwrap_or(status));
        ready((!last).then_some(message))
    })
}
