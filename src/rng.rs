//! Named, seeded, counter-based random streams (spec 5, determinism).
//!
//! A stream is a pure function of (seed, name, counter), so nothing needs to be stored to resume one: whoever draws
//! numbers keeps a counter (an episode, an iteration) and asks for its stream again.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use sha2::{Digest, Sha256};

/// The random stream `name` number `counter` of `seed`.
pub fn stream(seed: u64, name: &str, counter: u64) -> ChaCha8Rng {
    let mut hash = Sha256::new();
    hash.update(seed.to_le_bytes());
    hash.update(name.as_bytes());
    let mut rng = ChaCha8Rng::from_seed(hash.finalize().into());
    rng.set_stream(counter);
    rng
}

/// The layout seed of training episode `episode`: the top bit is set, so it never meets an evaluation seed (spec 7).
pub fn training_episode_seed(seed: u64, episode: u64) -> u64 {
    use rand::RngExt;
    stream(seed, "training-episode", episode).random::<u64>() | 1 << 63
}
