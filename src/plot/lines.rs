//! Curves, and distributions of a metric over layouts.

use std::ops::Range;

use plotters::prelude::*;

use super::canvas::{self, Axes, Drawn, HEIGHT, Key, Legend, Plot, Sheet, WIDTH, Words};
use super::data::{Chart, Series};
use super::palette::{Look, looks};
use super::scale::{drawable, extent, log_ticks, value, value_axis};

/// Most different x values that are ticks of a chart with markers.
const MAX_TICKS: usize = 8;

/// Curves with bands, or with markers and error bars, as SVG.
pub fn lines(chart: &Chart) -> String {
    if chart.log_x { logarithmic(chart) } else { linear(chart) }
}

/// The chart with the decimal logarithms of its x values.
fn logarithmic(chart: &Chart) -> String {
    let mut chart = chart.clone();
    for point in chart.series.iter_mut().flat_map(|series| &mut series.points) {
        // A number that has no logarithm is not drawable.
        point[0] = if point[0] > 0.0 { point[0].log10() } else { f64::NAN };
    }
    linear(&chart)
}

fn linear(chart: &Chart) -> String {
    let all = || chart.series.iter().flat_map(|s| drawable_points(&s.points));
    let bands = chart.series.iter().flat_map(drawable_pieces).flatten().filter_map(|(_, band)| band).flatten();
    let levels = chart.levels.iter().map(|(_, value)| *value);
    let (Some(x), Some(y)) = (extent(all().map(|p| p[0])), extent(all().map(|p| p[1]).chain(bands).chain(levels))) else {
        return canvas::no_data((WIDTH, HEIGHT), &chart.title);
    };
    // With few x values, such as numbers of UAVs, exactly these are ticks. Markers do not touch the frame.
    let (x, ticks) = if chart.markers { (with_margin(&x), own_ticks(all().map(|p| p[0]).collect(), &x)) } else { (x, None) };
    let ticks = if chart.log_x { ticks.or_else(|| Some(log_ticks(&x))) } else { ticks };
    plot(chart, [x, value_axis(&y)], ticks)
}

/// The x values themselves, if they are few and far enough from each other for their labels.
fn own_ticks(mut values: Vec<f64>, x: &Range<f64>) -> Option<Vec<f64>> {
    values.sort_by(f64::total_cmp);
    values.dedup();
    let apart = values.windows(2).all(|pair| pair[1] - pair[0] >= 0.09 * (x.end - x.start));
    (values.len() <= MAX_TICKS && apart).then_some(values)
}

/// The empirical distribution of each series as SVG: the share of its values that are at most x.
pub fn distribution(title: &str, x: &str, series: &[(String, Vec<f64>)]) -> String {
    let Some(range) = extent(series.iter().flat_map(|(_, values)| values.iter().copied())) else {
        return canvas::no_data((WIDTH, HEIGHT), title);
    };
    let axis = value_axis(&range);
    let curves = series.iter().map(|(name, values)| {
        let mut values: Vec<f64> = values.iter().copied().filter(|&v| drawable(v)).collect();
        values.sort_by(f64::total_cmp);
        let fraction = |i: usize| i as f64 / values.len() as f64;
        let points = values.iter().enumerate().flat_map(|(i, &v)| [[v, fraction(i)], [v, fraction(i + 1)]]).collect();
        Series { name: name.clone(), points, band: None }
    });
    let chart = Chart {
        title: title.to_owned(),
        x: x.to_owned(),
        y: "share of layouts at or below".to_owned(),
        series: curves.collect(),
        ..Chart::default()
    };
    plot(&chart, [axis, 0.0..1.02], None)
}

fn plot(chart: &Chart, ranges: [Range<f64>; 2], x_ticks: Option<Vec<f64>>) -> String {
    let names = chart.series.iter().map(|s| s.name.as_str()).chain(chart.levels.iter().map(|(name, _)| name.as_str()));
    let looks = looks(names);
    let (of_series, of_levels) = looks.split_at(chart.series.len());
    let mut entries: Vec<_> =
        chart.series.iter().zip(of_series).map(|(s, look)| (Key::Line(*look, chart.markers), s.name.clone())).collect();
    entries.extend(chart.levels.iter().zip(of_levels).map(|((name, _), look)| (Key::Line(*look, false), name.clone())));
    entries.push((Key::Note, chart.note.clone()));
    let legend = Legend::new(entries);
    let words = Words { title: &chart.title, description: description(chart) };
    canvas::draw((WIDTH, HEIGHT + legend.height()), &words, |sheet| {
        canvas::heading(sheet, &chart.title)?;
        let x = ranges[0].clone();
        let axes = Axes {
            ranges,
            names: [&chart.x, &chart.y],
            x_ticks,
            log_x: chart.log_x,
            left: 58,
            right: 16,
            below: legend.height(),
        };
        let mut plot = canvas::axes(sheet, axes)?;
        for (series, look) in chart.series.iter().zip(of_series) {
            intervals(&mut plot, sheet, (*look, chart.markers), series)?;
        }
        for ((_, value), look) in chart.levels.iter().zip(of_levels).filter(|((_, value), _)| drawable(*value)) {
            stroke(&mut plot, *look, &[(x.start, *value), (x.end, *value)])?;
        }
        // Curves are drawn over all bands.
        for (series, look) in chart.series.iter().zip(of_series) {
            curve(&mut plot, sheet, (*look, chart.markers), series)?;
        }
        legend.draw(sheet)
    })
}

