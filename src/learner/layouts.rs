//! The frozen lists of layouts that policies are evaluated on (docs/model.md, "Evaluation").

use crate::env::EnvConfig;
use crate::invalid::Invalid;
use crate::rng;
use crate::train_config::Vary;

/// A named, frozen list of layouts: the seeds of its episodes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LayoutList {
    /// Its name.
    pub name: &'static str,
    /// Seed of the first episode; the seeds are consecutive.
    pub first: u64,
    /// Number of episodes.
    pub episodes: u64,
    /// Whether sizes, ranges and horizons are drawn, see [`LayoutList::environments`].
    pub mixed: bool,
}

impl LayoutList {
    /// The first `episodes` seeds of the list, or all if it has fewer.
    pub fn seeds(&self, episodes: usize) -> Vec<u64> {
        (self.first..self.first + self.episodes.min(episodes as u64)).collect()
    }
}

/// Episodes in a row of a mixed list that share a drawn environment.
const MIXED_GROUP: u64 = 8;

/// What mixed lists draw. The rest is that of the environment asked for.
const MIXED: Vary = Vary {
    uavs: Some([2, 6]),
    users: Some([4, 20]),
    slots: Some([40, 320]),
    transmission_range: None,
    detection_range: Some([0.2, 0.36]),
    communication_range: Some([0.2, 1.5]),
};

impl LayoutList {
    /// The fields of the environment that the list draws.
    pub fn drawn(&self) -> &'static [&'static str] {
        if self.mixed { &["uavs", "users", "slots", "detection_range", "communication_range"] } else { &[] }
    }

    /// The first `episodes` seeds of the list in groups, each with its environment: `base`, or in a mixed list one that is drawn
    /// for the group.
    pub fn environments(&self, base: &EnvConfig, episodes: usize) -> Vec<(EnvConfig, Vec<u64>)> {
        let seeds = self.seeds(episodes);
        if !self.mixed {
            return vec![(base.clone(), seeds)];
        }
        let draw = |group: &[u64]| MIXED.draw(base, &mut rng::stream(group[0], "mixed", 0));
        seeds.chunks(MIXED_GROUP as usize).map(|group| (draw(group), group.to_vec())).collect()
    }
}

/// All lists: `eval-v1`, `eval-v2` and `eval-mixed-v2` for reports, `valid-v1` and `valid-mixed-v1` for choosing weights and
/// settings. They share no seed with each other or with training, whose seeds have the top bit set.
pub const LAYOUT_LISTS: [LayoutList; 5] = [
    LayoutList { name: "eval-v1", first: 10_000, episodes: 256, mixed: false },
    LayoutList { name: "valid-v1", first: 20_000, episodes: 4096, mixed: false },
    LayoutList { name: "eval-v2", first: 30_000, episodes: 512, mixed: false },
    LayoutList { name: "eval-mixed-v2", first: 40_000, episodes: 512, mixed: true },
    LayoutList { name: "valid-mixed-v1", first: 50_000, episodes: 4096, mixed: true },
];

/// The list with this name.
///
/// # Errors
/// [`Invalid`] if the name is unknown.
pub fn layout_list(name: &str) -> Result<LayoutList, Invalid> {
    let known = || format!("one of {}", LAYOUT_LISTS.map(|l| l.name).join(", "));
    LAYOUT_LISTS.into_iter().find(|l| l.name == name).ok_or_else(|| Invalid::new("layouts", format!("{name:?}"), known()))
}
