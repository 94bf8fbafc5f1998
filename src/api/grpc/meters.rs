//! Counts and times of gRPC calls, under the names that gRPC middlewares share (`grpc_server_handled_total`, ...).
//!
//! Every method of the descriptors built into the program has its handles, made when it is called first and kept: counting
//! a call allocates and locks nothing. Paths are the caller's; those of no method are counted together.

use std::collections::HashMap;
use std::sync::OnceLock;

use metrics::{Counter, Histogram};
use prost::Message;
use prost_types::FileDescriptorSet;
use tonic::Code;

use crate::api::observe::is_quiet;

/// Which sides of a call send more than one message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Streams {
    pub(super) client: bool,
    pub(super) server: bool,
}

impl Streams {
    fn name(self) -> &'static str {
        match (self.client, self.server) {
            (false, false) => "unary",
            (true, false) => "client_stream",
            (false, true) => "server_stream",
            (true, true) => "bidi_stream",
        }
    }
}

/// One method.
pub(super) struct Method {
    /// `package.Service/Method`.
    pub(super) path: String,
    pub(super) streams: Streams,
    /// Whether its spans are for debugging only.
    pub(super) quiet: bool,
    handles: OnceLock<Handles>,
    /// By code.
    handled: [OnceLock<Counter>; 17],
}

/// What is counted of a method, whatever comes out.
pub(super) struct Handles {
    pub(super) started: Counter,
    pub(super) seconds: Histogram,
    pub(super) received: Counter,
    pub(super) sent: Counter,
}

impl Method {
    fn new(path: String, streams: Streams) -> Self {
        let quiet = path.rsplit_once('/').is_some_and(|(_, name)| is_quiet(name));
        Self { path, streams, quiet, handles: OnceLock::new(), handled: Default::default() }
    }

    fn labels(&self) -> [(&'static str, String); 3] {
        let (service, method) = self.path.rsplit_once('/').unwrap_or((&self.path, &self.path));
        let kind = self.streams.name().to_owned();
        [("grpc_type", kind), ("grpc_service", service.to_owned()), ("grpc_method", method.to_owned())]
    }

    pub(super) fn handles(&self) -> &Handles {
        self.handles.get_or_init(|| Handles {
            started: metrics::counter!("grpc_server_started_total", &self.labels()),
            seconds: metrics::histogram!("grpc_server_handling_seconds", &self.labels()),
            received: metrics::counter!("grpc_server_msg_received_total", &self.labels()),
            sent: metrics::counter!("grpc_server_msg_sent_total", &self.labels()),
        })
    }

    pub(super) fn handled(&self, code: Code) -> &Counter {
        self.handled[code as usize].get_or_init(|| {
            let [kind, service, method] = self.labels();
            let labels = [kind, service, method, ("grpc_code", code_name(code).to_owned())];
            metrics::counter!("grpc_server_handled_total", &labels)
        })
    }
}

/// All methods.
pub(super) struct Meters {
    methods: Vec<Method>,
    by_path: HashMap<String, usize>,
}

impl Meters {
    /// Those of these descriptor sets.
    ///
    /// # Panics
    /// When one does not decode: they are built into the program.
    pub(super) fn new(descriptors: &[&[u8]]) -> Self {
        let streams = Streams { client: false, server: false };
        let mut meters = Self { methods: vec![Method::new("unknown".to_owned(), streams)], by_path: HashMap::new() };
        for set in descriptors {
            let set = FileDescriptorSet::decode(*set).expect(super::BUILT_IN);
            for file in &set.file {
                for service in &file.service {
                    for method in &service.method {
                        let path = format!("{}.{}/{}", file.package(), service.name(), method.name());
                        let streams = Streams { client: method.client_streaming(), server: method.server_streaming() };
                        meters.by_path.insert(format!("/{path}"), meters.methods.len());
                        meters.methods.push(Method::new(path, streams));
                    }
                }
            }
        }
        meters
    }

