//! A ring buffer of whole episodes of one shape. AoI is stored as u16, actions as u8, positions as f32.

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::super::Episodes;
use crate::env::EnvConfig;

/// The last `capacity` episodes, all of the same shape.
#[derive(Clone, Debug, PartialEq)]
pub struct Ring {
    shape: EpisodeShape,
    capacity: usize,
    len: usize,
    /// Index at which the next episode is stored.
    next: usize,
    arrays: RingArrays,
    /// 0, 1, 2, ..; sampling permutes it temporarily.
    order: Vec<u32>,
}

/// Sizes of an episode.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct EpisodeShape {
    /// Number of UAVs M.
    pub uavs: usize,
    /// Number of users N.
    pub users: usize,
    /// Slots per episode K.
    pub slots: usize,
    /// Whether users move.
    pub users_move: bool,
}

/// The stored episodes as a structure of arrays; see [`Episodes`] for the layout of each.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RingArrays {
    pub uav_xy: Vec<f32>,
    pub user_xy: Vec<f32>,
    pub aoi: Vec<u16>,
    pub actions: Vec<u8>,
    pub reward: Vec<f32>,
    pub identity_token: Vec<f32>,
}

impl EpisodeShape {
    /// The shape of the episodes in `e`.
    pub fn of(e: &Episodes) -> Self {
        Self { uavs: e.uavs, users: e.users, slots: e.slots, users_move: e.users_move }
    }

    /// The shape of the episodes of an environment.
    pub fn of_environment(env: &EnvConfig) -> Self {
        Self { uavs: env.uavs, users: env.users, slots: env.slots, users_move: env.user_speed > 0.0 }
    }

    /// Values per episode of each array of [`RingArrays`], in its order.
    fn widths(&self) -> [usize; 6] {
        let (m, n, k) = (self.uavs, self.users, self.slots);
        let position_slots = if self.users_move { k + 1 } else { 1 };
        [(k + 1) * m * 2, position_slots * n * 2, (k + 1) * n, k * m, k, m * crate::policy::TOKEN]
    }

    /// Bytes of an episode in replay.
    pub fn bytes(&self) -> usize {
        let [uavs, users, aoi, actions, reward, identity_token] = self.widths();
        4 * (uavs + users + reward + identity_token) + 2 * aoi + actions
    }

    /// A batch of `len` episodes in which every number is `value`.
    #[cfg(test)]
    pub fn filled(&self, len: usize, value: f32) -> Episodes {
        let [uavs, users, aoi, actions, reward, identity_token] = self.widths().map(|width| vec![value; len * width]);
        let actions = actions.into_iter().map(|x| x as u8).collect();
        Episodes { len, uav_xy: uavs, user_xy: users, aoi, actions, reward, identity_token, ..self.episodes() }
    }

    /// An empty batch of this shape.
    pub fn episodes(&self) -> Episodes {
        let &Self { uavs, users, slots, users_move } = self;
        Episodes { uavs, users, slots, users_move, ..Episodes::default() }
    }
}

impl RingArrays {
    /// Whether all arrays are empty.
    pub fn is_empty(&self) -> bool {
        let floats = [&self.uav_xy, &self.user_xy, &self.reward, &self.identity_token];
        floats.into_iter().all(Vec::is_empty) && self.aoi.is_empty() && self.actions.is_empty()
    }

    /// Adds `other` at the end.
    #[cfg(test)]
    pub fn append(&mut self, other: &Self) {
        self.uav_xy.extend_from_slice(&other.uav_xy);
        self.user_xy.extend_from_slice(&other.user_xy);
        self.aoi.extend_from_slice(&other.aoi);
        self.actions.extend_from_slice(&other.actions);
        self.reward.extend_from_slice(&other.reward);
        self.identity_token.extend_from_slice(&other.identity_token);
    }

    /// Removes `episodes` episodes of this shape from the front; `None` if there are fewer.
    pub fn take_front(&mut self, shape: &EpisodeShape, episodes: usize) -> Option<Self> {
        fn take<T>(array: &mut Vec<T>, len: usize) -> Option<Vec<T>> {
            (len <= array.len()).then(|| array.drain(..len).collect())
        }
        let [uavs, users, aoi, actions, reward, identity_token] = shape.widths().map(|width| width * episodes);
        Some(Self {
            uav_xy: take(&mut self.uav_xy, uavs)?,
            user_xy: take(&mut self.user_xy, users)?,
            aoi: take(&mut self.aoi, aoi)?,
            actions: take(&mut self.actions, actions)?,
            reward: take(&mut self.reward, reward)?,
            identity_token: take(&mut self.identity_token, identity_token)?,
        })
    }
}

impl Ring {
    /// An empty ring for `capacity` episodes.
    pub fn new(shape: EpisodeShape, capacity: usize) -> Self {
        Self { shape, capacity, len: 0, next: 0, arrays: RingArrays::default(), order: Vec::new() }
    }

