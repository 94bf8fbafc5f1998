//! Horizontal bars with error bars and their values.

use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, VPos};

use super::canvas::{self, INK, SIZE, colour, shorten, text};
use super::data::Bar;
use super::scale::{drawable, extent, value};

/// Height of a bar in pixels.
const ROW: u32 = 38;
/// Width of the labels in pixels.
const NAMES: u32 = 190;

/// Bars as SVG. `value_label` labels the axis of the values, with the unit. The height depends on the number of bars.
pub fn bars(title: &str, value_label: &str, bars: &[Bar]) -> String {
    let ends = bars.iter().flat_map(|b| [b.mean, b.low, b.high]);
    let Some(range) = extent(ends.clone()) else { return canvas::no_data(SIZE, title) };
    let range = extent([0.0, range.start, range.end].into_iter()).unwrap_or(0.0..1.0);
    // Space for the value behind the longest bar, and before a negative bar.
    let span = range.end - range.start;
    let axis = if range.start < 0.0 { range.start - 0.04 * span } else { 0.0 }..range.end + 0.14 * span;
    let rows = bars.len().min(MAX_BARS);
    let size = (SIZE.0, canvas::TOP + 62 + ROW * rows as u32);
    canvas::draw(size, |sheet| {
        canvas::heading(sheet, title)?;
        // Bar i is at y = -i, so that the first is on top.
        let mut plot = canvas::axes(sheet, [axis, 0.5 - rows as f64..0.5], [value_label, ""], (NAMES, 24))?;
        let left = 12 + NAMES as i32;
        for (i, bar) in bars[..rows].iter().enumerate() {
            let at = -(i as f64);
            let row = plot.backend_coord(&(0.0, at)).1;
            sheet.draw(&Text::new(shorten(&bar.name, 26), (left - 10, row), text(15, INK, HPos::Right, VPos::Center)))?;
            if !drawable(bar.mean) {
                continue;
            }
            plot.draw_series([Rectangle::new([(0.0, at - 0.3), (bar.mean, at + 0.3)], colour(i).mix(0.75).filled())])?;
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
            sheet.draw(&Text::new(value(bar.mean), (behind, row), text(15, INK, HPos::Left, VPos::Center)))?;
        }
        plot.draw_series([PathElement::new([(0.0, 0.5 - rows as f64), (0.0, 0.5)], INK)])?;
        Ok(())
    })
}

/// Maximum number of bars that are drawn.
const MAX_BARS: usize = 60;
