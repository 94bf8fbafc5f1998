//! The safetensors container: named f32 tensors and string metadata. Knows nothing of what they mean.
//!
//! Written here rather than by the crate, whose metadata has the order of a hash map: the same content must give the same
//! bytes, because files are known by their digest. Reading is the crate's.

use std::collections::BTreeMap;

use safetensors::{Dtype, SafeTensors};
use serde_json::{Map, Value, json};

use super::Error;

/// A named f32 tensor, row-major.
#[derive(Clone, Debug, PartialEq)]
pub struct Tensor {
    /// Name, as in the golden files: `agent.fc.weight`.
    pub name: String,
    /// Shape.
    pub shape: Vec<usize>,
    /// Values.
    pub values: Vec<f32>,
}

/// The bytes of a file; the same for the same content, whatever the order of `tensors`.
pub(super) fn write(metadata: &BTreeMap<&str, String>, tensors: &[Tensor]) -> Vec<u8> {
    let mut sorted: Vec<&Tensor> = tensors.iter().collect();
    sorted.sort_by(|a, b| a.name.cmp(&b.name));
    // serde_json's map is ordered by key, whatever the names.
    let mut header = Map::new();
    header.insert("__metadata__".into(), json!(metadata));
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

/// Metadata and tensors of a file, sorted by name. Only finite values of sensible size pass.
pub(super) fn read(bytes: &[u8]) -> Result<(BTreeMap<String, String>, Vec<Tensor>), Error> {
    let container = |e: safetensors::SafeTensorError| Error::Container(e.to_string());
    let (_, header) = SafeTensors::read_metadata(bytes).map_err(container)?;
    let metadata = header.metadata().clone().unwrap_or_default().into_iter().collect();
    let file = SafeTensors::deserialize(bytes).map_err(container)?;
    let mut tensors = Vec::with_capacity(file.len());
    for (name, view) in file.iter() {
        if view.dtype() != Dtype::F32 {
            return Err(Error::Type { name: name.into(), found: view.dtype().to_string() });
        }
        let values: Vec<f32> = view.data().chunks_exact(4).map(|x| f32::from_le_bytes([x[0], x[1], x[2], x[3]])).collect();
        if let Some(i) = values.iter().position(|x| x.is_nan() || x.abs() > super::LARGEST) {
            return Err(Error::Value { name: name.into(), index: i, found: values[i] });
        }
        tensors.push(Tensor { name: name.into(), shape: view.shape().to_vec(), values });
    }
    tensors.sort_by(|a, b| a.name.cmp(&b.name));
    Ok((metadata, tensors))
}
