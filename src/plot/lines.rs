//! Curves, and distributions of a metric over layouts.

use std::ops::Range;

use plotters::prelude::*;

use super::canvas::{self, Drawn, Key, Plot, SIDE, SIZE, colour, dashed};
use super::data::{Chart, Series};
use super::scale::{drawable, extent, value_axis};

/// Curves with bands, or with markers and error bars, as SVG.
pub fn lines(chart: &Chart) -> String {
    let all = || chart.series.iter().flat_map(|s| drawable_points(&s.points));
    let bands = chart.series.iter().flat_map(drawable_pieces).flatten().filter_map(|(_, band)| band).flatten();
    let (Some(x), Some(y)) = (extent(all().map(|p| p[0])), extent(all().map(|p| p[1]).chain(bands))) else {
        return canvas::no_data(SIZE, &chart.title);
    };
    // Markers do not touch the frame.
    let x = if chart.markers { with_margin(&x) } else { x };
    plot(chart, [x, value_axis(&y)])
}

/// The empirical distribution of each series as SVG: the share of its values that are at most x.
pub fn distribution(title: &str, x: &str, series: &[(String, Vec<f64>)]) -> String {
    let Some(range) = extent(series.iter().flat_map(|(_, values)| values.iter().copied())) else {
        return canvas::no_data(SIZE, title);
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
        markers: false,
    };
    plot(&chart, [axis, 0.0..1.02])
}

fn plot(chart: &Chart, ranges: [Range<f64>; 2]) -> String {
    canvas::draw(SIZE, |sheet| {
        canvas::heading(sheet, &chart.title)?;
        let mut plot = canvas::axes(sheet, ranges, [&chart.x, &chart.y], (54, SIDE))?;
        for (i, series) in chart.series.iter().enumerate() {
            intervals(&mut plot, i, series, chart.markers)?;
        }
        // Curves are drawn over all bands.
        for (i, series) in chart.series.iter().enumerate() {
            curve(&mut plot, i, series, chart.markers)?;
        }
        let entries: Vec<_> =
            chart.series.iter().enumerate().map(|(i, s)| (Key::Line(i, chart.markers), s.name.clone())).collect();
        canvas::legend(sheet, &entries)
    })
}

/// The intervals of series `i`, as areas or error bars.
fn intervals(plot: &mut Plot, i: usize, series: &Series, bars: bool) -> Drawn {
    for piece in drawable_pieces(series) {
        let banded: Vec<([f64; 2], [f64; 2])> = piece.into_iter().filter_map(|(p, band)| Some((p, band?))).collect();
        if bars {
            let style = colour(i).stroke_width(2);
            plot.draw_series(
                banded.iter().map(|(p, b)| ErrorBar::new_vertical(p[0], b[0], p[1].clamp(b[0], b[1]), b[1], style, 8)),
            )?;
        } else {
            let upper = banded.iter().map(|(p, b)| (p[0], b[1]));
            let lower = banded.iter().rev().map(|(p, b)| (p[0], b[0]));
            let outline: Vec<(f64, f64)> = upper.chain(lower).collect();
            plot.draw_series([Polygon::new(outline, colour(i).mix(0.18))])?;
        }
    }
    Ok(())
}

fn curve(plot: &mut Plot, i: usize, series: &Series, markers: bool) -> Drawn {
    let style = colour(i).stroke_width(2);
    for piece in drawable_pieces(series) {
        let points = piece.iter().map(|(p, _)| (p[0], p[1]));
        if markers || piece.len() == 1 {
            plot.draw_series(points.clone().map(|p| Circle::new(p, 4, colour(i).filled())))?;
        }
        if dashed(i) {
            plot.draw_series(DashedLineSeries::new(points, 7, 4, style))?;
        } else {
            plot.draw_series(LineSeries::new(points, style))?;
        }
    }
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
