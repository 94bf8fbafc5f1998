//! The names of the metrics that training jobs report, so that a misspelled one is refused instead of never found.

use crate::invalid::Invalid;
use crate::learner::Event;

/// Environment steps per second, which workers measure.
pub const SPEED: &str = "env_steps_per_s";

/// All names.
pub fn all() -> impl Iterator<Item = &'static str> {
    Event::METRICS.into_iter().chain([SPEED])
}

/// Whether jobs of this version report a metric of this name.
pub fn is_known(name: &str) -> bool {
    all().any(|known| known == name)
}

/// The error of a `field` with a `name` that no metric has. `known` are the names that exist.
pub fn unknown<'a>(field: &str, name: &str, known: impl IntoIterator<Item = &'a str>) -> Invalid {
    let known: Vec<&str> = known.into_iter().collect();
    Invalid::new(field, format!("{name:?}"), format!("one of {}", known.join(", ")))
}
