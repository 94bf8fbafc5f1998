//! The graph layers of agents behind one type (docs/model.md, "EdgeConv", "AggGNN", "RGCN").

use super::HIDDEN as H;
use super::batch::{Batch, Rows, RowsMut};
use super::edge_conv::{EdgeCache, EdgeNet, EdgeScratch, Pairing};
use super::graph::Graph;
use super::matmul::Accumulate;
use super::mlp::{Mlp, MlpCache};
use super::params::{ParameterLayout, Weights};
use super::real::Real;
use super::rgcn::{Rgcn, RgcnCache};

/// Width of the hidden layer of update networks.
const W: usize = 96;

/// A graph layer, H wide at both ends.
#[derive(Clone, Copy, Debug)]
pub enum GraphLayer {
    /// The layer of Qedgix.
    EdgeConv(EdgeNet),
    /// The paper's Algorithm 3: x'_i = update(x_i || mean_j com(x_i || x_j)).
    AggGnn {
        /// Network of the messages.
        com: EdgeNet,
        /// Network that combines a node with its mean message.
        update: Mlp<W>,
    },
    /// The paper's Algorithm 4.
    Rgcn(Rgcn),
}

/// Values that backward needs. Each kind of layer uses its part.
#[derive(Debug, Default)]
pub struct LayerCache<T: Real> {
    edge: EdgeCache<T>,
    message: Batch<T>,
    update: MlpCache<T>,
    rgcn: RgcnCache<T>,
}

/// Buffers of backward, shared by all layers.
#[derive(Debug, Default)]
pub struct LayerScratch<T: Real> {
    edge: EdgeScratch<T>,
    message: Batch<T>,
}

impl GraphLayer {
    /// Adds the parameters `name.f.*`.
    pub fn edge_conv(layout: &mut ParameterLayout, name: &str, mean: bool) -> Self {
        Self::EdgeConv(EdgeNet::new(layout, &format!("{name}.f"), Pairing::Difference, mean))
    }

    /// Adds the parameters `name.com.*` and `name.update.*`.
    pub fn agg_gnn(layout: &mut ParameterLayout, name: &str) -> Self {
        let com = EdgeNet::new(layout, &format!("{name}.com"), Pairing::Plain, true);
        Self::AggGnn { com, update: Mlp::new(layout, &format!("{name}.update"), 2 * H, H) }
    }

    /// Adds the parameters `name.root.*` and `name.rel`.
    pub fn rgcn(layout: &mut ParameterLayout, name: &str) -> Self {
        Self::Rgcn(Rgcn::new(layout, name))
    }

    /// See [`Weights`].
    pub fn prepare<T: Real>(&self, flat: &[T], transposed: &mut [T]) {
        match self {
            Self::EdgeConv(net) => net.prepare(flat, transposed),
            Self::AggGnn { com, update } => {
                com.prepare(flat, transposed);
                update.prepare(flat, transposed);
            }
            Self::Rgcn(net) => net.prepare(flat, transposed),
        }
    }

    /// The matrix products of a forward pass that reads `read` nodes and computes `made`, each as (rows, k, columns).
    pub fn products(&self, (read, made): (usize, usize)) -> Vec<[usize; 3]> {
        match self {
            Self::EdgeConv(net) => net.products((read, made)).to_vec(),
            Self::AggGnn { com, update } => [&com.products((read, made))[..], &update.products(made)].concat(),
            // The node itself and the means over both kinds of neighbours.
            Self::Rgcn(_) => vec![[made, H, H]; 3],
        }
    }

    /// Writes x' of the first `y.len` nodes, from x of all nodes.
    pub fn forward<T: Real>(&self, w: Weights<'_, T>, graph: &Graph, x: Rows<'_, T>, c: &mut LayerCache<T>, y: RowsMut<'_, T>) {
        match self {
            Self::EdgeConv(net) => net.forward(w, graph, x, &mut c.edge, y),
            Self::AggGnn { com, update } => {
                c.message.reset(H, y.len);
                com.forward(w, graph, x, &mut c.edge, c.message.rows_mut());
                let own = Rows { len: y.len, ..x };
                update.forward(w, (own, c.message.rows(), H), &mut c.update, y);
            }
            Self::Rgcn(net) => net.forward(w, graph, x, &mut c.rgcn, y),
        }
    }

    /// Adds the gradients of the parameters and writes dx of all nodes read. Overwrites `dy` and the cache.
    pub fn backward<T: Real>(
        &self,
        w: Weights<'_, T>,
        (graph, x, c): (&Graph, Rows<'_, T>, &mut LayerCache<T>),
        dy: &mut Batch<T>,
        s: &mut LayerScratch<T>,
        (grads, dx): (&mut [T], &mut Batch<T>),
    ) {
        match self {
            Self::EdgeConv(net) => net.backward(w.flat, (graph, x, &c.edge), dy, &mut s.edge, (grads, dx)),
            Self::AggGnn { com, update } => {
                let own = Rows { len: dy.len(), ..x };
                update.backward(w.flat, (own, c.message.rows(), H), dy.rows(), &mut c.update, grads);
                let d = update.d_first(&c.update);
                s.message.reset(H, dy.len());
                update.first.backward_input(w.flat, (H, H), d, s.message.rows_mut(), Accumulate::Zero);
                com.backward(w.flat, (graph, x, &c.edge), &mut s.message, &mut s.edge, (grads, dx));
                update.first.backward_input(w.flat, (0, H), d, dx.range_mut(0..dy.len()), Accumulate::Add);
            }
            Self::Rgcn(net) => net.backward(w, (graph, x, &mut c.rgcn), dy.rows(), (grads, dx)),
        }
    }
}
