//! HTTP/2 by hand: frames that no well-behaved library sends, and connections that answer only what they want to.

use std::io;
use std::net::{Ipv4Addr, SocketAddr};
use std::time::Duration;

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::tcp::{OwnedReadHalf, OwnedWriteHalf};
use tokio::net::{TcpSocket, TcpStream};
use tokio::sync::mpsc;
use tokio::task::JoinHandle;

pub const PREFACE: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";

pub const DATA: u8 = 0;
pub const HEADERS: u8 = 1;
pub const RST_STREAM: u8 = 3;
pub const SETTINGS: u8 = 4;
pub const PING: u8 = 6;
pub const CONTINUATION: u8 = 9;

pub const ACK: u8 = 1;
pub const END_STREAM: u8 = 1;
pub const END_HEADERS: u8 = 4;

/// `SETTINGS_INITIAL_WINDOW_SIZE`.
pub const INITIAL_WINDOW: u16 = 4;

/// Time in which the server has to take what is sent to it.
const WRITE_TIMEOUT: Duration = Duration::from_secs(5);

pub fn frame(kind: u8, flags: u8, stream: u32, payload: &[u8]) -> Vec<u8> {
    let mut bytes = (payload.len() as u32).to_be_bytes()[1..].to_vec();
    bytes.extend([kind, flags]);
    bytes.extend(stream.to_be_bytes());
    bytes.extend(payload);
    bytes
}

/// A header block: every field a literal without indexing and without Huffman code.
pub fn block(fields: &[(&str, &str)]) -> Vec<u8> {
    let mut bytes = Vec::new();
    for (name, value) in fields {
        bytes.push(0);
        for text in [name, value] {
            length(&mut bytes, text.len());
            bytes.extend(text.as_bytes());
        }
    }
    bytes
}

/// An integer with a prefix of 7 bits (RFC 7541, 5.1).
fn length(bytes: &mut Vec<u8>, mut value: usize) {
    if value < 127 {
        return bytes.push(value as u8);
    }
    bytes.push(127);
    value -= 127;
    while value >= 128 {
        bytes.push((value % 128) as u8 | 128);
        value /= 128;
    }
    bytes.push(value as u8);
}

/// The header block of a gRPC call, with an API key if there is one.
pub fn call(path: &str, key: Option<&str>) -> Vec<u8> {
    let authorization = key.map(|key| format!("Bearer {key}"));
    let mut fields = vec![
        (":method", "POST"),
        (":scheme", "http"),
        (":path", path),
        (":authority", "127.0.0.1"),
        ("content-type", "application/grpc"),
        ("te", "trailers"),
    ];
    fields.extend(authorization.as_deref().map(|value| ("authorization", value)));
    block(&fields)
}

/// What a connection does with what it receives.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reading {
    /// Acknowledges settings and answers pings.
    Polite,
    /// Reads nothing.
    Never,
}

/// Opens a connection from this address. All addresses of 127.0.0.0/8 belong to this machine.
pub async fn dial(address: SocketAddr, from: Ipv4Addr) -> io::Result<TcpStream> {
    let socket = TcpSocket::new_v4()?;
    socket.bind((from, 0).into())?;
    tokio::time::timeout(WRITE_TIMEOUT, socket.connect(address)).await?
}

/// An HTTP/2 connection that has sent its preface and settings.
pub struct Connection {
    output: mpsc::Sender<Vec<u8>>,
    tasks: [JoinHandle<()>; 2],
}

impl Connection {
    /// `settings`: pairs of identifier and value.
    pub async fn open(address: SocketAddr, from: Ipv4Addr, settings: &[(u16, u32)], reading: Reading) -> io::Result<Self> {
        let stream = dial(address, from).await?;
        let payload: Vec<u8> =
            settings.iter().flat_map(|(id, value)| [&id.to_be_bytes()[..], &value.to_be_bytes()].concat()).collect();
        let (read, write) = stream.into_split();
        let (output, pending) = mpsc::channel(8);
        let answers = (reading == Reading::Polite).then(|| output.clone());
        let connection = Self { output, tasks: [tokio::spawn(send(write, pending)), tokio::spawn(receive(read, answers))] };
        connection.write([PREFACE, &frame(SETTINGS, 0, 0, &payload)].concat()).await?;
        Ok(connection)
    }

    /// Sends bytes; an error if the server has closed the connection or takes no more.
    pub async fn write(&self, bytes: Vec<u8>) -> io::Result<()> {
        self.output.send(bytes).await.map_err(|_| io::ErrorKind::BrokenPipe.into())
    }

    /// Whether the server has closed the connection.
    pub fn closed(&self) -> bool {
        self.tasks.iter().any(JoinHandle::is_finished)
    }
}

impl Drop for Connection {
    fn drop(&mut self) {
        self.tasks.iter().for_each(JoinHandle::abort);
    }
}

async fn send(mut write: OwnedWriteHalf, mut pending: mpsc::Receiver<Vec<u8>>) {
    while let Some(bytes) = pending.recv().await {
        if !matches!(tokio::time::timeout(WRITE_TIMEOUT, write.write_all(&bytes)).await, Ok(Ok(()))) {
            return;
        }
    }
}

/// Reads frames, and answers those that want an answer, until the connection ends. The end closes the other half, too.
async fn receive(mut read: OwnedReadHalf, answers: Option<mpsc::Sender<Vec<u8>>>) {
    let Some(answers) = answers else { return std::future::pending().await };
    let mut payload = Vec::new();
    loop {
        let mut head = [0; 9];
        if read.read_exact(&mut head).await.is_err() {
            break;
        }
        payload.resize(u32::from_be_bytes([0, head[0], head[1], head[2]]) as usize, 0);
        if read.read_exact(&mut payload).await.is_err() {
            break;
        }
        let answer = match (head[3], head[4] & ACK) {
            (SETTINGS, 0) => frame(SETTINGS, ACK, 0, &[]),
            (PING, 0) => frame(PING, ACK, 0, &payload),
            _ => continue,
        };
        if answers.send(answer).await.is_err() {
            break;
        }
    }
}
