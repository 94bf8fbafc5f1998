//! The curve of a run as rows (step, name, value), in the order they came and without repetition, so that a run that goes on
//! from an older snapshot leaves the same curve as one that never stopped.

use std::collections::{BTreeMap, HashSet};
use std::fmt::Write;

use crate::invalid::Invalid;

/// Rows of a training curve.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Curve {
    rows: Vec<(u64, String, f64)>,
    known: HashSet<(u64, String)>,
}

const HEADER: &str = "step,name,value";

impl Curve {
    /// Adds a row, if it is new.
    pub fn push(&mut self, step: u64, name: &str, value: f64) {
        if self.known.insert((step, name.to_owned())) {
            self.rows.push((step, name.to_owned(), value));
        }
    }

    /// Reads what [`Curve::csv`] wrote.
    ///
    /// # Errors
    /// The line that is no row.
    pub fn parse(csv: &str) -> Result<Self, Invalid> {
        let mut curve = Self::default();
        for (i, line) in csv.lines().enumerate().skip(1) {
            let mut fields = line.splitn(3, ',');
            let row = (|| Some((fields.next()?.parse().ok()?, fields.next()?, fields.next()?.parse().ok()?)))();
            let (step, name, value) = row.ok_or_else(|| Invalid::new(format!("line {}", i + 1), format!("{line:?}"), HEADER))?;
            curve.push(step, name, value);
        }
        Ok(curve)
    }

    /// Forgets what came after `step`.
    pub fn truncate(&mut self, step: u64) {
        self.rows.retain(|row| row.0 <= step);
        self.known.retain(|key| key.0 <= step);
    }

    /// The rows as a file.
    pub fn csv(&self) -> String {
        let mut text = format!("{HEADER}\n");
        for (step, name, value) in &self.rows {
            writeln!(text, "{step},{name},{value}").expect("a string takes what is written");
        }
        text
    }

    /// The values called `name` by step.
    pub fn values(&self, name: &str) -> BTreeMap<u64, f64> {
        self.rows.iter().filter(|row| row.1 == name).map(|row| (row.0, row.2)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_curve_comes_back_and_repeats_no_row() {
        let mut curve = Curve::default();
        curve.push(0, "eval/mean_aoi", 38.123_456_789_012_3);
        curve.push(640, "loss", 1e-12);
        curve.push(1280, "loss", 2.0);
        let mut again = Curve::parse(&curve.csv()).unwrap();
        assert_eq!(again, curve);
        again.truncate(640);
        again.push(640, "loss", 1e-12);
        again.push(1280, "loss", 2.0);
        assert_eq!(again.csv(), curve.csv());
        assert_eq!(curve.values("loss").len(), 2);
        assert!(Curve::parse("step,name,value\n1,loss").unwrap_err().to_string().contains("line 2"));
    }
}
