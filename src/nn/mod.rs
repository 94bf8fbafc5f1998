//! Layers with hand-derived gradients: forward beside backward. Pure arithmetic; knows nothing of UAVs.
//!
//! Activations live in [`Batch`]es (nalgebra storage, one column per sample). All parameters of a network live in one flat
//! vector described by a [`Layout`]; a layer holds offsets into it, so one network serves many threads and any scalar type.
//! `forward` writes what `backward` needs into buffers of the caller, which are sized once and reused.

// Kernels run inside a function compiled for the processor's vector units; what is not inlined into it loses them. Loops
// over several fixed-width arrays at once read best with an index. Views are passed by value, as slices are.
#![allow(clippy::inline_always, clippy::needless_range_loop, clippy::needless_pass_by_value)]
// Sizes that do not fit together are the caller's bugs; every layer asserts them.
#![allow(clippy::missing_panics_doc)]

mod adam;
mod batch;
mod edge;
mod embedding;
mod graph;
mod gru;
mod kernels;
mod layer;
mod linear;
pub mod matmul;
mod mlp;
mod norm;
mod params;
mod real;
mod rgcn;

pub use adam::{Adam, norm_squared};
pub use batch::{Batch, Rows, RowsMut};
pub use edge::{EdgeCache, EdgeNet, EdgeScratch, Pairing};
pub use embedding::{Embedding, EmbeddingGrad};
pub use graph::Graph;
pub use gru::Gru;
pub use kernels::{elu, leaky_relu, leaky_relu_back, relu, relu_back, simd};
pub use layer::{GraphLayer, LayerCache, LayerScratch};
pub use linear::Linear;
pub use mlp::{Mlp, MlpCache};
pub use params::{Init, Layout, Parameter, Weights};
pub use real::Real;
pub use rgcn::{Rgcn, RgcnCache};

/// H, the width of hidden activations.
pub const HIDDEN: usize = 64;
