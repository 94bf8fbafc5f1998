//! Operations: metrics, logs, traces, draining, a database that cannot be written, and socket options.

mod collector;
mod exposition;
mod logs;
mod stopping;
mod storage;

use qedgix::wire::v1;

use super::binary::Binary;
use super::harness::*;

/// Checks the options of accepted sockets of both listeners.
#[cfg(target_os = "linux")]
#[tokio::test]
async fn both_listeners_set_tcp_nodelay() {
    use rustix::process::{PidfdFlags, PidfdGetfdFlags, getpid, pidfd_getfd, pidfd_open};
    use std::net::{SocketAddr, TcpStream};
    use tokio::io::{AsyncReadExt, AsyncWriteExt};

    /// The server's end of a connection to this process.
    fn accepted(client: SocketAddr) -> Option<TcpStream> {
        let myself = pidfd_open(getpid(), PidfdFlags::empty()).unwrap();
        let files = std::fs::read_dir("/proc/self/fd").unwrap();
        let numbers: Vec<i32> = files.filter_map(|entry| entry.unwrap().file_name().to_str()?.parse().ok()).collect();
        numbers.into_iter().find_map(|number| {
            // Skips files that were closed meanwhile and files that are not sockets.
            let stream = TcpStream::from(pidfd_getfd(&myself, number, PidfdGetfdFlags::empty()).ok()?);
            (stream.peer_addr().ok()? == client).then_some(stream)
        })
    }

    let server = Server::start().await;
    let myself = pidfd_open(getpid(), PidfdFlags::empty());
    let allowed = myself.is_ok_and(|myself| pidfd_getfd(&myself, 0, PidfdGetfdFlags::empty()).is_ok());
    if !allowed {
        eprintln!("skipped: this system does not let a process duplicate its own files");
        return;
    }
    for (address, hello) in [
        (server.endpoints.grpc, &b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\x04\0\0\0\0\0"[..]),
        (server.endpoints.http, b"GET /livez HTTP/1.1\r\nhost: here\r\n\r\n"),
    ] {
        let mut client = tokio::net::TcpStream::connect(address).await.unwrap();
        client.write_all(hello).await.unwrap();
        // A response means that the connection was accepted.
        with_timeout(client.read_u8()).await.unwrap();
        let socket = accepted(client.local_addr().unwrap()).expect("the socket is this process's");
        assert!(socket.nodelay().unwrap(), "{address}");
    }
    // The option is off by default, so the test can fail.
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let client = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
    let _held = listener.accept().unwrap();
    assert!(!accepted(client.local_addr().unwrap()).unwrap().nodelay().unwrap());
}

/// One slot in a session of `sweep`.
async fn fly(binary: &Binary, id: &str, step: u64) -> v1::ActResponse {
    let mut client = binary.policies().await;
    if step == 0 {
        client.open_session(open("sweep", id)).await.unwrap();
    }
    client.act(in_session(id, Some(step), scene(2, 3, step))).await.unwrap().into_inner()
}
