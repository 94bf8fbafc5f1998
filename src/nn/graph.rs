//! The input of graph layers: a batch of graphs as lists of neighbours, and the number of nodes that each layer computes.
//!
//! The last layer computes only the nodes of the first kind, which come first. Nodes are ordered by the number of hops to the
//! nearest node of the first kind, so that each layer computes a prefix. Nodes more hops away than there are layers are left
//! out.

/// Neighbours of nodes 0..`reach[L - 1]` for L layers.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Graph {
    /// The neighbours of node i are `targets[offsets[i]..offsets[i + 1]]`.
    pub offsets: Vec<u32>,
    /// Node indices.
    pub targets: Vec<u32>,
    /// `reach[h]`: number of nodes within h hops of a node of the first kind; `reach[0]` counts the nodes of the first kind.
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

    /// Number of nodes of the first kind.
    pub fn first_kind_count(&self) -> usize {
        self.reach[0]
    }

    /// Number of nodes that layer `layer` of `layers` reads, and number that it computes.
    pub fn span(&self, layer: usize, layers: usize) -> (usize, usize) {
        (self.reach[layers - layer], self.reach[layers - layer - 1])
    }
}
