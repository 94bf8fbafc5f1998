//! Common parts of all plots: background, colours, text, title, legend, axes.

use std::ops::Range;

use plotters::chart::ChartContext;
use plotters::coord::Shift;
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use super::scale::tick;

/// The drawing area, in pixels.
pub(super) type Sheet<'a> = DrawingArea<SVGBackend<'a>, Shift>;
/// The result of drawing.
pub(super) type Drawn = Result<(), DrawingAreaErrorKind<std::io::Error>>;
/// A plot with two linear axes.
pub(super) type Plot<'a, 'b> = ChartContext<'a, SVGBackend<'b>, Cartesian2d<RangedCoordf64, RangedCoordf64>>;

/// Size of a chart in pixels.
pub(super) const SIZE: (u32, u32) = (720, 440);
/// Height of the title above a plot, in pixels.
pub(super) const TOP: u32 = 44;
/// Width of the legend beside a plot, in pixels.
pub(super) const SIDE: u32 = 168;

/// Colour of text and axes.
pub(super) const INK: RGBColor = RGBColor(0x22, 0x22, 0x22);
const FAINT: RGBColor = RGBColor(0xe4, 0xe4, 0xe4);
const AXIS: RGBColor = RGBColor(0x88, 0x88, 0x88);

/// The colours of Okabe and Ito, for colour-blind readers. Yellow, hard to see on white, is replaced by grey.
const PALETTE: [RGBColor; 8] = [
    RGBColor(0x00, 0x72, 0xb2),
    RGBColor(0xd5, 0x5e, 0x00),
    RGBColor(0x00, 0x9e, 0x73),
    RGBColor(0xe6, 0x9f, 0x00),
    RGBColor(0xcc, 0x79, 0xa7),
    RGBColor(0x56, 0xb4, 0xe9),
    RGBColor(0x00, 0x00, 0x00),
    RGBColor(0x99, 0x99, 0x99),
];

/// Colour of series `i`.
pub(super) fn colour(i: usize) -> RGBColor {
    PALETTE[i % PALETTE.len()]
}

/// Whether series `i` is dashed, because an earlier series has the same colour.
pub(super) fn dashed(i: usize) -> bool {
    i / PALETTE.len() % 2 == 1
}

/// Draws an SVG of `size` pixels with a white background.
pub(super) fn draw(size: (u32, u32), body: impl FnOnce(&Sheet) -> Drawn) -> String {
    let mut svg = String::new();
    let sheet = SVGBackend::with_string(&mut svg, size).into_drawing_area();
    let drawn = sheet.fill(&WHITE).and_then(|()| body(&sheet)).and_then(|()| sheet.present());
    drawn.expect("drawing into a string cannot fail");
    drop(sheet);
    svg
}

/// An SVG of `size` pixels with a title and the words "no data".
pub(super) fn no_data(size: (u32, u32), title: &str) -> String {
    draw(size, |sheet| {
        heading(sheet, title)?;
        let style = text(17, AXIS, HPos::Center, VPos::Center);
        let middle = (size.0 as i32 / 2, size.1 as i32 / 2);
        sheet.draw(&Text::new("no data", middle, style))
    })
}

/// A text style.
pub(super) fn text(size: i32, colour: RGBColor, horizontal: HPos, vertical: VPos) -> TextStyle<'static> {
    ("sans-serif", size).into_font().color(&colour).pos(Pos::new(horizontal, vertical))
}

/// The title of a plot.
pub(super) fn heading(sheet: &Sheet, title: &str) -> Drawn {
    let style = ("sans-serif", 19, FontStyle::Bold).into_font().color(&INK).pos(Pos::new(HPos::Left, VPos::Center));
    sheet.draw(&Text::new(shorten(title, 80), (16, 22), style))
}

