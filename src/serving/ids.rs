//! Ids as callers send them, brought into canonical order.

use std::collections::HashMap;

use super::{Fleet, MAX_NODES};
use crate::invalid::Invalid;

impl Fleet {
    /// Checks an id or a name that a caller chose.
    ///
    /// # Errors
    /// It is empty or too long.
    pub fn check_id(field: &str, id: &str) -> Result<(), Invalid> {
        if !id.is_empty() && id.chars().count() <= Self::LONGEST_ID {
            return Ok(());
        }
        Err(Invalid::new(field, format!("{id:?}"), format!("1 to {} characters", Self::LONGEST_ID)))
    }
}

/// Ids of UAVs, or of users, with their places in the request.
#[derive(Debug, Default)]
pub(crate) struct Ids {
    ids: Vec<(String, u32)>,
}

impl Ids {
    /// No ids yet, with memory for `capacity` of them.
    pub(crate) fn with_capacity(capacity: usize) -> Self {
        Self { ids: Vec::with_capacity(capacity) }
    }

    /// Adds the id at `place` of the request's list.
    ///
    /// # Errors
    /// It is empty or too long; `field` names it.
    pub(crate) fn push(&mut self, field: impl FnOnce() -> String, id: String, place: usize) -> Result<(), Invalid> {
        if id.is_empty() || id.len() > Fleet::LONGEST_ID {
            Fleet::check_id(&field(), &id)?;
        }
        self.ids.push((id, place as u32));
        Ok(())
    }

    /// The ids in canonical order, and for each its place in the request.
    pub(crate) fn sorted(mut self) -> (Vec<String>, Vec<u32>) {
        self.ids.sort_unstable_by(|a, b| Fleet::order(&a.0, &b.0));
        self.ids.into_iter().unzip()
    }
}

/// Checks the numbers of UAVs and users.
pub(crate) fn check_counts(field: &str, uavs: usize, users: usize) -> Result<(), Invalid> {
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

/// Checks that no id occurs twice; both lists are in canonical order, with places in the request.
///
/// # Errors
/// An id occurs twice; `field(is_uav, place)` names its second place.
pub(crate) fn check_distinct(
    uavs: (&[String], &[u32]),
    users: (&[String], &[u32]),
    field: impl Fn(bool, u32) -> String,
) -> Result<(), Invalid> {
    let repeated = |is_uav, id: &String, place| {
        Err(Invalid::new(field(is_uav, place), format!("{id:?}"), "an id that no other UAV or user has"))
    };
    for (is_uav, (ids, places)) in [(true, uavs), (false, users)] {
        if let Some(at) = ids.windows(2).position(|pair| pair[0] == pair[1]) {
            return repeated(is_uav, &ids[at + 1], places[at + 1]);
        }
    }
    let mut first = uavs.0.iter().peekable();
    for (id, &place) in users.0.iter().zip(users.1) {
        while first.next_if(|uav| Fleet::order(uav, id).is_lt()).is_some() {}
        if first.peek() == Some(&id) {
            return repeated(false, id, place);
        }
    }
    Ok(())
}

/// Node index (UAVs first) of each id; the ids are distinct.
pub(super) fn node_indices<'a>(uavs: &'a [String], users: &'a [String]) -> HashMap<&'a str, u32> {
    uavs.iter().chain(users).map(String::as_str).zip(0..).collect()
}

/// The canonical index of each place in the request: the inverse of `places`.
pub(crate) fn request_order(places: &[u32]) -> Vec<u32> {
    let mut order: Vec<u32> = (0..places.len() as u32).collect();
    order.sort_unstable_by_key(|&canonical| places[canonical as usize]);
    order
}
