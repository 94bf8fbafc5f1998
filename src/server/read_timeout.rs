//! A read timeout for the first bytes of a connection: all of them must arrive before one deadline.
//!
//! The crate `tokio-io-timeout` restarts its timeout with every read and cannot end it. A caller that sends the HTTP/2 preface
//! byte by byte would have the timeout 24 times, and an idle gRPC stream would be cut off. Bodies of REST requests use
//! [`tower_http::timeout::TimeoutBody`].

use std::io;
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::time::Sleep;

/// Wraps `IO`. Reads fail with `TimedOut` when the first bytes are late, and have no timeout afterwards.
pub(super) struct FirstBytesTimeout<IO> {
    io: IO,
    /// Bytes still expected and their deadline; `None` once they arrived.
    pending: Option<(usize, Pin<Box<Sleep>>)>,
}

impl<IO> FirstBytesTimeout<IO> {
    /// The first `bytes` bytes must arrive within `timeout`.
    pub(super) fn new(io: IO, bytes: usize, timeout: Duration) -> Self {
        Self { io, pending: Some((bytes, Box::pin(tokio::time::sleep(timeout)))) }
    }
}

impl<IO: AsyncRead + Unpin> AsyncRead for FirstBytesTimeout<IO> {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let this = &mut *self;
        let Some((missing, deadline)) = &mut this.pending else { return Pin::new(&mut this.io).poll_read(cx, buf) };
        let before = buf.filled().len();
        let read = Pin::new(&mut this.io).poll_read(cx, buf);
        if read.is_ready() {
            *missing = missing.saturating_sub(buf.filled().len() - before);
            if *missing == 0 {
                this.pending = None;
            }
            return read;
        }
        deadline.as_mut().poll(cx).map(|()| Err(io::ErrorKind::TimedOut.into()))
    }
}

impl<IO: AsyncWrite + Unpin> AsyncWrite for FirstBytesTimeout<IO> {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.io).poll_write(cx, buf)
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.io).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.io).poll_shutdown(cx)
    }

    fn poll_write_vectored(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bufs: &[io::IoSlice<'_>]) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.io).poll_write_vectored(cx, bufs)
    }

    fn is_write_vectored(&self) -> bool {
        self.io.is_write_vectored()
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt, AsyncWriteExt, duplex};

    use super::*;

    #[tokio::test]
    async fn slow_first_bytes_share_one_deadline() {
        let (mut client, server) = duplex(64);
        let mut server = FirstBytesTimeout::new(server, 500, Duration::from_millis(200));
        let slow = tokio::spawn(async move {
            while client.write_all(b"x").await.is_ok() {
                tokio::time::sleep(Duration::from_millis(20)).await;
            }
        });
        let error = server.read_exact(&mut [0; 500]).await.unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::TimedOut);
        drop(server);
        slow.await.unwrap();
    }

    #[tokio::test]
    async fn later_reads_have_no_timeout() {
        let timeout = Duration::from_millis(50);
        let (mut client, server) = duplex(64);
        let mut server = FirstBytesTimeout::new(server, 3, timeout);
        client.write_all(b"xyz").await.unwrap();
        server.read_exact(&mut [0; 3]).await.unwrap();
        let late = tokio::spawn(async move {
            tokio::time::sleep(4 * timeout).await;
            client.write_all(b"x").await.unwrap();
        });
        server.read_u8().await.unwrap();
        late.await.unwrap();
    }
}
