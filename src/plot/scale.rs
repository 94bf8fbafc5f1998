//! Ranges of axes, and formats of numbers.

use std::ops::Range;

/// Whether a number is drawable. With larger numbers, neighbouring ticks of an axis can be the same f64.
pub(super) fn drawable(x: f64) -> bool {
    x.abs() <= 1e12
}

/// The range of all drawable `values`; `None` if there are none. A range is never empty: a single value is widened.
pub(super) fn extent(values: impl Iterator<Item = f64>) -> Option<Range<f64>> {
    let (low, high) = values.filter(|&x| drawable(x)).fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), x| (l.min(x), h.max(x)));
    if low > high {
        return None;
    }
    let margin = (low.abs().max(high.abs()) * 1e-6).max(1e-6);
    Some(if high - low < margin { low - margin..high + margin } else { low..high })
}

/// The axis for `extent`: with a margin, and from zero if the data is not far from it.
pub(super) fn value_axis(extent: &Range<f64>) -> Range<f64> {
    let margin = 0.05 * (extent.end - extent.start);
    let from_zero = extent.start >= 0.0 && extent.start <= 0.7 * extent.end;
    let low = if from_zero { 0.0 } else { extent.start - margin };
    low..extent.end + margin
}

/// At most `count` round numbers in `range`: multiples of 1, 2 or 5 times a power of ten.
pub(super) fn ticks(range: &Range<f64>, count: usize) -> Vec<f64> {
    let span = range.end - range.start;
    let least = span / count.max(1) as f64;
    let power = 10f64.powf(least.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].map(|factor| factor * power).into_iter().find(|step| *step >= least * (1.0 - 1e-9));
    let Some(step) = step.filter(|step| step.is_normal()) else { return vec![range.start] };
    let (first, last) = ((range.start / step).ceil(), (range.end / step + 1e-9).floor());
    (0..=count).map(|i| first + i as f64).take_while(|&i| i <= last).map(|i| i * step).collect()
}

/// The number with this decimal logarithm, without the rounding error of the logarithm.
pub(super) fn unlog(x: f64) -> f64 {
    format!("{:.9e}", 10f64.powf(x)).parse().unwrap_or(f64::NAN)
}

/// Ticks of a logarithmic axis whose ends are decimal logarithms: powers of ten, and between few of them also twice and five times these.
pub(super) fn log_ticks(range: &Range<f64>) -> Vec<f64> {
    let inside = |x: &f64| (range.start - 1e-9..=range.end + 1e-9).contains(x);
    let (first, last) = (range.start.floor() as i32, range.end.ceil() as i32);
    let step = ((last - first) / 7 + 1) as usize;
    let powers: Vec<f64> = (first..=last).step_by(step).map(f64::from).filter(inside).collect();
    if powers.len() > 2 {
        return powers;
    }
    let all = (first..=last).flat_map(|power| [1.0_f64, 2.0, 5.0].map(|factor| f64::from(power) + factor.log10()));
    let found: Vec<f64> = all.filter(inside).collect();
    if found.is_empty() { vec![f64::midpoint(range.start, range.end)] } else { found }
}

/// The label of a tick: few digits, with k and M for thousands and millions.
pub(super) fn tick(x: f64) -> String {
    let (scaled, unit) = match x.abs() {
        a if a >= 1e9 => return format!("{x:.0e}"),
        a if a >= 1e6 => (x / 1e6, "M"),
        a if a >= 1e4 => (x / 1e3, "k"),
        a if a > 0.0 && a < 1e-4 => (x, ""),
        _ => return short(x, 4),
    };
    if unit.is_empty() {
        // A rounding error of zero, or a small number on an axis in powers of ten.
        return if scaled.abs() < 1e-12 { "0".to_owned() } else { format!("{scaled:.0e}") };
    }
    short(scaled, 3) + unit
}

/// `x` with at most `digits` decimals and no trailing zeros.
fn short(x: f64, digits: usize) -> String {
    let text = format!("{x:.digits$}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    if text == "-0" { "0".to_owned() } else { text.to_owned() }
}

/// The label of a value beside a bar, or in a description.
pub(super) fn value(x: f64) -> String {
    if !drawable(x) {
        return "none".to_owned();
    }
    if x != 0.0 && !(0.01..1e6).contains(&x.abs()) { format!("{x:.2e}") } else { format!("{x:.2}") }
}