/// What the plot shows, in words.
fn description(chart: &Chart) -> String {
    let ends = |s: &Series| match (s.points.first(), s.points.last()) {
        (Some(first), Some(last)) => format!("{} from {} to {}", s.name, value(first[1]), value(last[1])),
        _ => format!("{} without data", s.name),
    };
    let levels = chart.levels.iter().map(|(name, level)| format!("{name} at {}", value(*level)));
    let all: Vec<String> = chart.series.iter().map(ends).chain(levels).collect();
    let end = if chart.note.is_empty() { String::new() } else { format!(" {}", chart.note) };
    format!("{} against {}: {}.{end}", chart.y, chart.x, all.join("; "))
}

/// Half the width of the ends of error bars, in pixels.
const CAP: i32 = 5;

/// The intervals of a series, as areas or error bars.
fn intervals(plot: &mut Plot, sheet: &Sheet, (look, bars): (Look, bool), series: &Series) -> Drawn {
    for piece in drawable_pieces(series) {
        let banded: Vec<([f64; 2], [f64; 2])> = piece.into_iter().filter_map(|(p, band)| Some((p, band?))).collect();
        if bars {
            // The error bars of plotters have a circle at the mean, which would hide the marker.
            for (p, b) in &banded {
                let ends = b.map(|end| plot.backend_coord(&(p[0], end)));
                let caps = ends.map(|(x, y)| [(x - CAP, y), (x + CAP, y)]);
                for stroke in [ends, caps[0], caps[1]] {
                    sheet.draw(&PathElement::new(stroke, look.colour().stroke_width(2)))?;
                }
            }
        } else {
            let upper = banded.iter().map(|(p, b)| (p[0], b[1]));
            let lower = banded.iter().rev().map(|(p, b)| (p[0], b[0]));
            let outline: Vec<(f64, f64)> = upper.chain(lower).collect();
            plot.draw_series([Polygon::new(outline, look.colour().mix(0.18))])?;
        }
    }
    Ok(())
}

fn curve(plot: &mut Plot, sheet: &Sheet, (look, markers): (Look, bool), series: &Series) -> Drawn {
    for piece in drawable_pieces(series) {
        let points: Vec<(f64, f64)> = piece.iter().map(|(p, _)| (p[0], p[1])).collect();
        stroke(plot, look, &points)?;
        if markers || piece.len() == 1 {
            for point in &points {
                canvas::marker(sheet, look, plot.backend_coord(point))?;
            }
        }
    }
    Ok(())
}

fn stroke(plot: &mut Plot, look: Look, points: &[(f64, f64)]) -> Drawn {
    let style = look.colour().stroke_width(2);
    match look.dash {
        Some((stroke, gap)) => {
            plot.draw_series(DashedLineSeries::new(points.iter().copied(), stroke as u32, gap as u32, style))?
        }
        None => plot.draw_series(LineSeries::new(points.iter().copied(), style))?,
    };
    Ok(())
}

/// A point, and its interval (low, high) if that is drawable.
type Banded = ([f64; 2], Option<[f64; 2]>);

/// The pieces of a series between points that are not drawable.
fn drawable_pieces(series: &Series) -> Vec<Vec<Banded>> {
    let band = |k: usize| series.band.as_ref().and_then(|b| b.get(k).copied()).filter(|b| b.iter().all(|&x| drawable(x)));
    let ordered = |b: [f64; 2]| [b[0].min(b[1]), b[0].max(b[1])];
    let points: Vec<Banded> = series.points.iter().enumerate().map(|(k, &p)| (p, band(k).map(ordered))).collect();
    let pieces = points.split(|(p, _)| !p.iter().all(|&x| drawable(x)));
    pieces.filter(|piece| !piece.is_empty()).map(<[_]>::to_vec).collect()
}

/// The points with drawable coordinates.
fn drawable_points(points: &[[f64; 2]]) -> impl Iterator<Item = [f64; 2]> {
    points.iter().copied().filter(|p| p.iter().all(|&x| drawable(x)))
}

/// `extent` with a margin at both ends.
fn with_margin(extent: &Range<f64>) -> Range<f64> {
    let margin = 0.04 * (extent.end - extent.start);
    extent.start - margin..extent.end + margin
}
