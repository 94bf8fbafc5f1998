//! Errors of checkpoints.

use super::format::{FORMAT, MAX_MAGNITUDE, VERSION};
use crate::invalid::Invalid;

/// Why bytes are not a usable checkpoint.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Error {
    /// The file is shorter than its header.
    #[error("not a safetensors file: {found} bytes, fewer than the length and the {header} bytes of the header")]
    Truncated {
        /// Bytes of the file.
        found: usize,
        /// Bytes of the header, as far as the file says.
        header: u64,
    },
    /// The header is larger than the limit.
    #[error("not a safetensors file: a header of {found} bytes; expected at most {limit}")]
    HeaderTooLarge {
        /// Bytes of the header.
        found: u64,
        /// The limit.
        limit: u64,
    },
    /// The header is not JSON of the format, or has a name twice.
    #[error("not a safetensors file: header: {0}")]
    Header(String),
    /// The data of the tensors has a gap, overlaps, or exceeds the file.
    #[error("not a safetensors file: tensor `{name}` has bytes {start} to {end} of {len}; expected a start at {expected}")]
    Offsets {
        /// Name of the tensor.
        name: String,
        /// Offset of its first byte.
        start: usize,
        /// Offset behind its last byte.
        end: usize,
        /// Offset where its data must start.
        expected: usize,
        /// Bytes of data in the file.
        len: usize,
    },
    /// The shape of a tensor does not match the number of its bytes.
    #[error("not a safetensors file: tensor `{name}` of shape {shape:?} has {found} bytes")]
    Size {
        /// Name of the tensor.
        name: String,
        /// Its shape.
        shape: Vec<usize>,
        /// Bytes of its data.
        found: usize,
    },
    /// The file has data after the last tensor.
    #[error("not a safetensors file: {found} bytes of data; the tensors have {expected}")]
    TrailingData {
        /// Bytes of data in the file.
        found: usize,
        /// Bytes of all tensors.
        expected: usize,
    },
    /// The safetensors file was not written by this program.
    #[error("not a checkpoint of this program: metadata `format` is {found:?}; expected {:?}", FORMAT)]
    Format {
        /// The value in the file, if any.
        found: Option<String>,
    },
    /// The checkpoint has another version of the format.
    #[error("checkpoint version {found:?} cannot be read; expected {:?}", VERSION)]
    Version {
        /// The value in the file, if any.
        found: Option<String>,
    },
    /// A metadata entry is missing or cannot be parsed.
    #[error("metadata `{field}`: {reason}")]
    Metadata {
        /// Name of the entry.
        field: &'static str,
        /// The reason.
        reason: String,
    },
    /// The configuration is invalid.
    #[error("metadata `config`: {0}")]
    Config(#[from] Invalid),
    /// A parameter of the configuration is missing.
    #[error("tensor `{name}` is missing")]
    Missing {
        /// Its name.
        name: String,
    },
    /// A tensor is not a parameter of the configuration.
    #[error("tensor `{name}` is not a parameter of this configuration")]
    Unexpected {
        /// Its name.
        name: String,
    },
    /// A parameter has another shape.
    #[error("tensor `{name}` has shape {found:?}; expected {expected:?}")]
    Shape {
        /// Its name.
        name: String,
        /// The shape in the file.
        found: Vec<usize>,
        /// The shape in the configuration.
        expected: Vec<usize>,
    },
    /// A parameter has another type.
    #[error("tensor `{name}` has type {found}; expected F32")]
    Type {
        /// Its name.
        name: String,
        /// The type in the file.
        found: String,
    },
    /// A value is not finite or too large.
    #[error("tensor `{name}`: value {index} is {found}; expected a number from -{max} to {max}", max = MAX_MAGNITUDE)]
    Value {
        /// The tensor's name.
        name: String,
        /// Index into its values.
        index: usize,
        /// The value.
        found: f32,
    },
}
