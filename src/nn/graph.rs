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

    /// Values of edges in parts: those of the edges of `nodes` nodes each.
    pub fn edge_parts<'a, V>(&'a self, mut values: &'a mut [V], nodes: usize) -> impl Iterator<Item = &'a mut [V]> {
        let last = self.offsets.len() - 1;
        (0..last).step_by(nodes).map(move |first| {
            let edges = self.offsets[last.min(first + nodes)] - self.offsets[first];
            values.split_off_mut(..values.len().min(edges as usize)).expect("at most all")
        })
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
