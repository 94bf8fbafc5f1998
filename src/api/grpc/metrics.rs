//! Metrics of gRPC calls, under the names that gRPC middlewares share (`grpc_server_handled_total`, ...).
//!
//! The metric handles of a method are created at its first call and kept, so that counting neither allocates nor locks.
//! Unknown paths share one set of handles, because clients choose them and labels must be bounded.

use std::collections::{HashMap, HashSet};
use std::sync::OnceLock;

use metrics::{Counter, Histogram};
use prost::Message;
use prost_types::FileDescriptorSet;
use tonic::Code;

use super::worker::MAX_WORKER_MESSAGE;
use crate::api::access::{Requirement, grpc_requirement};
use crate::api::request_log::has_debug_span;
use crate::inflight::Class;
use crate::wire::oip::grpc_inference_service_server;
use crate::wire::v1::worker_service_server;

/// Maximum size of a message of health checks, probes and reflection, and of unknown methods.
const MAX_SMALL_MESSAGE: usize = 4 << 10;

/// Whether client and server send a stream of messages.
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
    /// Whether its spans have level DEBUG.
    pub(super) debug_span: bool,
    /// Maximum size of a message in bytes.
    pub(super) limit: usize,
    /// Whether its messages may be compressed.
    pub(super) compressed: bool,
    /// Which part of the budget of bytes in flight its calls use.
    pub(super) class: Class,
    metrics: OnceLock<MethodMetrics>,
    /// Completed calls by code.
    completed: [OnceLock<Counter>; 17],
}

/// The metrics of a method that do not depend on the code.
pub(super) struct MethodMetrics {
    pub(super) started: Counter,
    pub(super) seconds: Histogram,
    pub(super) received: Counter,
    pub(super) sent: Counter,
}

impl Method {
    fn new(path: String, streams: Streams, max_message: usize) -> Self {
        let (service, name) = path.rsplit_once('/').unwrap_or_default();
        let debug_span = has_debug_span(name);
        let is_open = grpc_requirement(&format!("/{path}")) == Requirement::NoKey;
        let class = if is_open { Class::Open } else { Class::Main };
        let limit = match service {
            worker_service_server::SERVICE_NAME => max_message.max(MAX_WORKER_MESSAGE),
            _ if is_open || service.starts_with("grpc.reflection.") => MAX_SMALL_MESSAGE,
            _ => max_message,
        };
        let compressed = service == grpc_inference_service_server::SERVICE_NAME;
        Self { path, streams, debug_span, limit, compressed, class, metrics: OnceLock::new(), completed: Default::default() }
    }

    fn labels(&self) -> [(&'static str, String); 3] {
        let (service, method) = self.path.rsplit_once('/').unwrap_or((&self.path, &self.path));
        let kind = self.streams.name().to_owned();
        [("grpc_type", kind), ("grpc_service", service.to_owned()), ("grpc_method", method.to_owned())]
    }

    pub(super) fn metrics(&self) -> &MethodMetrics {
        self.metrics.get_or_init(|| MethodMetrics {
            started: metrics::counter!("grpc_server_started_total", &self.labels()),
            seconds: metrics::histogram!("grpc_server_handling_seconds", &self.labels()),
            received: metrics::counter!("grpc_server_msg_received_total", &self.labels()),
            sent: metrics::counter!("grpc_server_msg_sent_total", &self.labels()),
        })
    }

    /// The counter of calls that completed with `code`.
    pub(super) fn completed(&self, code: Code) -> &Counter {
        self.completed[code as usize].get_or_init(|| {
            let [kind, service, method] = self.labels();
            let labels = [kind, service, method, ("grpc_code", code_name(code).to_owned())];
            metrics::counter!("grpc_server_handled_total", &labels)
        })
    }
}

/// All methods of the server, and one for unknown paths.
pub(super) struct Methods {
    methods: Vec<Method>,
    by_path: HashMap<String, usize>,
}

impl Methods {
    /// The methods in `descriptors`. Messages have at most `max_message` bytes, and less where callers need no key.
    ///
    /// # Panics
    /// If a descriptor set does not decode. The callers pass sets that are built into the program.
    pub(super) fn new(descriptors: &[&[u8]], max_message: usize) -> Self {
        let streams = Streams { client: false, server: false };
        let mut all =
            Self { methods: vec![Method::new("unknown".to_owned(), streams, MAX_SMALL_MESSAGE)], by_path: HashMap::new() };
        for set in descriptors {
            let set = FileDescriptorSet::decode(*set).expect(super::BUILT_IN);
            for file in &set.file {
                for service in &file.service {
                    for method in &service.method {
                        let path = format!("{}.{}/{}", file.package(), service.name(), method.name());
                        let streams = Streams { client: method.client_streaming(), server: method.server_streaming() };
                        all.by_path.insert(format!("/{path}"), all.methods.len());
                        all.methods.push(Method::new(path, streams, max_message));
                    }
                }
            }
        }
        all
    }