    /// The number of the method called at `path`, as `/package.Service/Method`; 0 is none that is known.
    pub(super) fn find(&self, path: &str) -> usize {
        self.by_path.get(path).copied().unwrap_or(0)
    }

    pub(super) fn method(&self, number: usize) -> &Method {
        &self.methods[number]
    }
}

/// The code as gRPC middlewares write it in labels.
pub(super) fn code_name(code: Code) -> &'static str {
    match code {
        Code::Ok => "OK",
        Code::Cancelled => "Canceled",
        Code::Unknown => "Unknown",
        Code::InvalidArgument => "InvalidArgument",
        Code::DeadlineExceeded => "DeadlineExceeded",
        Code::NotFound => "NotFound",
        Code::AlreadyExists => "AlreadyExists",
        Code::PermissionDenied => "PermissionDenied",
        Code::ResourceExhausted => "ResourceExhausted",
        Code::FailedPrecondition => "FailedPrecondition",
        Code::Aborted => "Aborted",
        Code::OutOfRange => "OutOfRange",
        Code::Unimplemented => "Unimplemented",
        Code::Internal => "Internal",
        Code::Unavailable => "Unavailable",
        Code::DataLoss => "DataLoss",
        Code::Unauthenticated => "Unauthenticated",
    }
}

/// Counts the messages that begin in the pieces of a body: each has a head of 5 bytes, the last 4 its length.
#[derive(Debug, Default)]
pub(super) struct Frames {
    /// Bytes of the message that are still to come.
    rest: u64,
    /// Bytes of the next head that have come, and its length so far.
    head: (u8, u32),
}

impl Frames {
    /// How many messages' heads end in `piece`, which comes next.
    pub(super) fn count(&mut self, mut piece: &[u8]) -> u64 {
        let mut messages = 0;
        loop {
            let skipped = self.rest.min(piece.len() as u64);
            self.rest -= skipped;
            piece = &piece[skipped as usize..];
            let Some((&byte, after)) = piece.split_first() else { return messages };
            piece = after;
            let (have, length) = self.head;
            // The first byte tells whether the message is compressed.
            let length = if have == 0 { 0 } else { length << 8 | u32::from(byte) };
            self.head = (have + 1, length);
            if have == 4 {
                messages += 1;
                (self.rest, self.head) = (u64::from(length), (0, 0));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_are_counted_however_they_are_cut() {
        let mut body = Vec::new();
        for length in [0_u32, 3, 300, 0, 1] {
            body.push(0);
            body.extend(length.to_be_bytes());
            body.extend(vec![0xff; length as usize]);
        }
        for size in 1..body.len() {
            let mut frames = Frames::default();
            assert_eq!(body.chunks(size).map(|piece| frames.count(piece)).sum::<u64>(), 5, "in pieces of {size}");
        }
        let mut frames = Frames::default();
        assert_eq!(frames.count(&[0, 0xff, 0xff, 0xff, 0xff, 1, 2, 3]), 1);
        assert_eq!(frames.rest, u64::from(u32::MAX) - 3);
    }

    #[test]
    fn every_method_is_known_with_its_kind() {
        let meters = Meters::new(&[crate::wire::DESCRIPTORS, tonic_health::pb::FILE_DESCRIPTOR_SET]);
        let kind = |path| meters.method(meters.find(path)).streams.name();
        assert_eq!(kind("/qedgix.v1.PolicyService/Act"), "unary");
        assert_eq!(kind("/qedgix.v1.PolicyService/ActStream"), "bidi_stream");
        assert_eq!(kind("/qedgix.v1.WorkerService/UploadSnapshot"), "client_stream");
        assert_eq!(kind("/grpc.health.v1.Health/Watch"), "server_stream");
        for path in ["/qedgix.v1.PolicyService/Fly", "/", "", "qedgix.v1.PolicyService/Act"] {
            assert_eq!(meters.find(path), 0, "{path}");
        }
    }
}
