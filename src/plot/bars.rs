//! Horizontal bars with error bars and their values.

use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, VPos};

use super::canvas::{self, Axes, BOTTOM, HEIGHT, INK, Key, Legend, TEXT, TOP, WIDTH, Words, all_fitting, text, text_width};
use super::data::Bar;
use super::palette::looks;
use super::scale::{drawable, extent, value};

/// Height of a bar in pixels.
const ROW: u32 = 30;
/// Least and greatest width of the labels in pixels.
const NAMES: [i32; 2] = [158, 300];

/// Bars as SVG. `value_label` labels the axis of the values, with the unit, and `note` says what the error bars are. The height depends on
/// the number of bars.
pub fn bars(title: &str, value_label: &str, note: &str, bars: &[Bar]) -> String {
    let ends = bars.iter().flat_map(|b| [b.mean, b.low, b.high]);
    let Some(range) = extent(ends.clone()) else { return canvas::no_data((WIDTH, HEIGHT), title) };
    let range = extent([0.0, range.start, range.end].into_iter()).unwrap_or(0.0..1.0);
    // Space for the value behind the longest bar, and before a negative bar.
    let span = range.end - range.start;
    let axis = if range.start < 0.0 { range.start - 0.04 * span } else { 0.0 }..range.end + 0.19 * span;
    let rows = bars.len().min(MAX_BARS);
    let legend = Legend::new(vec![(Key::Note, note.to_owned())]);
    let looks = looks(bars[..rows].iter().map(|bar| bar.name.as_str()));
    let widest = bars[..rows].iter().map(|bar| text_width(&bar.name, TEXT)).max();
    let names = (widest.unwrap_or_default() + 5).clamp(NAMES[0], NAMES[1]);
    let size = (WIDTH, TOP + BOTTOM + 6 + ROW * rows as u32 + legend.height());
    let means: Vec<String> = bars[..rows].iter().map(|bar| format!("{} {}", bar.name, value(bar.mean))).collect();
    let words = Words { title, description: format!("{value_label}: {}. {note}", means.join("; ")) };
    canvas::draw(size, &words, |sheet| {
        canvas::heading(sheet, title)?;
        // Bar i is at y = -i, so that the first is on top.
        let ranges = [axis, 0.5 - rows as f64..0.5];
        let axes = Axes {
            ranges,
            names: [value_label, ""],
            x_ticks: None,
            log_x: false,
            left: names as u32,
            right: 16,
            below: legend.height(),
        };
        let mut plot = canvas::axes(sheet, axes)?;
        let left = 10 + names;
        let labels: Vec<&str> = bars[..rows].iter().map(|bar| bar.name.as_str()).collect();
        let labels = all_fitting(&labels, names - 4, TEXT);
        for (i, bar) in bars[..rows].iter().enumerate() {
            let at = -(i as f64);
            let row = plot.backend_coord(&(0.0, at)).1;
            sheet.draw(&Text::new(labels[i].clone(), (left - 8, row), text(TEXT, INK, HPos::Right, VPos::Center)))?;
            if !drawable(bar.mean) {
                continue;
            }
            plot.draw_series([Rectangle::new([(0.0, at - 0.3), (bar.mean, at + 0.3)], looks[i].colour().mix(0.75).filled())])?;
            let interval = [bar.low.min(bar.high), bar.low.max(bar.high)];
            let known = interval.iter().all(|&x| drawable(x));
            if known {
                let [low, high] = interval;
                let strokes =
                    [[(low, at), (high, at)], [(low, at - 0.13), (low, at + 0.13)], [(high, at - 0.13), (high, at + 0.13)]];
                plot.draw_series(strokes.map(|stroke| PathElement::new(stroke, INK.stroke_width(2))))?;
            }
            let end = if known { bar.mean.max(interval[1]) } else { bar.mean }.max(0.0);
            let behind = plot.backend_coord(&(end, at)).0 + 9;
            sheet.draw(&Text::new(value(bar.mean), (behind, row), text(TEXT, INK, HPos::Left, VPos::Center)))?;
        }
        plot.draw_series([PathElement::new([(0.0, 0.5 - rows as f64), (0.0, 0.5)], INK)])?;
        legend.draw(sheet)
    })
}

/// Maximum number of bars that are drawn.
const MAX_BARS: usize = 60;
