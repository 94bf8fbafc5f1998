//! How much memory a message takes when it is decoded, estimated from its bytes and the descriptors of its type without decoding it.
//!
//! An element of a repeated field takes 2 bytes in a message if it is empty, and hundreds in memory. The estimate counts what decoding
//! allocates for elements, entries of maps, texts and numbers. Vectors grow by doubling, so a decoder may take up to twice as much.

use std::collections::HashMap;

use prost::Message as _;
use prost_types::field_descriptor_proto::{Label, Type};
use prost_types::{DescriptorProto, FieldDescriptorProto, FileDescriptorSet, MessageOptions, MethodDescriptorProto};

/// Nesting beyond which a message is refused. prost permits 100.
const MAX_DEPTH: usize = 128;
/// Entries for which a map has room when it gets its first one.
const FIRST_ENTRIES: usize = 11;

/// The message types of descriptors.
pub(super) struct Sizes {
    messages: Vec<Message>,
    /// The types of requests, by name.
    requests: HashMap<String, usize>,
}

/// Why a message is not decoded.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Refusal {
    /// It is no message.
    Malformed(&'static str),
    /// It would take more memory than permitted. The path of the field at which it does.
    Large(String),
}

#[derive(Default)]
struct Message {
    /// Bytes of a value, without what it refers to.
    size: usize,
    /// The fields, by number.
    fields: Vec<Option<Field>>,
}

struct Field {
    name: String,
    content: Content,
    /// Bytes that the first element adds, and each further one. 0 for a field that is not repeated: it is part of its message.
    first: usize,
    next: usize,
}

/// What a field with a length contains.
#[derive(Clone, Copy)]
enum Content {
    /// A message of this number.
    Message(usize),
    /// Text or bytes, which are copied.
    Bytes,
    /// Packed numbers, which take so many times their bytes.
    Packed(usize),
}

impl Sizes {
    /// The types of a descriptor set that contains all files that its files import.
    ///
    /// # Panics
    /// If it does not decode, or a type is missing. The caller passes a set that is built into the program.
    pub(super) fn new(descriptors: &[u8]) -> Self {
        let set = FileDescriptorSet::decode(descriptors).expect("the descriptors are built into the program");
        let mut types = Types::default();
        for file in &set.file {
            let package = if file.package().is_empty() { String::new() } else { format!(".{}", file.package()) };
            file.message_type.iter().for_each(|message| types.add(&package, message));
        }
        let mut messages = Vec::new();
        for number in 0..types.all.len() {
            let size = types.size(number, &mut Vec::new());
            messages.push(Message { size, fields: Vec::new() });
        }
        for (number, message) in types.all.iter().enumerate() {
            for field in &message.field {
                let at = field.number() as usize;
                let fields = &mut messages[number].fields;
                if fields.len() <= at {
                    fields.resize_with(at + 1, || None);
                }
                let field = types.field(field, &messages);
                messages[number].fields[at] = Some(field);
            }
        }
        let inputs = set
            .file
            .iter()
            .flat_map(|file| &file.service)
            .flat_map(|service| &service.method)
            .map(MethodDescriptorProto::input_type);
        let requests = inputs.map(|name| (name.trim_start_matches('.').to_owned(), types.numbers[name])).collect();
        Self { messages, requests }
    }

    /// Checks that the message of the type `name` takes at most `limit` bytes in memory. Types that are not of requests pass.
    pub(super) fn check(&self, name: &str, bytes: &[u8], limit: usize) -> Result<(), Refusal> {
        let Some(&number) = self.requests.get(name) else { return Ok(()) };
        let mut reader = Reader { sizes: self, bytes, at: 0, left: limit };
        reader.message(number, bytes.len(), 0)
    }
}

/// Message types while their sizes are computed.
#[derive(Default)]
struct Types<'a> {
    all: Vec<&'a DescriptorProto>,
    /// By name, with a leading dot.
    numbers: HashMap<String, usize>,
}

impl<'a> Types<'a> {
    fn add(&mut self, parent: &str, message: &'a DescriptorProto) {
        let name = format!("{parent}.{}", message.name());
        message.nested_type.iter().for_each(|nested| self.add(&name, nested));
        self.numbers.insert(name, self.all.len());
        self.all.push(message);
    }

