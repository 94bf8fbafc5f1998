//! Intervals that account for seeds and for layouts: values (S, L), every seed's policy on every layout.
//!
//! Both are drawn anew for each resample, crossed (the "pigeonhole" bootstrap): a layout that is hard for one seed is hard
//! for all, so resampling single values would promise too narrow an interval. With one seed, only layouts are drawn.

use rand::RngExt;

use crate::learner::Interval;
use crate::rng;

/// Mean of all values with its 95 % interval. Rows are seeds, and equally long.
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

/// First minus second, value by value; the shorter one's seeds.
pub(super) fn minus(first: &[Vec<f64>], second: &[Vec<f64>]) -> Vec<Vec<f64>> {
    let row = |(a, b): (&Vec<f64>, &Vec<f64>)| a.iter().zip(b).map(|(a, b)| a - b).collect();
    first.iter().zip(second).map(row).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seeds_that_differ_widen_the_interval() {
        let layout = |l: usize| 10.0 + (l % 7) as f64;
        let alike: Vec<Vec<f64>> = (0..4).map(|_| (0..100).map(layout).collect()).collect();
        let apart: Vec<Vec<f64>> = (0..4).map(|s| (0..100).map(|l| layout(l) + 2.0 * s as f64 - 3.0).collect()).collect();
        let (alike, apart) = (interval(&alike), interval(&apart));
        assert!((alike.mean - apart.mean).abs() < 1e-9);
        assert!(alike.low < alike.mean && alike.mean < alike.high);
        assert!(apart.high - apart.low > 2.0 * (alike.high - alike.low));
    }

    #[test]
    fn what_layouts_share_cancels_in_a_difference() {
        let first: Vec<Vec<f64>> = vec![(0..50).map(f64::from).collect(); 2];
        let second: Vec<Vec<f64>> = first.iter().map(|row| row.iter().map(|x| x + 1.0).collect()).collect();
        let d = interval(&minus(&first, &second));
        assert_eq!((d.mean, d.low, d.high), (-1.0, -1.0, -1.0));
        assert!(interval(&[]).mean.is_nan());
    }
}
