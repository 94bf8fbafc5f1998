//! Means over seeds with 95 % intervals of Student's t, for the few values that seeds give. A bootstrap over two values would only
//! return these values.

use serde::Serialize;

/// A mean over seeds with its 95 % interval; none of one value.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct MeanOverSeeds {
    /// Mean.
    pub mean: f64,
    /// Ends of the interval.
    pub interval: Option<[f64; 2]>,
}

impl MeanOverSeeds {
    /// The mean of one value per seed; `None` without values.
    pub fn of(values: &[f64]) -> Option<Self> {
        let n = values.len();
        let mean = (n > 0).then(|| values.iter().sum::<f64>() / n as f64)?;
        let interval = (n > 1).then(|| {
            let variance = values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / (n - 1) as f64;
            let half = quantile(n - 1) * (variance / n as f64).sqrt();
            [mean - half, mean + half]
        });
        Some(Self { mean, interval })
    }
}

/// The 0.975 quantile of Student's t distribution.
fn quantile(degrees: usize) -> f64 {
    const TABLE: [f64; 30] = [
        12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228, 2.201, 2.179, 2.160, 2.145, 2.131, 2.120, 2.110,
        2.101, 2.093, 2.086, 2.080, 2.074, 2.069, 2.064, 2.060, 2.056, 2.052, 2.048, 2.045, 2.042,
    ];
    // Beyond the table, the first terms of the expansion around the normal distribution.
    TABLE.get(degrees.saturating_sub(1)).copied().unwrap_or_else(|| 1.96 + 2.37 / degrees as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_seed_has_no_interval() {
        assert_eq!(MeanOverSeeds::of(&[]), None);
        assert_eq!(MeanOverSeeds::of(&[3.0]), Some(MeanOverSeeds { mean: 3.0, interval: None }));
        let [low, high] = MeanOverSeeds::of(&[1.0, 3.0]).unwrap().interval.unwrap();
        assert!((low + 10.706).abs() < 1e-9 && (high - 14.706).abs() < 1e-9, "{low} to {high}");
    }

    #[test]
    fn the_quantile_falls_to_that_of_the_normal_distribution() {
        let all: Vec<f64> = (1..500).map(quantile).collect();
        assert!(all.windows(2).all(|pair| pair[1] <= pair[0]), "{all:?}");
        assert!((quantile(100) - 1.984).abs() < 1e-3 && (quantile(1_000_000) - 1.96).abs() < 1e-3);
    }
}
