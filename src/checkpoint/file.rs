//! The safetensors container: named f32 tensors and string metadata.
//!
//! The `safetensors` crate is not used. It writes metadata in the order of a hash map, but the same content must give the same
//! bytes, because files are identified by their digest. The reader here rejects duplicate names, checks offsets without overflow,
//! and names the invalid tensor, because files come from untrusted sources.

use std::collections::BTreeMap;
use std::fmt;

use serde::de::{Error as _, MapAccess, Visitor};
use serde::{Deserialize, Deserializer};
use serde_json::{Map, Value, json};

use super::error::Error;
use super::format::MAX_MAGNITUDE;

/// The entry of the header that holds the metadata.
const METADATA: &str = "__metadata__";

/// A named f32 tensor, row-major.
#[derive(Clone, Debug, PartialEq)]
pub struct Tensor {
    /// Name, as `agent.fc.weight`.
    pub name: String,
    /// Shape.
    pub shape: Vec<usize>,
    /// Values.
    pub values: Vec<f32>,
}

/// The bytes of a file. The order of `tensors` does not matter: the same content gives the same bytes.
pub(super) fn write(metadata: &BTreeMap<&str, String>, tensors: &[Tensor]) -> Vec<u8> {
    let mut sorted: Vec<&Tensor> = tensors.iter().collect();
    sorted.sort_by(|a, b| a.name.cmp(&b.name));
    // The map of serde_json is ordered by key.
    let mut header = Map::new();
    header.insert(METADATA.into(), json!(metadata));
    let mut end = 0;
    for t in &sorted {
        let begin = end;
        end += t.values.len() * 4;
        header.insert(t.name.clone(), json!({"dtype": "F32", "shape": t.shape, "data_offsets": [begin, end]}));
    }
    let mut header = Value::Object(header).to_string().into_bytes();
    header.resize(header.len().next_multiple_of(8), b' ');
    let mut bytes = Vec::with_capacity(8 + header.len() + end);
    bytes.extend((header.len() as u64).to_le_bytes());
    bytes.extend(header);
    for t in sorted {
        bytes.extend(t.values.iter().flat_map(|x| x.to_le_bytes()));
    }
    bytes
}

/// Maximum size of the header in bytes: several times the largest configuration, which has a position for each UAV and user.
const MAX_HEADER_BYTES: u64 = 16 << 20;

/// Metadata and tensors of a file, sorted by name. Values that are not finite or too large are rejected. Memory is bounded by a
/// small multiple of the length of `bytes`, whatever sizes the header states.
pub(super) fn read(bytes: &[u8]) -> Result<(BTreeMap<String, String>, Vec<Tensor>), Error> {
    let Some((header_len, rest)) = bytes.split_first_chunk() else {
        return Err(Error::Truncated { found: bytes.len(), header: 0 });
    };
    let header_len = u64::from_le_bytes(*header_len);
    if header_len > MAX_HEADER_BYTES {
        return Err(Error::HeaderTooLarge { found: header_len, limit: MAX_HEADER_BYTES });
    }
    let Some((header, data)) = rest.split_at_checked(header_len as usize) else {
        return Err(Error::Truncated { found: bytes.len(), header: header_len });
    };
    let header: Header = serde_json::from_slice(header).map_err(|e| Error::Header(e.to_string()))?;
    let mut entries: Vec<(String, Entry)> = header.tensors.into_iter().collect();
    entries.sort_by_key(|(_, entry)| entry.data_offsets);
    let mut tensors = Vec::with_capacity(entries.len());
    let mut end = 0;
    for (name, Entry { dtype, shape, data_offsets: [from, to] }) in entries {
        if dtype != "F32" {
            return Err(Error::Type { name, found: dtype });
        }
        let Some(values) = data.get(from..to).filter(|_| from == end) else {
            return Err(Error::Offsets { name, start: from, end: to, expected: end, len: data.len() });
        };
        let size = shape.iter().try_fold(4, |size: usize, &n| size.checked_mul(n));
        if size != Some(values.len()) {
            return Err(Error::Size { name, shape, found: values.len() });
        }
        let values: Vec<f32> = values.chunks_exact(4).map(|x| f32::from_le_bytes([x[0], x[1], x[2], x[3]])).collect();
        if let Some(index) = values.iter().position(|x| x.is_nan() || x.abs() > MAX_MAGNITUDE) {
            return Err(Error::Value { name, index, found: values[index] });
        }
        end = to;
        tensors.push(Tensor { name, shape, values });
    }
    if end != data.len() {
        return Err(Error::TrailingData { found: data.len(), expected: end });
    }
    tensors.sort_by(|a, b| a.name.cmp(&b.name));
    Ok((header.metadata, tensors))
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    dtype: String,
    shape: Vec<usize>,
    data_offsets: [usize; 2],
}

#[derive(Default)]
struct Header {
    metadata: BTreeMap<String, String>,
    tensors: BTreeMap<String, Entry>,
}

impl<'de> Deserialize<'de> for Header {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Reader;

        impl<'de> Visitor<'de> for Reader {
            type Value = Header;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("an object of tensors and __metadata__")
            }

            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Header, A::Error> {
                let mut header = Header::default();
                while let Some(name) = map.next_key::<String>()? {
                    let duplicate = if name == METADATA {
                        let before = std::mem::replace(&mut header.metadata, map.next_value()?);
                        !before.is_empty()
                    } else {
                        header.tensors.insert(name.clone(), map.next_value()?).is_some()
                    };
                    // Other readers may use the other entry.
                    if duplicate {
                        return Err(A::Error::custom(format!("{name:?} occurs twice")));
                    }
                }
                Ok(header)
            }
        }

        deserializer.deserialize_map(Reader)
    }
}
