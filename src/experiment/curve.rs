//! The training curve of a run as rows (step, name, value), in the order of arrival. Rows that a resumed run computes again are
//! ignored, so its curve equals that of a run without interruption.

use std::collections::{BTreeMap, HashSet};
use std::fmt::Write;

use crate::invalid::Invalid;

/// A training curve.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TrainingCurve {
    rows: Vec<(u64, String, f64)>,
    known: HashSet<(u64, String)>,
}

const HEADER: &str = "step,name,value";

impl TrainingCurve {
    /// Adds a row, unless the curve has a row of this step and name.
    pub fn push(&mut self, step: u64, name: &str, value: f64) {
        if self.known.insert((step, name.to_owned())) {
            self.rows.push((step, name.to_owned(), value));
        }
    }

    /// Parses the output of [`TrainingCurve::csv`].
    ///
    /// # Errors
    /// [`Invalid`] for the first line that is not a row.
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

    /// Removes the rows after `step`.
    pub fn truncate(&mut self, step: u64) {
        self.rows.retain(|row| row.0 <= step);
        self.known.retain(|key| key.0 <= step);
    }

    /// The rows as CSV.
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
    fn a_parsed_curve_is_equal_and_ignores_repeated_rows() {
        let mut curve = TrainingCurve::default();
        curve.push(0, "eval/mean_aoi", 38.123_456_789_012_3);
        curve.push(640, "loss", 1e-12);
        curve.push(1280, "loss", 2.0);
        let mut parsed = TrainingCurve::parse(&curve.csv()).unwrap();
        assert_eq!(parsed, curve);
        parsed.truncate(640);
        parsed.push(640, "loss", 1e-12);
        parsed.push(1280, "loss", 2.0);
        assert_eq!(parsed.csv(), curve.csv());
        assert_eq!(curve.values("loss").len(), 2);
        assert!(TrainingCurve::parse("step,name,value\n1,loss").unwrap_err().to_string().contains("line 2"));
    }
}