    fn is_map(&self, field: &FieldDescriptorProto) -> bool {
        field.r#type() == Type::Message
            && self.all[self.numbers[field.type_name()]].options.as_ref().is_some_and(MessageOptions::map_entry)
    }

    /// Bytes of a value of the message type. `open`: the types that contain it, in which it is boxed.
    fn size(&self, number: usize, open: &mut Vec<usize>) -> usize {
        const VECTOR: usize = size_of::<Vec<u8>>();
        const MAP: usize = size_of::<HashMap<u8, u8>>();
        open.push(number);
        let message = self.all[number];
        let (mut size, mut choices) = (0, vec![0; message.oneof_decl.len()]);
        for field in &message.field {
            let repeated = field.label() == Label::Repeated;
            let value = match field.r#type() {
                _ if repeated && self.is_map(field) => MAP,
                _ if repeated => VECTOR,
                Type::Message | Type::Group => {
                    let inner = self.numbers[field.type_name()];
                    if open.contains(&inner) { size_of::<usize>() } else { self.size(inner, open) + 8 }
                }
                kind if field.proto3_optional() => value_size(kind).max(4) + width(kind).unwrap_or(0),
                kind => value_size(kind),
            };
            match field.oneof_index {
                Some(choice) if !field.proto3_optional() => choices[choice as usize] = value.max(choices[choice as usize]),
                _ => size += value,
            }
        }
        open.pop();
        size += choices.into_iter().filter(|&largest| largest > 0).map(|largest| largest + 8).sum::<usize>();
        size.next_multiple_of(8)
    }

    fn field(&self, field: &FieldDescriptorProto, messages: &[Message]) -> Field {
        let kind = field.r#type();
        let inner = matches!(kind, Type::Message | Type::Group).then(|| self.numbers[field.type_name()]);
        let content = match (inner, width(kind)) {
            (Some(inner), _) => Content::Message(inner),
            (None, None) => Content::Bytes,
            (None, Some(width)) => Content::Packed(if is_varint(kind) { width } else { 1 }),
        };
        let element = inner.map_or(value_size(kind), |inner| messages[inner].size);
        let (first, next) = match field.label() {
            Label::Repeated if self.is_map(field) => (FIRST_ENTRIES * element, 2 * element),
            Label::Repeated => (2 * element, element),
            _ => (0, 0),
        };
        Field { name: field.name().to_owned(), content, first, next }
    }
}

/// Bytes of a number in memory; `None`: no number.
fn width(kind: Type) -> Option<usize> {
    match kind {
        Type::Double | Type::Int64 | Type::Uint64 | Type::Sint64 | Type::Fixed64 | Type::Sfixed64 => Some(8),
        Type::Float | Type::Int32 | Type::Uint32 | Type::Sint32 | Type::Fixed32 | Type::Sfixed32 | Type::Enum => Some(4),
        Type::Bool => Some(1),
        Type::String | Type::Bytes | Type::Message | Type::Group => None,
    }
}

fn value_size(kind: Type) -> usize {
    let reference = if kind == Type::Bytes { size_of::<bytes::Bytes>() } else { size_of::<String>() };
    width(kind).unwrap_or(reference)
}

/// Whether a number has a variable length in a message: at least one byte.
fn is_varint(kind: Type) -> bool {
    !matches!(kind, Type::Double | Type::Fixed64 | Type::Sfixed64 | Type::Float | Type::Fixed32 | Type::Sfixed32)
}

const TRUNCATED: Refusal = Refusal::Malformed("it ends within a field");

/// Reads a message in the order in which prost decodes it.
struct Reader<'a> {
    sizes: &'a Sizes,
    bytes: &'a [u8],
    at: usize,
    /// Memory that the rest may take.
    left: usize,
}

