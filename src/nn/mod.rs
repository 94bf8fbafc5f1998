//! Layers with hand-derived gradients: `forward` beside `backward`. Pure arithmetic; independent of UAVs.
//!
//! Activations are in [`Batch`]es. All parameters of a network are in one flat vector described by a [`ParameterLayout`]. A layer
//! holds offsets into that vector, so that one network serves many threads and both scalar types. `forward` writes what
//! `backward` needs into caches of the caller, which are sized once and reused.

// Code that uses vector units must be inlined into a function that was compiled for them. Loops over several arrays of fixed
// width use an index. Views are passed by value, as slices are.
#![allow(clippy::inline_always, clippy::needless_range_loop, clippy::needless_pass_by_value)]
// Every layer panics if sizes do not fit together: that is a bug of the caller.
#![allow(clippy::missing_panics_doc)]

mod activations;
mod adam;
mod batch;
mod edge_conv;
mod edge_norm;
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
pub use embedding::{Embedding, EmbeddingParams};
pub use graph::Graph;
pub use graph_layer::{GraphLayer, LayerCache, LayerScratch};
pub use gru::Gru;
pub use linear::Linear;
pub use mlp::{Mlp, MlpCache};
pub use params::{Init, Parameter, ParameterLayout, Weights};
pub use real::Real;
pub use rgcn::{Rgcn, RgcnCache};
pub use simd::{VECTOR_WIDTH_VARIABLE, VectorWidth, simd};

/// H, the width of hidden activations.
pub const HIDDEN: usize = 64;
