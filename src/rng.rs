//! Named, seeded, counter-based random streams (docs/model.md, "Determinism").
//!
//! A stream is a pure function of (seed, name, counter). Resuming needs no generator state: the code that draws numbers keeps a
//! counter, such as the number of an episode, and creates its stream again.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use sha2::{Digest, Sha256};

/// The random stream of (seed, name, counter).
pub fn stream(seed: u64, name: &str, counter: u64) -> ChaCha8Rng {
    let mut hash = Sha256::new();
    hash.update(seed.to_le_bytes());
    hash.update(name.as_bytes());
    let mut rng = ChaCha8Rng::from_seed(hash.finalize().into());
    rng.set_stream(counter);
    rng
}

/// The layout seed of training episode `episode`. Its top bit is set, so it differs from all evaluation seeds
/// (docs/model.md, "Evaluation").
pub fn training_episode_seed(seed: u64, episode: u64) -> u64 {
    use rand::RngExt;
    stream(seed, "training-episode", episode).random::<u64>() | 1 << 63
}
