//! Fleet sizing: how many UAVs a policy needs to keep the 95th percentile of AoI at a target, also if one UAV is lost.

use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::{Interval, LostUav, interval};
use crate::env::EpisodeMetrics;
use crate::invalid::{Invalid, in_range};

/// Most times of a loss.
const TIMES: usize = 8;
/// Largest fleet that can be tried.
const MAX_UAVS: usize = 256;

/// What a fleet must keep, and the fleets to try.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SizingTarget {
    /// 95th percentile of AoI over users and slots that the fleet must keep, in slots.
    pub target_p95: f64,
    /// Largest fleet to try.
    pub max_uavs: usize,
    /// Whether a UAV is lost at each of several times, of the fleet that meets the target and of the next larger one.
    pub failures: bool,
}

/// A fleet of some size on the layouts. Intervals are over layouts.
#[derive(Clone, Copy, Debug)]
pub struct FleetSize {
    /// Number of UAVs.
    pub uavs: usize,
    /// 95th percentile of AoI.
    pub p95: Interval,
    /// Mean AoI.
    pub mean_aoi: Interval,
}

/// A UAV lost at `slot`, in fleets of two sizes.
#[derive(Clone, Copy, Debug)]
pub struct Failure {
    /// The slot.
    pub slot: usize,
    /// The fleet that meets the target, and the next larger one.
    pub sizes: [FleetSize; 2],
}

/// The fleets that were tried.
#[derive(Clone, Debug)]
pub struct Sizing {
    /// Fleets of 1, 2, 3, ... UAVs.
    pub sizes: Vec<FleetSize>,
    /// The smallest fleet whose p95 meets the target; `None`: not tried large enough.
    pub uavs: Option<usize>,
    /// Those by the ends of its interval.
    pub interval: [Option<usize>; 2],
    /// What a loss changes.
    pub failures: Vec<Failure>,
}

impl SizingTarget {
    /// Checks the fields.
    ///
    /// # Errors
    /// The first field that is out of range.
    pub fn validate(&self) -> Result<(), Invalid> {
        if !(self.target_p95 > 0.0 && self.target_p95.is_finite()) {
            return Err(Invalid::new("target_p95", self.target_p95, "a number above 0"));
        }
        in_range("max_uavs", self.max_uavs, 1..=MAX_UAVS)
    }

    /// Evaluations that may be needed, in episodes of `slots` slots.
    pub fn evaluations(&self, slots: usize) -> usize {
        self.max_uavs + if self.failures { 2 * TIMES.min(slots) } else { 0 }
    }

    /// Tries fleets of 1, 2, 3, ... UAVs until one surely meets the target. `evaluate` returns the metrics of the episodes of a fleet, or
    /// none to stop; then there is no result.
    ///
    /// # Errors
    /// The error of `evaluate`, or no episodes.
    pub fn run<E: From<Invalid>>(
        &self,
        slots: usize,
        mut evaluate: impl FnMut(usize, Option<LostUav>) -> Result<Option<Vec<EpisodeMetrics>>, E>,
    ) -> Result<Option<Sizing>, E> {
        let mut size = |uavs, lose| -> Result<Option<FleetSize>, E> {
            let Some(episodes) = evaluate(uavs, lose)? else { return Ok(None) };
            let of = |metric: fn(&EpisodeMetrics) -> f64| interval(&episodes.iter().map(metric).collect::<Vec<_>>());
            Ok(Some(FleetSize { uavs, p95: of(|episode| episode.p95_aoi)?, mean_aoi: of(|episode| episode.mean_aoi)? }))
        };
        let mut sizes = Vec::new();
        for uavs in 1..=self.max_uavs {
            let Some(tried) = size(uavs, None)? else { return Ok(None) };
            sizes.push(tried);
            if tried.p95.high <= self.target_p95 {
                break;
            }
        }
        let first = |p95: fn(&Interval) -> f64| sizes.iter().find(|size| p95(&size.p95) <= self.target_p95).map(|size| size.uavs);
        let (uavs, interval) = (first(|p95| p95.mean), [first(|p95| p95.low), first(|p95| p95.high)]);
        let mut failures = Vec::new();
        if let Some(uavs) = uavs.filter(|_| self.failures) {
            let times = TIMES.min(slots);
            for slot in (0..times).map(|k| k * slots / times) {
                let lose = Some(LostUav { uav: 0, slot });
                let (Some(smaller), Some(larger)) = (size(uavs, lose)?, size(uavs + 1, lose)?) else { return Ok(None) };
                failures.push(Failure { slot, sizes: [smaller, larger] });
            }
        }
        Ok(Some(Sizing { sizes, uavs, interval, failures }))
    }
}