    /// A ring with this content; `None` if the sizes contradict each other.
    pub fn from_parts(shape: EpisodeShape, capacity: usize, next: usize, arrays: RingArrays) -> Option<Self> {
        let [uavs, users, aoi, actions, reward, identity_token] = shape.widths();
        let len = arrays.reward.len() / reward.max(1);
        let fits = [
            arrays.uav_xy.len() == len * uavs,
            arrays.user_xy.len() == len * users,
            arrays.aoi.len() == len * aoi,
            arrays.actions.len() == len * actions,
            arrays.reward.len() == len * reward,
            arrays.identity_token.len() == len * identity_token,
            len <= capacity,
            next == if len < capacity { len } else { next.min(capacity - 1) },
        ];
        let order = (0..len as u32).collect();
        fits.into_iter().all(|fit| fit).then_some(Self { shape, capacity, len, next, arrays, order })
    }

    /// The shape of its episodes.
    pub fn shape(&self) -> EpisodeShape {
        self.shape
    }

    /// Number of episodes held.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Index at which the next episode is stored.
    pub fn next(&self) -> usize {
        self.next
    }

    /// The stored episodes.
    pub fn arrays(&self) -> &RingArrays {
        &self.arrays
    }

    /// Bytes held.
    pub fn bytes(&self) -> usize {
        let d = &self.arrays;
        4 * (d.uav_xy.capacity()
            + d.user_xy.capacity()
            + d.reward.capacity()
            + d.identity_token.capacity()
            + self.order.capacity())
            + 2 * d.aoi.capacity()
            + d.actions.capacity()
    }

    /// Adds every episode of `batch`. When the ring is full, each replaces the oldest.
    ///
    /// # Panics
    /// If the episodes have another shape.
    pub fn push(&mut self, batch: &Episodes) {
        assert_eq!(EpisodeShape::of(batch), self.shape, "all episodes of a ring have one shape");
        let [uavs, users, aoi, actions, reward, identity_token] = self.shape.widths();
        for b in 0..batch.len {
            let at = self.next;
            put(&mut self.arrays.uav_xy, at, &batch.uav_xy[b * uavs..][..uavs], |x| x);
            put(&mut self.arrays.user_xy, at, &batch.user_xy[b * users..][..users], |x| x);
            put(&mut self.arrays.aoi, at, &batch.aoi[b * aoi..][..aoi], |x| x as u16);
            put(&mut self.arrays.actions, at, &batch.actions[b * actions..][..actions], |x| x);
            put(&mut self.arrays.reward, at, &batch.reward[b * reward..][..reward], |x| x);
            put(&mut self.arrays.identity_token, at, &batch.identity_token[b * identity_token..][..identity_token], |x| x);
            if self.len < self.capacity {
                self.order.push(self.len as u32);
                self.len += 1;
            }
            self.next = (at + 1) % self.capacity;
        }
    }

    /// Draws `count` different episodes uniformly into `batch`, reusing its allocations.
    ///
    /// # Panics
    /// If fewer than `count` episodes are held.
    pub fn sample(&mut self, count: usize, rng: &mut ChaCha8Rng, batch: &mut Episodes) {
        assert!(count <= self.len, "{count} different episodes of {}", self.len);
        let shape = self.shape;
        (batch.uavs, batch.users, batch.slots, batch.users_move) = (shape.uavs, shape.users, shape.slots, shape.users_move);
        batch.len = count;
        for array in [&mut batch.uav_xy, &mut batch.user_xy, &mut batch.aoi, &mut batch.reward, &mut batch.identity_token] {
            array.clear();
        }
        batch.actions.clear();
        // The first `count` steps of a shuffle. They are undone below, so that a draw depends on its own random stream only.
        let mut swaps = Vec::with_capacity(count);
        for i in 0..count {
            let j = rng.random_range(i..self.len);
            self.order.swap(i, j);
            swaps.push(j);
        }
        let [uavs, users, aoi, actions, reward, identity_token] = shape.widths();
        for &e in &self.order[..count] {
            let (e, arrays) = (e as usize, &self.arrays);
            batch.uav_xy.extend_from_slice(&arrays.uav_xy[e * uavs..][..uavs]);
            batch.user_xy.extend_from_slice(&arrays.user_xy[e * users..][..users]);
            batch.aoi.extend(arrays.aoi[e * aoi..][..aoi].iter().map(|&a| f32::from(a)));
            batch.actions.extend_from_slice(&arrays.actions[e * actions..][..actions]);
            batch.reward.extend_from_slice(&arrays.reward[e * reward..][..reward]);
            batch.identity_token.extend_from_slice(&arrays.identity_token[e * identity_token..][..identity_token]);
        }
        for (i, j) in swaps.into_iter().enumerate().rev() {
            self.order.swap(i, j);
        }
    }
}

