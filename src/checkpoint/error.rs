//! Errors of checkpoints.

use super::format::{FORMAT, LARGEST, VERSION};
use crate::invalid::Invalid;

/// Why bytes are not a usable checkpoint.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Error {
    /// The bytes are truncated or damaged, or are not a safetensors file.
    #[error("not a safetensors file: {0}")]
    Container(String),
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
    #[error("tensor `{name}`: value {index} is {found}; expected a number from -{max} to {max}", max = LARGEST)]
    Value {
        /// The tensor's name.
        name: String,
        /// Index into its values.
        index: usize,
        /// The value.
        found: f32,
    },
}