impl Sizing {
    /// The fleets as JSON: the fields `uavs`, `interval`, `sizes` and `failures`, added to the object `document`.
    pub fn add_to(&self, document: &mut Value) {
        let size = |size: &FleetSize| json!({"uavs": size.uavs, "p95_aoi": size.p95, "mean_aoi": size.mean_aoi});
        let failure =
            |failure: &Failure| json!({"slot": failure.slot, "sizes": failure.sizes.iter().map(size).collect::<Vec<_>>()});
        document["uavs"] = json!(self.uavs);
        document["interval"] = json!(self.interval);
        document["sizes"] = self.sizes.iter().map(size).collect();
        document["failures"] = self.failures.iter().map(failure).collect();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn episode(aoi: f64) -> EpisodeMetrics {
        EpisodeMetrics { mean_aoi: aoi / 2.0, p95_aoi: aoi, ..EpisodeMetrics::default() }
    }

    #[test]
    fn fleets_grow_until_one_surely_meets_the_target() {
        let target = SizingTarget { target_p95: 10.0, max_uavs: 9, failures: true };
        let mut asked = Vec::new();
        // 20 / uavs, more or less; a lost UAV counts as none from its slot on.
        let sizing = target.run(4, |uavs, lose| {
            asked.push((uavs, lose.map(|lost| lost.slot)));
            let aoi = 20.0 / uavs as f64 + lose.map_or(0.0, |lost| 4.0 - lost.slot as f64);
            Ok::<_, Invalid>(Some(vec![episode(aoi - 1.0), episode(aoi + 1.0), episode(aoi)]))
        });
        let sizing = sizing.unwrap().unwrap();
        assert_eq!((sizing.uavs, sizing.interval), (Some(2), [Some(2), Some(3)]));
        assert_eq!(asked[..3], [(1, None), (2, None), (3, None)]);
        assert_eq!(asked[3..], [0, 1, 2, 3].map(|slot| [(2, Some(slot)), (3, Some(slot))]).concat());
        assert!(asked.len() <= target.evaluations(4));
        let mut document = json!({});
        sizing.add_to(&mut document);
        assert_eq!((&document["uavs"], document["failures"][3]["sizes"][1]["uavs"].as_u64()), (&json!(2), Some(3)));
    }

    #[test]
    fn it_stops_and_refuses_what_is_out_of_range() {
        let target = SizingTarget { target_p95: 1.0, max_uavs: 3, failures: false };
        let stopped = target.run(4, |uavs, _| Ok::<_, Invalid>((uavs < 2).then(|| vec![episode(5.0)])));
        assert!(stopped.unwrap().is_none());
        for (wrong, field) in [
            (SizingTarget { target_p95: 0.0, ..target }, "target_p95"),
            (SizingTarget { target_p95: f64::NAN, ..target }, "target_p95"),
            (SizingTarget { max_uavs: 0, ..target }, "max_uavs"),
            (SizingTarget { max_uavs: 257, ..target }, "max_uavs"),
        ] {
            assert_eq!(wrong.validate().unwrap_err().field, field);
        }
    }
}
