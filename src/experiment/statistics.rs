//! Bootstrap intervals over seeds and layouts, from values (S, L): the policy of each seed on each layout.
//!
//! Each resample draws seeds and layouts independently and combines them (the "pigeonhole" bootstrap). A layout that is difficult
//! for one seed is difficult for all, so resampling single values would give too narrow an interval. With one seed, only layouts
//! are resampled, and the interval excludes seed variance.

use rand::RngExt;

use crate::learner::Interval;
use crate::rng;

/// Mean of all values with its 95 % interval. A row holds the values of a seed; rows are equally long.
pub(super) fn interval(values: &[Vec<f64>]) -> Interval {
    let (seeds, layouts) = (values.len(), values.first().map_or(0, Vec::len));
    if seeds == 0 || layouts == 0 {
        return Interval { mean: f64::NAN, low: f64::NAN, high: f64::NAN };
    }
    let mut rng = rng::stream(0, "bootstrap-seeds", 0);
    let mut counts = vec![0.0; layouts];
    let mean = values.iter().flatten().sum::<f64>() / (seeds * layouts) as f64;
    Interval::of_resamples(mean, || {
        counts.fill(0.0);
        (0..layouts).for_each(|_| counts[rng.random_range(0..layouts)] += 1.0);
        let row = |row: &Vec<f64>| row.iter().zip(&counts).map(|(value, count)| value * count).sum::<f64>();
        let sum: f64 = (0..seeds).map(|_| row(&values[rng.random_range(0..seeds)])).sum();
        sum / (seeds * layouts) as f64
    })
}

/// First minus second, value by value, for the seeds that both have.
pub(super) fn minus(first: &[Vec<f64>], second: &[Vec<f64>]) -> Vec<Vec<f64>> {
    let row = |(a, b): (&Vec<f64>, &Vec<f64>)| a.iter().zip(b).map(|(a, b)| a - b).collect();
    first.iter().zip(second).map(row).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn different_seeds_widen_the_interval() {
        let layout = |l: usize| 10.0 + (l % 7) as f64;
        let alike: Vec<Vec<f64>> = (0..4).map(|_| (0..100).map(layout).collect()).collect();
        let apart: Vec<Vec<f64>> = (0..4).map(|s| (0..100).map(|l| layout(l) + 2.0 * s as f64 - 3.0).collect()).collect();
        let (alike, apart) = (interval(&alike), interval(&apart));
        assert!((alike.mean - apart.mean).abs() < 1e-9);
        assert!(alike.low < alike.mean && alike.mean < alike.high);
        assert!(apart.high - apart.low > 2.0 * (alike.high - alike.low));
    }

    #[test]
    fn effects_of_layouts_cancel_in_a_difference() {
        let first: Vec<Vec<f64>> = vec![(0..50).map(f64::from).collect(); 2];
        let second: Vec<Vec<f64>> = first.iter().map(|row| row.iter().map(|x| x + 1.0).collect()).collect();
        let d = interval(&minus(&first, &second));
        assert_eq!((d.mean, d.low, d.high), (-1.0, -1.0, -1.0));
        assert!(interval(&[]).mean.is_nan());
    }
}