    /// The number of the method at `path` (`/package.Service/Method`), 0 if there is none.
    pub(super) fn find(&self, path: &str) -> usize {
        self.by_path.get(path).copied().unwrap_or(0)
    }

    /// The paths of the methods whose client streams.
    pub(super) fn client_streams(&self) -> HashSet<String> {
        let streams = self.by_path.iter().filter(|&(_, &number)| self.methods[number].streams.client);
        streams.map(|(path, _)| path.clone()).collect()
    }

    pub(super) fn get(&self, number: usize) -> &Method {
        &self.methods[number]
    }
}

/// The code in the spelling that gRPC middlewares use in labels.
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

/// Counts the messages in a body. Each message has a header of 5 bytes, of which the last 4 are its length.
#[derive(Debug, Default)]
pub(super) struct MessageCounter {
    /// Bytes missing from the current message.
    rest: u64,
    /// Number of header bytes received, and the part of the length in them.
    head: (u8, u32),
}

impl MessageCounter {
    /// The number of message headers that end in `piece`, the next piece of the body.
    pub(super) fn count(&mut self, mut piece: &[u8]) -> u64 {
        let mut messages = 0;
        loop {
            let skipped = self.rest.min(piece.len() as u64);
            self.rest -= skipped;
            piece = &piece[skipped as usize..];
            let Some((&byte, after)) = piece.split_first() else { return messages };
            piece = after;
            let (have, length) = self.head;
            // The first byte is the compression flag.
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
    fn messages_are_counted_for_any_split_of_the_body() {
        let mut body = Vec::new();
        for length in [0_u32, 3, 300, 0, 1] {
            body.push(0);
            body.extend(length.to_be_bytes());
            body.extend(vec![0xff; length as usize]);
        }
        for size in 1..body.len() {
            let mut counter = MessageCounter::default();
            assert_eq!(body.chunks(size).map(|piece| counter.count(piece)).sum::<u64>(), 5, "in pieces of {size}");
        }
        let mut counter = MessageCounter::default();
        assert_eq!(counter.count(&[0, 0xff, 0xff, 0xff, 0xff, 1, 2, 3]), 1);
        assert_eq!(counter.rest, u64::from(u32::MAX) - 3);
    }

    #[test]
    fn methods_are_found_with_their_stream_kind() {
        let methods = Methods::new(&[crate::wire::DESCRIPTORS, tonic_health::pb::FILE_DESCRIPTOR_SET], 1 << 20);
        let kind = |path| methods.get(methods.find(path)).streams.name();
        assert_eq!(kind("/qedgix.v1.PolicyService/Act"), "unary");
        assert_eq!(kind("/qedgix.v1.PolicyService/ActStream"), "bidi_stream");
        assert_eq!(kind("/qedgix.v1.WorkerService/UploadSnapshot"), "client_stream");
        assert_eq!(kind("/grpc.health.v1.Health/Watch"), "server_stream");
        for path in ["/qedgix.v1.PolicyService/Fly", "/", "", "qedgix.v1.PolicyService/Act"] {
            assert_eq!(methods.find(path), 0, "{path}");
        }
    }
}