impl Reader<'_> {
    fn message(&mut self, number: usize, end: usize, depth: usize) -> Result<(), Refusal> {
        if depth > MAX_DEPTH {
            return Err(Refusal::Malformed("it is nested too deeply"));
        }
        let message = &self.sizes.messages[number];
        let mut previous = None;
        while self.at < end {
            let (number, wire) = self.key()?;
            let Some(field) = message.fields.get(number).and_then(Option::as_ref) else {
                self.skip(number, wire, depth)?;
                continue;
            };
            let cost = if previous.replace(number) == Some(number) { field.next } else { field.first };
            self.take(cost).map_err(|()| Refusal::Large(field.name.clone()))?;
            if wire != LENGTH {
                self.skip(number, wire, depth)?;
                continue;
            }
            let length = self.length()?;
            match field.content {
                Content::Message(inner) => {
                    let inner_end = self.at + length;
                    self.message(inner, inner_end, depth + 1).map_err(|refusal| match refusal {
                        Refusal::Large(path) => Refusal::Large(format!("{}.{path}", field.name)),
                        Refusal::Malformed(what) => Refusal::Malformed(what),
                    })?;
                    if self.at != inner_end {
                        return Err(TRUNCATED);
                    }
                }
                Content::Bytes | Content::Packed(_) => {
                    let times = if let Content::Packed(times) = field.content { times } else { 1 };
                    self.take(length.saturating_mul(times)).map_err(|()| Refusal::Large(field.name.clone()))?;
                    self.at += length;
                }
            }
        }
        Ok(())
    }

    fn take(&mut self, cost: usize) -> Result<(), ()> {
        self.left = self.left.checked_sub(cost).ok_or(())?;
        Ok(())
    }

    /// Number and wire type of the next field.
    fn key(&mut self) -> Result<(usize, u64), Refusal> {
        let key = self.varint()?;
        Ok(((key >> 3) as usize, key & 7))
    }

    fn skip(&mut self, number: usize, wire: u64, depth: usize) -> Result<(), Refusal> {
        let bytes = match wire {
            0 => return self.varint().map(drop),
            1 => 8,
            LENGTH => self.length()?,
            GROUP if depth < MAX_DEPTH => loop {
                match self.key()? {
                    (end, GROUP_END) if end == number => return Ok(()),
                    (inner, wire) => self.skip(inner, wire, depth + 1)?,
                }
            },
            5 => 4,
            _ => return Err(Refusal::Malformed("a field has an unknown wire type")),
        };
        if bytes > self.bytes.len() - self.at {
            return Err(TRUNCATED);
        }
        self.at += bytes;
        Ok(())
    }

    /// The length of a field, all of which is there.
    fn length(&mut self) -> Result<usize, Refusal> {
        let length = self.varint()?;
        if length > (self.bytes.len() - self.at) as u64 { Err(TRUNCATED) } else { Ok(length as usize) }
    }

    fn varint(&mut self) -> Result<u64, Refusal> {
        let mut value = 0;
        for shift in (0..70).step_by(7) {
            let byte = *self.bytes.get(self.at).ok_or(TRUNCATED)?;
            self.at += 1;
            value |= u64::from(byte & 0x7f) << shift;
            if byte < 0x80 {
                return Ok(value);
            }
        }
        Err(Refusal::Malformed("a number has more than 10 bytes"))
    }
}

/// Wire types.
const LENGTH: u64 = 2;
const GROUP: u64 = 3;
const GROUP_END: u64 = 4;

#[cfg(test)]
mod tests {
    use prost::Name;

    use super::*;
    use crate::wire::{DESCRIPTORS, dm, oip, v1};

    const LIMIT: usize = 1 << 20;

    fn field(number: u8, content: &[u8]) -> Vec<u8> {
        let mut bytes = vec![number << 3 | 2];
        prost::encoding::encode_varint(content.len() as u64, &mut bytes);
        bytes.extend_from_slice(content);
        bytes
    }

    fn check<T: Name>(bytes: &[u8]) -> Result<(), Refusal> {
        Sizes::new(DESCRIPTORS).check(&T::full_name(), bytes, LIMIT)
    }

    #[test]
    fn sizes_of_types_are_close_to_the_real_ones() {
        let set = FileDescriptorSet::decode(DESCRIPTORS).unwrap();
        let sizes = Sizes::new(DESCRIPTORS);
        let mut types = Types::default();
        for file in &set.file {
            file.message_type.iter().for_each(|message| types.add(&format!(".{}", file.package()), message));
        }
        fn real<T: Name>() -> (String, usize) {
            (T::full_name(), size_of::<T>())
        }
        for (name, real) in [
            real::<v1::ActRequest>(),
            real::<v1::Node>(),
            real::<v1::Detection>(),
            real::<v1::SceneUser>(),
            real::<v1::Zone>(),
            real::<v1::World>(),
            real::<oip::ModelInferRequest>(),
            real::<oip::model_infer_request::InferInputTensor>(),
            real::<oip::InferTensorContents>(),
            real::<dm::dm_env_rpc::v1::Tensor>(),
            ("google.protobuf.Struct".to_owned(), size_of::<prost_types::Struct>()),
            ("google.protobuf.Value".to_owned(), size_of::<prost_types::Value>()),
        ] {
            let size = sizes.messages[types.numbers[&format!(".{name}")]].size;
            assert!(size >= real && size <= 2 * real, "{name}: {size} instead of {real}");
        }
    }

