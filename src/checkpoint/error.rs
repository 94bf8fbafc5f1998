//! Why bytes are not a checkpoint that can be used.

use crate::invalid::Invalid;

/// What is wrong with a checkpoint.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Error {
    /// Truncated, damaged, or something else altogether.
    #[error("not a safetensors file: {0}")]
    Container(String),
    /// A safetensors file of another program.
    #[error("not a checkpoint of this program: metadata `format` is {found:?}; expected {:?}", super::FORMAT)]
    Format {
        /// What the file says, if anything.
        found: Option<String>,
    },
    /// A checkpoint of another version of the format.
    #[error("checkpoint version {found:?} cannot be read; expected {:?}", super::VERSION)]
    Version {
        /// What the file says, if anything.
        found: Option<String>,
    },
    /// A metadata entry that is missing or does not parse.
    #[error("metadata `{field}`: {reason}")]
    Metadata {
        /// Which entry.
        field: &'static str,
        /// What is wrong with it.
        reason: String,
    },
    /// The configuration parses but cannot be.
    #[error("metadata `config`: {0}")]
    Config(#[from] Invalid),
    /// A parameter that the configuration asks for.
    #[error("tensor `{name}` is missing")]
    Missing {
        /// Its name.
        name: String,
    },
    /// A tensor that the configuration knows nothing of.
    #[error("tensor `{name}` is no parameter of this configuration")]
    Unexpected {
        /// Its name.
        name: String,
    },
    /// A parameter of another size.
    #[error("tensor `{name}` has shape {found:?}; expected {expected:?}")]
    Shape {
        /// Its name.
        name: String,
        /// The shape in the file.
        found: Vec<usize>,
        /// The shape that the configuration gives it.
        expected: Vec<usize>,
    },
    /// A parameter of another type.
    #[error("tensor `{name}` has type {found}; expected F32")]
    Type {
        /// Its name.
        name: String,
        /// The type in the file.
        found: String,
    },
    /// A value that no training leaves behind.
    #[error("tensor `{name}`: value {index} is {found}; expected a number from -{max} to {max}", max = super::LARGEST)]
    Value {
        /// The tensor's name.
        name: String,
        /// Index into its values.
        index: usize,
        /// The value.
        found: f32,
    },
}
