//! The frozen lists of layouts that policies are evaluated on (docs/model.md, "Evaluation").

use crate::invalid::Invalid;

/// A named, frozen list of layouts: the seeds of its episodes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LayoutList {
    /// Its name.
    pub name: &'static str,
    /// Seed of the first episode; the seeds are consecutive.
    pub first: u64,
    /// Number of episodes.
    pub episodes: u64,
}

impl LayoutList {
    /// The first `episodes` seeds of the list, or all if it has fewer.
    pub fn seeds(&self, episodes: usize) -> Vec<u64> {
        (self.first..self.first + self.episodes.min(episodes as u64)).collect()
    }
}

/// All lists: `eval-v1` for reports, `valid-v1` for choosing the best weights of a run. They share no seed with each other or
/// with training, whose seeds have the top bit set.
pub const LAYOUT_LISTS: [LayoutList; 2] = [
    LayoutList { name: "eval-v1", first: 10_000, episodes: 256 },
    LayoutList { name: "valid-v1", first: 20_000, episodes: 4096 },
];

/// The list with this name.
///
/// # Errors
/// [`Invalid`] if the name is unknown.
pub fn layout_list(name: &str) -> Result<LayoutList, Invalid> {
    let known = || LAYOUT_LISTS.map(|l| l.name).join(" or ");
    LAYOUT_LISTS.into_iter().find(|l| l.name == name).ok_or_else(|| Invalid::new("layouts", format!("{name:?}"), known()))
}
