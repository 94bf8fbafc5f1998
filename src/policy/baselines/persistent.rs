//! `persistent`: every UAV keeps a random heading and draws another where the next move would leave the square.

use super::search::{DetectedUser, TargetChoice};

#[derive(Default)]
pub(super) struct Persistent;

impl TargetChoice for Persistent {
    const NAME: &'static str = "persistent";
    const DESCRIPTION: &'static str = "Every UAV keeps a random heading and turns at the border.";

    fn choose(_detected: impl Iterator<Item = DetectedUser>) -> Option<DetectedUser> {
        None
    }
}
