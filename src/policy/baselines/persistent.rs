//! `persistent`: every UAV keeps a random heading and draws another where the next move would leave the square.

use super::search::{Sight, Target};

#[derive(Default)]
pub(super) struct Persistent;

impl Target for Persistent {
    const NAME: &'static str = "persistent";
    const TEXT: &'static str = "Every UAV keeps a random heading and turns at the border.";

    fn choose(_seen: impl Iterator<Item = Sight>) -> Option<Sight> {
        None
    }
}
