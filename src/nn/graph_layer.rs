//! The graph layers of agents behind one type (docs/model.md, "EdgeConv", "AggGNN", "RGCN").

use super::HIDDEN as H;
use super::batch::{Batch, Rows, RowsMut};
use super::edge_conv::{EdgeCache, EdgeNet, EdgeScratch, Pairing};
use super::graph::Graph;
use super::matmul::InitialValue;
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
    /// The paper's Algorithm 3: x'_i = update(x_i || mean_j message(x_i || x_j)).
    AggGnn {
        /// Network of the messages.
        message: EdgeNet,
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
    mean_message: Batch<T>,
    update: MlpCache<T>,
    rgcn: RgcnCache<T>,
}

/// Buffers of backward, shared by all layers.
#[derive(Debug, Default)]
pub struct LayerScratch<T: Real> {
    edge: EdgeScratch<T>,
    d_mean_message: Batch<T>,
}

impl GraphLayer {
    /// Adds the parameters `name.f.*`.
    pub fn edge_conv(layout: &mut ParameterLayout, name: &str, mean: bool) -> Self {
        Self::EdgeConv(EdgeNet::new(layout, &format!("{name}.f"), Pairing::Difference, mean))
    }

    /// Adds the parameters `name.com.*` and `name.update.*`.
    pub fn agg_gnn(layout: &mut ParameterLayout, name: &str) -> Self {
        let message = EdgeNet::new(layout, &format!("{name}.com"), Pairing::Plain, true);
        Self::AggGnn { message, update: Mlp::new(layout, &format!("{name}.update"), 2 * H, H) }
    }

    /// Adds the parameters `name.root.*` and `name.rel`.
    pub fn rgcn(layout: &mut ParameterLayout, name: &str) -> Self {
        Self::Rgcn(Rgcn::new(layout, name))
    }

    /// See [`Weights`].
    pub fn prepare<T: Real>(&self, params: &[T], prepared: &mut [T]) {
        match self {
            Self::EdgeConv(net) => net.prepare(params, prepared),
            Self::AggGnn { message, update } => {
                message.prepare(params, prepared);
                update.prepare(params, prepared);
            }
            Self::Rgcn(net) => net.prepare(params, prepared),
        }
    }

    /// The matrix products of a forward pass that reads `inputs` nodes and computes `outputs`, each as (rows, k, columns).
    pub fn products(&self, (inputs, outputs): (usize, usize)) -> Vec<[usize; 3]> {
        match self {
            Self::EdgeConv(net) => net.products((inputs, outputs)).to_vec(),
            Self::AggGnn { message, update } => [&message.products((inputs, outputs))[..], &update.products(outputs)].concat(),
            // The node itself and the means over both kinds of neighbours.
            Self::Rgcn(_) => vec![[outputs, H, H]; 3],
        }
    }

    /// Writes x' of the first `y.len` nodes, from x of all nodes.
    pub fn forward<T: Real>(&self, w: Weights<'_, T>, graph: &Graph, x: Rows<'_, T>, c: &mut LayerCache<T>, y: RowsMut<'_, T>) {
        match self {
            Self::EdgeConv(net) => net.forward(w, graph, x, &mut c.edge, y),
            Self::AggGnn { message, update } => {
                c.mean_message.resize(H, y.len);
                message.forward(w, graph, x, &mut c.edge, c.mean_message.rows_mut());
                let own = Rows { len: y.len, ..x };
                update.forward(w, (own, c.mean_message.rows(), H), &mut c.update, y);
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
            Self::EdgeConv(net) => net.backward(w.params, (graph, x, &c.edge), dy, &mut s.edge, (grads, dx)),
            Self::AggGnn { message, update } => {
                let own = Rows { len: dy.len(), ..x };
                update.backward(w.params, (own, c.mean_message.rows(), H), dy.rows(), &mut c.update, grads);
                let d = update.d_first(&c.update);
                s.d_mean_message.resize(H, dy.len());
                update.first.backward_input(w.params, (H, H), d, s.d_mean_message.rows_mut(), InitialValue::Zero);
                message.backward(w.params, (graph, x, &c.edge), &mut s.d_mean_message, &mut s.edge, (grads, dx));
                update.first.backward_input(w.params, (0, H), d, dx.range_mut(0..dy.len()), InitialValue::Previous);
            }
            Self::Rgcn(net) => net.backward(w, (graph, x, &mut c.rgcn), dy.rows(), (grads, dx)),
        }
    }
}
