//! Finds what a UAV observes over several links (docs/model.md, "Graph"): every node within `hops` links of it.

use super::neighbor_search::Detection;

/// A breadth-first search and its buffers, kept from search to search: their size is that of the largest fleet.
#[derive(Debug, Default)]
pub struct HopSearch {
    found: Vec<Detection>,
    /// Number of the last search that visited each node.
    visited: Vec<u32>,
    searches: u32,
}

impl HopSearch {
    /// The nodes within `hops` links of `node`, without `node`, in ascending order of target. Each is at the sum of the relative
    /// positions along a shortest path; of several shortest paths, the first in order of targets. The detections of node i are
    /// `detections[offsets[i]..offsets[i + 1]]`.
    pub(super) fn find(&mut self, node: usize, hops: usize, offsets: &[u32], detections: &[Detection]) -> &[Detection] {
        self.visited.resize(self.visited.len().max(offsets.len() - 1), 0);
        self.searches = self.searches.wrapping_add(1);
        if self.searches == 0 {
            // After 2^32 searches, old marks could be taken for new ones.
            self.visited.fill(0);
            self.searches = 1;
        }
        self.visited[node] = self.searches;
        // `found` is its own queue. The node itself stands first until the search ends.
        self.found.clear();
        self.found.push(Detection { target: node as u32, rel: [0.0; 2] });
        let mut next = 0;
        for _ in 0..hops {
            let end = self.found.len();
            for i in next..end {
                let via = self.found[i];
                let at = via.target as usize;
                for d in &detections[offsets[at] as usize..offsets[at + 1] as usize] {
                    if std::mem::replace(&mut self.visited[d.target as usize], self.searches) != self.searches {
                        let rel = [via.rel[0] + d.rel[0], via.rel[1] + d.rel[1]];
                        self.found.push(Detection { target: d.target, rel });
                    }
                }
            }
            next = end;
        }
        self.found.swap_remove(0);
        self.found.sort_unstable_by_key(|d| d.target);
        &self.found
    }
}
