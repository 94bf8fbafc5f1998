//! Replay: the last episodes (docs/model.md, "Replay"). Memory grows with the episodes held, not with the capacity.
//!
//! Episodes of one environment are in one ring. With varied environments, each group of `envs` episodes, which share a drawn
//! environment, is a ring of its own, and updates draw groups.

mod ring;

use rand_chacha::ChaCha8Rng;

pub use self::ring::EpisodeShape;
pub(super) use self::ring::{Ring, RingArrays};
use super::{Episodes, TrainConfig};
use crate::env::EnvConfig;
use crate::policy::EnvParams;
use crate::rng;

/// The environment of the episodes that are collected together, of which `first_episode` is the number of the first.
pub(super) fn group_environment(config: &TrainConfig, first_episode: u64) -> EnvConfig {
    config.training.vary.draw(&config.environment, &mut rng::stream(config.seed, "vary", first_episode))
}

/// The last `training.buffer` episodes.
#[derive(Clone, Debug, PartialEq)]
pub struct Replay {
    groups: Vec<Group>,
    /// Maximum number of groups, with varied environments.
    max_groups: Option<usize>,
    /// Index of the group that is replaced next, with varied environments.
    next: usize,
}

/// Episodes of one environment.
#[derive(Clone, Debug, PartialEq)]
struct Group {
    env: EnvParams,
    ring: Ring,
}

impl Replay {
    /// An empty replay of a run of `config`.
    pub fn new(config: &TrainConfig) -> Self {
        let t = &config.training;
        if !t.vary.is_none() {
            return Self { groups: Vec::new(), max_groups: Some(t.buffer / t.envs), next: 0 };
        }
        let env = &config.environment;
        let ring = Ring::new(EpisodeShape::of_environment(env), t.buffer);
        Self { groups: vec![Group { env: env.into(), ring }], max_groups: None, next: 0 }
    }

    /// The replay of a run of `config` that has collected `episodes` episodes, with these arrays of all rings, one after another;
    /// `None` if the sizes contradict each other.
    pub(super) fn from_parts(config: &TrainConfig, episodes: u64, next: usize, mut arrays: RingArrays) -> Option<Self> {
        let mut replay = Self::new(config);
        let Some(max) = replay.max_groups else {
            let ring = Ring::from_parts(replay.groups[0].ring.shape(), config.training.buffer, next, arrays)?;
            replay.groups[0].ring = ring;
            return Some(replay);
        };
        let size = config.training.envs;
        let pushed = usize::try_from(episodes).ok()? / size;
        replay.next = pushed % max;
        if next != replay.next {
            return None;
        }
        for index in 0..pushed.min(max) {
            // The last group that was stored at this index.
            let number = index + (pushed - 1 - index) / max * max;
            let env = group_environment(config, (number * size) as u64);
            let shape = EpisodeShape::of_environment(&env);
            let ring = Ring::from_parts(shape, size, 0, arrays.take_front(&shape, size)?)?;
            replay.groups.push(Group { env: (&env).into(), ring });
        }
        arrays.is_empty().then_some(replay)
    }

    /// The rings in order.
    pub(super) fn rings(&self) -> impl Iterator<Item = &Ring> {
        self.groups.iter().map(|group| &group.ring)
    }

    /// Index at which the next episode, or with varied environments the next group, is stored.
    pub(super) fn next(&self) -> usize {
        if self.max_groups.is_some() { self.next } else { self.groups[0].ring.next() }
    }

    /// Number of episodes held.
    pub fn len(&self) -> usize {
        self.rings().map(Ring::len).sum()
    }

    /// Whether it holds no episode.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Bytes held.
    pub fn bytes(&self) -> usize {
        self.rings().map(Ring::bytes).sum()
    }

    /// Adds every episode of `batch`. When the replay is full, the oldest are replaced.
    ///
    /// # Panics
    /// If the episodes have another shape than those of the configuration.
    pub fn push(&mut self, batch: &Episodes) {
        let Some(max) = self.max_groups else {
            self.groups[0].ring.push(batch);
            return;
        };
        let mut ring = Ring::new(EpisodeShape::of(batch), batch.len);
        ring.push(batch);
        let group = Group { env: batch.env, ring };
        if self.groups.len() < max {
            self.groups.push(group);
        } else {
            self.groups[self.next] = group;
        }
        self.next = (self.next + 1) % max;
    }

    /// Draws `count` different episodes into `batch`, reusing its allocations: uniformly, or with varied environments whole groups.
    ///
    /// # Panics
    /// If fewer than `count` episodes are held.
    pub fn sample(&mut self, count: usize, rng: &mut ChaCha8Rng, batch: &mut Vec<Episodes>) {
        let drawn = if self.max_groups.is_none() {
            vec![0]
        } else {
            let size = self.groups[0].ring.len();
            rand::seq::index::sample(rng, self.groups.len(), count / size).into_vec()
        };
        let each = count / drawn.len();
        batch.resize_with(drawn.len(), Episodes::default);
        for (episodes, index) in batch.iter_mut().zip(drawn) {
            let Group { env, ring } = &mut self.groups[index];
            ring.sample(each, rng, episodes);
            episodes.env = *env;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train_config::{Algorithm, Preset, Vary};

    /// A configuration with groups of 2 episodes and a replay of 3 groups.
    fn config() -> TrainConfig {
        let mut config = TrainConfig::preset(Algorithm::Qmix, Preset::Practical);
        config.training.vary = Vary { uavs: Some([1, 5]), users: Some([1, 9]), slots: Some([3, 8]), ..Vary::default() };
        (config.training.envs, config.training.buffer, config.training.batch) = (2, 6, 4);
        config
    }

    /// The episodes of group `number`: their rewards are the number.
    fn group(config: &TrainConfig, number: usize) -> Episodes {
        let env = group_environment(config, 2 * number as u64);
        let shape = EpisodeShape::of_environment(&env);
        Episodes { env: (&env).into(), ..shape.filled(2, number as f32) }
    }

    #[test]
    fn groups_of_varied_environments_are_drawn_whole_and_the_oldest_is_replaced() {
        let config = config();
        let mut replay = Replay::new(&config);
        (0..5).for_each(|number| replay.push(&group(&config, number)));
        assert_eq!(replay.len(), 6);
        let (mut batch, mut seen) = (Vec::new(), std::collections::BTreeSet::new());
        for update in 0..50 {
            replay.sample(4, &mut rng::stream(1, "replay", update), &mut batch);
            assert_eq!(batch.len(), 2);
            for episodes in &batch {
                let number = episodes.reward[0] as usize;
                assert_eq!(*episodes, group(&config, number));
                seen.insert(number);
            }
        }
        assert_eq!(seen.into_iter().collect::<Vec<_>>(), [2, 3, 4]);
    }

    #[test]
    fn varied_groups_are_restored_from_their_arrays() {
        let config = config();
        for pushed in 0..8 {
            let mut replay = Replay::new(&config);
            (0..pushed).for_each(|number| replay.push(&group(&config, number)));
            let arrays = || {
                let mut all = RingArrays::default();
                replay.rings().for_each(|ring| all.append(ring.arrays()));
                all
            };
            let restored = Replay::from_parts(&config, 2 * pushed as u64, replay.next(), arrays());
            assert_eq!(restored.as_ref(), Some(&replay), "{pushed} groups");
            assert_eq!(Replay::from_parts(&config, 2 * pushed as u64 + 2, replay.next(), arrays()), None);
        }
    }
}
