//! Looking for users without a plan: straight on, another way at the border.

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::World;
use super::geometry::{inside, moved};
use crate::env::{EnvConfig, Point};

/// The heading of a UAV that flies straight on. `course` is 1 + its heading, 0 before it has one. Where the move would leave
/// the square it draws among the headings that do not, or among all if none does.
pub(super) fn cruise(world: &World, rng: &mut ChaCha8Rng, at: Point, course: &mut f32) -> u8 {
    let stays = |h: usize| inside(moved(world, at, h));
    let heading = *course as usize;
    if !(1..=EnvConfig::COMPASS).contains(&heading) || !stays(heading - 1) {
        let open = (0..EnvConfig::COMPASS).filter(|&h| stays(h)).count();
        let draw = rng.random_range(0..if open == 0 { EnvConfig::COMPASS } else { open });
        let chosen = (0..EnvConfig::COMPASS).filter(|&h| open == 0 || stays(h)).nth(draw).unwrap_or(0);
        *course = (chosen + 1) as f32;
    }
    *course as u8 - 1
}
