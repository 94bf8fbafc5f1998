//! Ids into canonical order.

use std::collections::HashMap;

use super::name;
use crate::invalid::Invalid;
use crate::serving::{Fleet, MAX_NODES};

/// Ids of one kind with their places in the request.
#[derive(Debug, Default)]
pub(super) struct Ids {
    ids: Vec<(String, u32)>,
}

impl Ids {
    pub(super) fn with_capacity(capacity: usize) -> Self {
        Self { ids: Vec::with_capacity(capacity) }
    }

    /// Takes the id at `place` of the request's list.
    pub(super) fn push(&mut self, field: impl FnOnce() -> String, id: String, place: usize) -> Result<(), Invalid> {
        if id.is_empty() || id.len() > Fleet::LONGEST_ID {
            name(&field(), &id)?;
        }
        self.ids.push((id, place as u32));
        Ok(())
    }

    /// Ids in canonical order, and for each its place in the request.
    pub(super) fn sorted(mut self) -> (Vec<String>, Vec<u32>) {
        self.ids.sort_unstable_by(|a, b| Fleet::order(&a.0, &b.0));
        self.ids.into_iter().unzip()
    }
}

/// Checks how many nodes there are.
pub(super) fn check_counts(field: &str, uavs: usize, users: usize) -> Result<(), Invalid> {
    if uavs == 0 {
        return Err(Invalid::new(field, "no UAV", "at least one UAV"));
    }
    check_nodes(field, uavs + users)
}

/// Checks that there are not too many nodes.
pub(super) fn check_nodes(field: &str, nodes: usize) -> Result<(), Invalid> {
    if nodes > MAX_NODES {
        return Err(Invalid::new(field, format!("{nodes} nodes"), format!("at most {MAX_NODES}")));
    }
    Ok(())
}

/// Node index (UAVs first) of each id.
///
/// # Errors
/// An id that occurs twice; `field(uav, place)` names its second place.
pub(super) fn index<'a>(
    uavs: (&'a [String], &[u32]),
    users: (&'a [String], &[u32]),
    field: impl Fn(bool, u32) -> String,
) -> Result<HashMap<&'a str, u32>, Invalid> {
    let mut index = HashMap::with_capacity(uavs.0.len() + users.0.len());
    for (is_uav, (ids, places)) in [(true, uavs), (false, users)] {
        for (id, &place) in ids.iter().zip(places) {
            let node = index.len() as u32;
            if index.insert(id.as_str(), node).is_some() {
                return Err(Invalid::new(field(is_uav, place), format!("{id:?}"), "an id that no other node has"));
            }
        }
    }
    Ok(index)
}

/// For each place of the request, the canonical index: the inverse of `places`, which are places among `of_kind` nodes.
pub(super) fn request_order(places: &[u32]) -> Vec<u32> {
    let mut order: Vec<u32> = (0..places.len() as u32).collect();
    order.sort_unstable_by_key(|&canonical| places[canonical as usize]);
    order
}
