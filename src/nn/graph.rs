//! A sparse batch of graphs, as graph layers see it: lists of neighbours, and how many nodes each layer needs.
//!
//! Only the first nodes (of the first kind) are outputs of the last layer. Nodes are ordered by their distance in hops to
//! the nearest of them, so what a layer must compute is always a prefix; nodes further away than there are layers are
//! left out.

/// Neighbours of nodes 0..`reach[L - 1]`, as one list after another.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Graph {
    /// Neighbours of node i are `targets[offsets[i]..offsets[i + 1]]`.
    pub offsets: Vec<u32>,
    /// Node indices.
    pub targets: Vec<u32>,
    /// `reach[h]`: nodes within h hops of a node of the first kind; `reach[0]` are those themselves.
    pub reach: Vec<usize>,
}

impl Graph {
    /// Neighbours of node i.
    #[inline(always)]
    pub fn neighbours(&self, i: usize) -> &[u32] {
        &self.targets[self.offsets[i] as usize..self.offsets[i + 1] as usize]
    }

    /// Number of neighbours of node i.
    #[inline(always)]
    pub fn degree(&self, i: usize) -> usize {
        (self.offsets[i + 1] - self.offsets[i]) as usize
    }

    /// Nodes of the first kind.
    pub fn first_kind(&self) -> usize {
        self.reach[0]
    }

    /// Nodes that layer `layer` of `layers` reads, and nodes that it computes.
    pub fn span(&self, layer: usize, layers: usize) -> (usize, usize) {
        (self.reach[layers - layer], self.reach[layers - layer - 1])
    }
}