    #[test]
    fn many_empty_elements_are_refused_wherever_they_are() {
        let empty = |number: u8| field(number, &[]).repeat(100_000);
        let large = |path: &str| Err(Refusal::Large(path.to_owned()));
        assert_eq!(check::<v1::ActBatchRequest>(&empty(1)), large("requests"));
        assert_eq!(check::<v1::ActRequest>(&field(2, &empty(1))), large("graph.nodes"));
        assert_eq!(check::<v1::ActRequest>(&field(3, &empty(2))), large("scene.users"));
        assert_eq!(check::<v1::ActRequest>(&field(2, &field(1, &empty(3)))), large("graph.nodes.detections"));
        // Elements that are spread over many others.
        let spread = field(1, &field(3, &[])).repeat(5000);
        let refused = check::<v1::ActRequest>(&field(2, &spread));
        assert!(matches!(&refused, Err(Refusal::Large(path)) if path.starts_with("graph.nodes")), "{refused:?}");
        assert_eq!(check::<oip::ModelInferRequest>(&empty(5)), large("inputs"));
        assert_eq!(check::<oip::ModelInferRequest>(&empty(6)), large("outputs"));
        assert_eq!(check::<oip::ModelInferRequest>(&empty(7)), large("raw_input_contents"));
        assert_eq!(check::<oip::ModelInferRequest>(&empty(4)), large("parameters"));
        assert_eq!(check::<v1::StepRequest>(&empty(2)), large("actions"));
    }

    #[test]
    fn every_repeated_field_of_every_request_is_limited() {
        let sizes = Sizes::new(DESCRIPTORS);
        let mut seen = 0;
        for (name, &number) in &sizes.requests {
            for (at, known) in sizes.messages[number].fields.iter().enumerate() {
                let Some(known) = known.as_ref().filter(|f| f.next > 0 && !matches!(f.content, Content::Packed(_))) else {
                    continue;
                };
                seen += 1;
                let refused = sizes.check(name, &field(at as u8, &[]).repeat(100_000), LIMIT);
                assert_eq!(refused, Err(Refusal::Large(known.name.clone())), "{name}");
            }
        }
        assert!(seen > 10, "{seen}");
    }

    #[test]
    fn ordinary_messages_pass_and_malformed_ones_are_named() {
        let uav = |i: u32| v1::SceneUav { id: format!("uav-{i}"), x: 1.0, y: 2.0, ..Default::default() };
        let scene = v1::Scene { uavs: (0..2000).map(uav).collect(), users: Vec::new() };
        let observation = Some(v1::act_request::Observation::Scene(scene));
        let request = v1::ActRequest { policy: "sweep".into(), observation, ..Default::default() };
        let bytes = request.encode_to_vec();
        assert_eq!(check::<v1::ActRequest>(&bytes), Ok(()));
        assert_eq!(check::<v1::ActRequest>(&bytes[..bytes.len() - 1]), Err(TRUNCATED));
        // Unknown fields of every wire type, a group among them.
        let unknown =
            [0xa0, 0x06, 1, 0xa1, 0x06, 0, 0, 0, 0, 0, 0, 0, 0, 0xa3, 0x06, 0x0a, 1, 9, 0xa4, 0x06, 0xa5, 0x06, 1, 2, 3, 4];
        assert_eq!(check::<v1::ActRequest>(&[&unknown[..], &bytes].concat()), Ok(()));
        assert!(v1::ActRequest::decode(&[&unknown[..], &bytes].concat()[..]).is_ok());
        for wrong in [&[0x0a, 200][..], &[0x0a], &[0x0f], &[0xff; 11], &[0x12, 1, 0x0a, 1, 0]] {
            assert!(matches!(check::<v1::ActRequest>(wrong), Err(Refusal::Malformed(_))), "{wrong:?}");
            assert!(v1::ActRequest::decode(wrong).is_err(), "{wrong:?}");
        }
    }
}
