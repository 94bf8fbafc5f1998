//! The paths of a fleet from above: users with their collection circles, and each UAV's path with arrows.

use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, VPos};

use super::canvas::{self, Axes, BOTTOM, Drawn, INK, Key, Legend, Plot, QUIET, TEXT, WIDTH, Words, text};
use super::data::{Pull, Trajectories};
use super::palette::Look;
use super::scale::{drawable, extent};
use crate::env::Point;

/// Width of the y axis in pixels.
const AXIS: u32 = 58;
/// Side of the plot in pixels; one scale for x and y.
const PLOT: u32 = WIDTH - 10 - AXIS - 16;
/// Width and height in pixels, without the legend.
const SIZE: (u32, u32) = (WIDTH, canvas::TOP + PLOT + BOTTOM + 6);
/// Slots between two arrows.
const ARROW_INTERVAL: usize = 4;
/// Users are numbered if there are at most this many.
const MAX_NUMBERED: usize = 60;
const USER: RGBColor = QUIET;
const START: RGBColor = INK;
const FOR: RGBColor = RGBColor(0x1b, 0x7f, 0x5c);
const AGAINST: RGBColor = RGBColor(0xb2, 0x3a, 0x48);

/// Users, circles and paths as SVG, over the unit square and the area around it that UAVs reached.
pub fn trajectories(title: &str, shown: &Trajectories) -> String {
    explained(title, shown, &[])
}

/// As [`trajectories`], with what speaks for and against the headings: the stronger, the wider the line.
pub fn explained(title: &str, shown: &Trajectories, pulls: &[Pull]) -> String {
    let users: Vec<(usize, Point)> = shown.users.iter().copied().enumerate().filter(|(_, p)| visible(p)).collect();
    let paths: Vec<Vec<Point>> = shown.uavs.iter().map(|path| path.iter().copied().filter(visible).collect()).collect();
    if users.is_empty() && paths.iter().all(Vec::is_empty) {
        return canvas::no_data(SIZE, title);
    }
    let all = users.iter().map(|(_, p)| p).chain(paths.iter().flatten()).flatten().copied();
    let range = extent(all.chain([0.0, 1.0])).unwrap_or(0.0..1.0);
    // A margin, as circles reach over the border.
    let margin = 0.04 * (range.end - range.start);
    let range = range.start - margin..range.end + margin;
    let scale = f64::from(PLOT) / (range.end - range.start);
    let circle = if shown.transmission_range > 0.0 { (shown.transmission_range * scale).min(4e3) as i32 } else { 0 };
    let legend = Legend::new(entries(paths.len(), !pulls.is_empty(), &shown.note));
    let words = Words {
        title,
        description: format!("The paths of {} UAVs over {} users, from above. {}", paths.len(), users.len(), shown.note),
    };
    canvas::draw((SIZE.0, SIZE.1 + legend.height()), &words, |sheet| {
        canvas::heading(sheet, title)?;
        let names = ["x (sides of the square)", "y (sides of the square)"];
        let ranges = [range.clone(), range.clone()];
        let axes = Axes { ranges, names, x_ticks: None, log_x: false, left: AXIS, right: 16, below: legend.height() };
        let mut plot = canvas::axes(sheet, axes)?;
        plot.plotting_area().draw(&Rectangle::new([(0.0, 0.0), (1.0, 1.0)], INK.mix(0.6)))?;
        for (_, [x, y]) in &users {
            plot.plotting_area().draw(&Circle::new((*x, *y), circle, USER.mix(0.07).filled()))?;
            plot.plotting_area().draw(&Circle::new((*x, *y), circle, USER.mix(0.45)))?;
        }
        for Pull { from, to, strength } in pulls.iter().filter(|pull| visible(&pull.from) && visible(&pull.to)) {
            let style = if *strength < 0.0 { AGAINST } else { FOR };
            let width = (strength.abs() * 6.0).clamp(1.0, 6.0) as u32;
            let line = PathElement::new([(from[0], from[1]), (to[0], to[1])], style.mix(0.45).stroke_width(width));
            plot.plotting_area().draw(&line)?;
        }
        for (i, path) in paths.iter().enumerate() {
            let line = colour(i).mix(0.75).stroke_width(2);
            let points = path.iter().map(|p| (p[0], p[1]));
            match Look::of_index(i).dash {
                Some((stroke, gap)) => plot.draw_series(DashedLineSeries::new(points, stroke as u32, gap as u32, line))?,
                None => plot.draw_series(LineSeries::new(points, line))?,
            };
            arrows(&mut plot, i, path, 6.0 / scale)?;
        }
        for (number, [x, y]) in &users {
            plot.plotting_area().draw(&Circle::new((*x, *y), 5, USER.filled()))?;
            if users.len() <= MAX_NUMBERED {
                let label = EmptyElement::at((*x, *y))
                    + Text::new(number.to_string(), (8, -10), text(TEXT, INK, HPos::Left, VPos::Center));
                plot.plotting_area().draw(&label)?;
            }
        }
        for (i, path) in paths.iter().enumerate() {
            let (Some(first), Some(last)) = (path.first(), path.last()) else { continue };
            plot.plotting_area().draw(&Circle::new((first[0], first[1]), 7, START.stroke_width(2)))?;
            let end = plot.backend_coord(&(last[0], last[1]));
            sheet.draw(&Circle::new(end, 8, WHITE.filled()))?;
            canvas::marker(sheet, Look::of_index(i), end)?;
        }
        legend.draw(sheet)
    })
}

/// Every few slots, an arrow in the middle of the move; `size` is in units of the axes.
fn arrows(plot: &mut Plot, i: usize, path: &[Point], size: f64) -> Drawn {
    // Paths of several UAVs often overlap, so their arrows are at different slots.
    for step in path.windows(2).skip((1 + i) % ARROW_INTERVAL).step_by(ARROW_INTERVAL) {
        let [from, to] = [step[0], step[1]];
        let (dx, dy) = (to[0] - from[0], to[1] - from[1]);
        let length = dx.hypot(dy);
        if length < 0.2 * size {
            continue;
        }
        let (dx, dy) = (dx / length * size, dy / length * size);
        let (x, y) = (f64::midpoint(from[0], to[0]), f64::midpoint(from[1], to[1]));
        let corners = vec![(x + dx, y + dy), (x - dx - 0.8 * dy, y - dy + 0.8 * dx), (x - dx + 0.8 * dy, y - dy - 0.8 * dx)];
        plot.draw_series([Polygon::new(corners, colour(i).filled())])?;
    }
    Ok(())
}

fn entries(uavs: usize, explained: bool, note: &str) -> Vec<(Key, String)> {
    let mut entries = vec![
        (Key::Ring(START, 7), "start".to_owned()),
        (Key::Dot(USER, 5), "user".to_owned()),
        (Key::Ring(USER, 9), "collected within".to_owned()),
    ];
    if explained {
        entries.extend([(Key::Dot(FOR, 5), "for the heading".to_owned()), (Key::Dot(AGAINST, 5), "against it".to_owned())]);
    }
    entries.extend((0..uavs).map(|i| (Key::Line(Look::of_index(i), true), format!("UAV {i}"))));
    entries.push((Key::Note, "Arrows point along the flight, every fourth slot; a path ends at its marker.".to_owned()));
    entries.push((Key::Note, note.to_owned()));
    entries
}

/// The colour of UAV `i`.
fn colour(i: usize) -> RGBColor {
    Look::of_index(i).colour()
}

fn visible(p: &Point) -> bool {
    p.iter().all(|&x| drawable(x))
}