/// Writes `values` as entry `at` of an array of equally long entries; appends if `at` is the number of entries.
fn put<T: Copy, U>(array: &mut Vec<U>, at: usize, values: &[T], convert: impl Fn(T) -> U) {
    let start = at * values.len();
    if start == array.len() {
        array.extend(values.iter().map(|&x| convert(x)));
    } else {
        for (held, &x) in array[start..].iter_mut().zip(values) {
            *held = convert(x);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng;

    const SHAPE: EpisodeShape = EpisodeShape { uavs: 3, users: 5, slots: 80, users_move: false };

    /// Episodes in which every value is the number of the episode.
    fn numbered(shape: EpisodeShape, numbers: std::ops::Range<usize>) -> Episodes {
        let [uavs, users, aoi, actions, reward, identity_token] = shape.widths();
        let fill = |width: usize| -> Vec<f32> { numbers.clone().flat_map(|e| vec![e as f32; width]).collect() };
        Episodes {
            len: numbers.len(),
            uav_xy: fill(uavs),
            user_xy: fill(users),
            aoi: fill(aoi),
            actions: fill(actions).into_iter().map(|x| x as u8).collect(),
            reward: fill(reward),
            identity_token: fill(identity_token),
            ..shape.episodes()
        }
    }

    fn sampled(replay: &mut Ring, count: usize, update: u64) -> Vec<usize> {
        let mut batch = Episodes::default();
        replay.sample(count, &mut rng::stream(1, "replay", update), &mut batch);
        batch.reward.chunks(replay.shape.slots).map(|r| r[0] as usize).collect()
    }

    #[test]
    fn the_oldest_episodes_are_replaced() {
        let mut replay = Ring::new(SHAPE, 10);
        replay.push(&numbered(SHAPE, 0..8));
        assert_eq!(replay.len(), 8);
        replay.push(&numbered(SHAPE, 8..16));
        assert_eq!(replay.len(), 10);
        let mut held = sampled(&mut replay, 10, 0);
        held.sort_unstable();
        assert_eq!(held, (6..16).collect::<Vec<_>>());
    }

    #[test]
    fn sampled_episodes_equal_the_stored_ones() {
        for shape in [SHAPE, EpisodeShape { users_move: true, ..SHAPE }] {
            let mut replay = Ring::new(shape, 10);
            replay.push(&numbered(shape, 0..7));
            let mut batch = Episodes::default();
            replay.sample(3, &mut rng::stream(1, "replay", 4), &mut batch);
            let first: Vec<usize> = batch.reward.chunks(80).map(|r| r[0] as usize).collect();
            let expected = first.iter().map(|&e| numbered(shape, e..e + 1));
            let mut joined = Episodes { len: 3, ..shape.episodes() };
            for e in expected {
                joined.uav_xy.extend(e.uav_xy);
                joined.user_xy.extend(e.user_xy);
                joined.aoi.extend(e.aoi);
                joined.actions.extend(e.actions);
                joined.reward.extend(e.reward);
                joined.identity_token.extend(e.identity_token);
            }
            assert_eq!(batch, joined);
        }
    }

    #[test]
    fn draws_are_uniform_without_replacement_and_independent() {
        let mut replay = Ring::new(SHAPE, 20);
        replay.push(&numbered(SHAPE, 0..20));
        let alone = sampled(&mut replay.clone(), 8, 77);
        let mut counts = [0; 20];
        for update in 0..2000 {
            let mut drawn = sampled(&mut replay, 8, update);
            for &e in &drawn {
                counts[e] += 1;
            }
            drawn.sort_unstable();
            drawn.dedup();
            assert_eq!(drawn.len(), 8);
        }
        assert_eq!(sampled(&mut replay, 8, 77), alone, "earlier draws have no effect");
        // 800 expected, standard deviation 22.
        assert!(counts.iter().all(|c| (690..910).contains(c)), "{counts:?}");
    }

    #[test]
    fn a_replay_of_the_paper_s_size_takes_less_than_50_mib() {
        let mut replay = Ring::new(SHAPE, 5000);
        let batch = numbered(SHAPE, 0..8);
        for _ in 0..700 {
            replay.push(&batch);
        }
        assert_eq!(replay.len(), 5000);
        assert!(replay.bytes() < 50 << 20, "{} bytes", replay.bytes());
    }

    #[test]
    fn aoi_beyond_u16_saturates() {
        let shape = EpisodeShape { uavs: 1, users: 1, slots: 1, users_move: false };
        let mut replay = Ring::new(shape, 1);
        let mut e = numbered(shape, 0..1);
        e.aoi = vec![65_534.0, 70_000.0];
        replay.push(&e);
        let mut batch = Episodes::default();
        replay.sample(1, &mut rng::stream(1, "replay", 0), &mut batch);
        assert_eq!(batch.aoi, [65_534.0, 65_535.0]);
    }
}
