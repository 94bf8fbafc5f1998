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
        return Err(Invalid::new(field, "no UAV", "at least 1 UAV"));
    }
    check_nodes(field, uavs + users)
}

/// Checks that there are not too many nodes.
pub(super) fn check_nodes(field: &str, nodes: usize) -> Result<(), Invalid> {
    if nodes > MAX_NODES {
        return Err(Invalid::new(field, format!("{nodes} UAVs and users"), format!("at most {MAX_NODES} UAVs and users")));
    }
    Ok(())
}

/// Checks that no id of either list, each in canonical order with places in the request, occurs twice.
///
/// # Errors
/// An id that does; `field(uav, place)` names its second place.
pub(super) fn distinct(
    uavs: (&[String], &[u32]),
    users: (&[String], &[u32]),
    field: impl Fn(bool, u32) -> String,
) -> Result<(), Invalid> {
    let again = |is_uav, id: &String, place| {
        Err(Invalid::new(field(is_uav, place), format!("{id:?}"), "an id that no other UAV or user has"))
    };
    for (is_uav, (ids, places)) in [(true, uavs), (false, users)] {
        if let Some(at) = ids.windows(2).position(|pair| pair[0] == pair[1]) {
            return again(is_uav, &ids[at + 1], places[at + 1]);
        }
    }
    let mut first = uavs.0.iter().peekable();
    for (id, &place) in users.0.iter().zip(users.1) {
        while first.next_if(|uav| Fleet::order(uav, id).is_lt()).is_some() {}
        if first.peek() == Some(&id) {
            return again(false, id, place);
        }
    }
    Ok(())
}

/// Node index (UAVs first) of each id; the ids are distinct.
pub(super) fn index<'a>(uavs: &'a [String], users: &'a [String]) -> HashMap<&'a str, u32> {
    uavs.iter().chain(users).map(String::as_str).zip(0..).collect()
}

/// For each place of the request, the canonical index: the inverse of `places`, which are places among `of_kind` nodes.
pub(super) fn request_order(places: &[u32]) -> Vec<u32> {
    let mut order: Vec<u32> = (0..places.len() as u32).collect();
    order.sort_unstable_by_key(|&canonical| places[canonical as usize]);
    order
}
