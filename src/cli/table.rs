//! Tables and sparklines for terminals.

use comfy_table::{CellAlignment, Table, presets};

use crate::experiment::metric_cells;
use crate::learner::Summary;

/// A table of policies, the best first. AoI is in slots.
pub fn policy_table(rows: &[(String, Summary)]) -> Table {
    let mut rows: Vec<_> = rows.iter().collect();
    rows.sort_by(|a, b| a.1.mean_aoi.mean.total_cmp(&b.1.mean_aoi.mean));
    let mut table = Table::new();
    table.load_style(presets::ASCII_BORDERS_ONLY_CONDENSED);
    table.set_header(["policy", "mean AoI", "95 % interval", "p95", "peak", "coverage", "fairness"]);
    for (name, summary) in rows {
        table.add_row(std::iter::once(name.clone()).chain(metric_cells(&summary.mean_aoi, &summary.mean)));
    }
    for column in table.column_iter_mut().skip(1) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    table
}

/// A table with a header; without one if all its cells are empty.
pub fn text_table<H: AsRef<str>, R: IntoIterator<Item = String>>(
    header: impl IntoIterator<Item = H>,
    rows: impl IntoIterator<Item = R>,
) -> String {
    let header: Vec<String> = header.into_iter().map(|cell| cell.as_ref().to_owned()).collect();
    let mut table = Table::new();
    table.load_style(presets::ASCII_BORDERS_ONLY_CONDENSED);
    if header.iter().any(|cell| !cell.is_empty()) {
        table.set_header(header);
    }
    table.add_rows(rows);
    table.to_string()
}

/// A curve as a line of at most 40 characters.
pub fn sparkline(values: &[f64]) -> String {
    const WIDTH: usize = 40;
    let values: Vec<f64> = if values.len() > WIDTH {
        let shares = (0..WIDTH).map(|i| &values[i * values.len() / WIDTH..(i + 1) * values.len() / WIDTH]);
        shares.map(|share| share.iter().sum::<f64>() / share.len() as f64).collect()
    } else {
        values.to_vec()
    };
    const LEVELS: [char; 8] = ['▁', '▂', '▃', '▄', '▅', '▆', '▇', '█'];
    let low = values.iter().copied().fold(f64::INFINITY, f64::min);
    let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let level = |v: f64| if high > low { ((v - low) / (high - low) * 7.0).round() as usize } else { 0 };
    values.iter().map(|&v| LEVELS[level(v).min(7)]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sparkline_spans_its_levels() {
        assert_eq!(sparkline(&[3.0, 1.0, 2.0]), "█▁▅");
        assert_eq!(sparkline(&[5.0, 5.0]), "▁▁");
        assert_eq!(sparkline(&[]), "");
        let long: Vec<f64> = (0..1000).map(f64::from).collect();
        assert_eq!(sparkline(&long).chars().count(), 40);
        assert!(sparkline(&long).starts_with('▁') && sparkline(&long).ends_with('█'));
    }
}
