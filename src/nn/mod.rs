//! Layers with hand-derived gradients: forward beside backward. Pure arithmetic; knows nothing of UAVs.
//!
//! Activations live in [`Batch`]es (nalgebra storage, one column per sample). All parameters of a network live in one flat
//! vector described by a [`ParameterLayout`]; a layer holds offsets into it, so one network serves many threads and any scalar type.
//! `forward` writes what `backward` needs into buffers of the caller, which are sized once and reused.

// Kernels run inside a function compiled for the processor's vector units; what is not inlined into it loses them. Loops
// over several fixed-width arrays at once read best with an index. Views are passed by value, as slices are.
#![allow(clippy::inline_always, clippy::needless_range_loop, clippy::needless_pass_by_value)]
// Sizes that do not fit together are the caller's bugs; every layer asserts them.
#![allow(clippy::missing_panics_doc)]

mod activations;
mod adam;
mod batch;
mod edge_conv;
mod embedding;
mod graph;
mod graph_layer;
mod gru;
mod layer_norm;
mod linear;
pub mod matmul;
mod mlp;
mod params;
mod real;
mod rgcn;
mod simd;

pub use activations::{argmax, elu, elu_slope, leaky_relu, leaky_relu_back, relu, relu_back};
pub use adam::{Adam, norm_squared};
pub use batch::{Batch, Rows, RowsMut};
pub use edge_conv::{EdgeCache, EdgeNet, EdgeScratch, Pairing};
pub use embedding::{Embedding, EmbeddingGrad};
pub use graph::Graph;
pub use graph_layer::{GraphLayer, LayerCache, LayerScratch};
pub use gru::Gru;
pub use linear::Linear;
pub use mlp::{Mlp, MlpCache};
pub use params::{Init, Parameter, ParameterLayout, Weights};
pub use real::Real;
pub use rgcn::{Rgcn, RgcnCache};
pub use simd::simd;

/// H, the width of hidden activations.
pub const HIDDEN: usize = 64;