/// Axes with a light grid. `left` and `side` are the pixels to the left and right of the plot.
pub(super) fn axes<'b>(
    sheet: &Sheet<'b>,
    [x, y]: [Range<f64>; 2],
    [x_name, y_name]: [&str; 2],
    (left, side): (u32, u32),
) -> Result<Plot<'b, 'b>, DrawingAreaErrorKind<std::io::Error>> {
    let mut plot = ChartBuilder::on(sheet)
        .margin_top(TOP)
        .margin_left(12)
        .margin_right(side)
        .margin_bottom(8)
        .x_label_area_size(46)
        .y_label_area_size(left)
        .build_cartesian_2d(x, y)?;
    let mut mesh = plot.configure_mesh();
    mesh.light_line_style(TRANSPARENT)
        .bold_line_style(FAINT)
        .axis_style(AXIS)
        .x_labels(9)
        .y_labels(8)
        .x_label_formatter(&|&x| tick(x))
        .y_label_formatter(&|&x| tick(x))
        .label_style(("sans-serif", 15).into_font().color(&INK))
        .axis_desc_style(("sans-serif", 16).into_font().color(&INK))
        .x_desc(shorten(x_name, 70));
    if y_name.is_empty() {
        mesh.disable_y_mesh().disable_y_axis();
    } else {
        mesh.y_desc(shorten(y_name, 45));
    }
    mesh.draw()?;
    Ok(plot)
}

/// The symbol of an entry of the legend.
#[derive(Clone, Copy)]
pub(super) enum Key {
    /// The line of series `i`, with or without a marker.
    Line(usize, bool),
    /// A filled circle of this radius.
    Dot(RGBColor, i32),
    /// A circle of this radius.
    Ring(RGBColor, i32),
}

/// The legend, in the column right of the plot. Entries that do not fit are counted.
pub(super) fn legend(sheet: &Sheet, entries: &[(Key, String)]) -> Drawn {
    const ROW: i32 = 22;
    let (width, height) = sheet.dim_in_pixel();
    let left = (width - SIDE) as i32 + 14;
    let fit = ((height as i32 - TOP as i32 - 60) / ROW).max(1) as usize;
    let shown = if entries.len() > fit { fit - 1 } else { entries.len() };
    let style = text(15, INK, HPos::Left, VPos::Center);
    let place = |row: usize| TOP as i32 + 10 + ROW * row as i32;
    for (row, (key, name)) in entries[..shown].iter().enumerate() {
        let y = place(row);
        let middle = (left + 11, y);
        match *key {
            Key::Line(i, marked) => {
                // A dashed line has one gap, as there is no space for more.
                let ends = if dashed(i) { vec![(0, 9), (13, 22)] } else { vec![(0, 22)] };
                for (from, to) in ends {
                    sheet.draw(&PathElement::new([(left + from, y), (left + to, y)], colour(i).stroke_width(3)))?;
                }
                if marked {
                    sheet.draw(&Circle::new(middle, 4, colour(i).filled()))?;
                }
            }
            Key::Dot(colour, radius) => sheet.draw(&Circle::new(middle, radius, colour.filled()))?,
            Key::Ring(colour, radius) => sheet.draw(&Circle::new(middle, radius, colour.stroke_width(2)))?,
        }
        sheet.draw(&Text::new(shorten(name, 18), (left + 30, y), style.clone()))?;
    }
    if shown < entries.len() {
        let rest = format!("and {} more", entries.len() - shown);
        sheet.draw(&Text::new(rest, (left + 30, place(shown)), style))?;
    }
    Ok(())
}

/// `text` shortened to `max_chars` characters. The middle is left out, because file names differ at either end.
pub(super) fn shorten(text: &str, max_chars: usize) -> String {
    let all: Vec<char> = text.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
    if all.len() <= max_chars {
        return all.into_iter().collect();
    }
    let head = (max_chars - 1) / 2;
    let tail = max_chars - 1 - head;
    all[..head].iter().chain(&['…']).chain(&all[all.len() - tail..]).collect()
}
