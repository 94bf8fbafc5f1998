//! Common parts of all plots: background, text, title, legend, axes, and what screen readers and dark pages need.
//!
//! A plot is [`WIDTH`] wide. Printed in a column of 3.5 inches, a pixel is half a point, so text of [`TEXT`] has more than 7 points.

use std::fmt::Write as _;
use std::ops::Range;

use plotters::chart::ChartContext;
use plotters::coord::Shift;
use plotters::coord::ranged1d::{DefaultFormatting, KeyPointHint};
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use super::palette::{Look, Marker, TONES};
use super::scale::{tick, ticks, unlog};

/// The drawing area, in pixels.
pub(super) type Sheet<'a> = DrawingArea<SVGBackend<'a>, Shift>;
/// The result of drawing.
pub(super) type Drawn = Result<(), DrawingAreaErrorKind<std::io::Error>>;
/// A plot with two linear axes.
pub(super) type Plot<'a, 'b> = ChartContext<'a, SVGBackend<'b>, Cartesian2d<Axis, Axis>>;

/// Width of a plot in pixels.
pub(super) const WIDTH: u32 = 504;
/// Height of a chart in pixels, without its legend.
pub(super) const HEIGHT: u32 = 350;
/// Height of the title above a plot, in pixels.
pub(super) const TOP: u32 = 38;
/// Size of text in pixels; at least 14 is 7 points.
pub(super) const TEXT: i32 = 15;
/// Height of the x axis with its label, in pixels.
pub(super) const BOTTOM: u32 = 50;
/// Height of a row of the legend, in pixels.
const ROW: u32 = 22;
/// Rows of the legend.
const MAX_ROWS: usize = 6;

/// Colour of text and axes.
pub(super) const INK: RGBColor = RGBColor(0x22, 0x22, 0x22);
const FAINT: RGBColor = RGBColor(0xe4, 0xe4, 0xe4);
const AXIS: RGBColor = RGBColor(0x77, 0x77, 0x77);
/// Colour of users and of what belongs to nobody.
pub(super) const QUIET: RGBColor = RGBColor(0x55, 0x55, 0x55);

/// What a reader of a screen is told: a title and a description.
pub(super) struct Words<'a> {
    pub(super) title: &'a str,
    pub(super) description: String,
}

/// Draws an SVG of `size` pixels with a white background, which is dark on dark pages.
pub(super) fn draw(size: (u32, u32), words: &Words, body: impl FnOnce(&Sheet) -> Drawn) -> String {
    let mut svg = String::new();
    let sheet = SVGBackend::with_string(&mut svg, size).into_drawing_area();
    let drawn = sheet.fill(&WHITE).and_then(|()| body(&sheet)).and_then(|()| sheet.present());
    drawn.expect("drawing into a string cannot fail");
    drop(sheet);
    let head = format!(
        " role=\"img\"><title>{}</title><desc>{}</desc><style>{}</style>",
        escaped(words.title),
        escaped(&words.description),
        dark_style()
    );
    svg.replacen('>', &head, 1)
}

/// The rules by which a plot is dark on a dark page. Programs that know no such rules, as those that print, draw it light.
fn dark_style() -> String {
    let mut rules = String::from("@media (prefers-color-scheme:dark){");
    let greys =
        [(WHITE, "#15181c"), (INK, "#e6e6e6"), (FAINT, "#31363d"), (AXIS, "#9aa0a8"), (QUIET, "#b0b6be"), (BLACK, "#e6e6e6")];
    let tones = TONES.iter().map(|tone| (tone.light, tone.dark));
    for (RGBColor(r, g, b), dark) in greys.into_iter().chain(tones) {
        for property in ["fill", "stroke"] {
            let _ = write!(rules, "svg [{property}=\"#{r:02X}{g:02X}{b:02X}\"]{{{property}:{dark}}}");
        }
    }
    rules + "}"
}

/// A character that XML may contain and that has no effect on its surroundings: a space in place of others.
fn printable(c: char) -> char {
    if c.is_control() || matches!(c, '\u{fffe}' | '\u{ffff}') { ' ' } else { c }
}

/// Text for an element of XML.
fn escaped(text: &str) -> String {
    let clean: String = text.chars().map(printable).collect();
    clean.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

/// An SVG of `size` pixels with a title and the words "no data".
pub(super) fn no_data(size: (u32, u32), title: &str) -> String {
    draw(size, &Words { title, description: "No data.".to_owned() }, |sheet| {
        heading(sheet, title)?;
        let style = text(TEXT, AXIS, HPos::Center, VPos::Center);
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
    let style = ("sans-serif", 16, FontStyle::Bold).into_font().color(&INK).pos(Pos::new(HPos::Left, VPos::Center));
    sheet.draw(&Text::new(fitting(title, WIDTH as i32 - 30, 16), (14, 19), style))
}

/// A linear axis with chosen ticks.
pub(super) struct Axis {
    range: Range<f64>,
    ticks: Vec<f64>,
}

impl Ranged for Axis {
    type FormatOption = DefaultFormatting;
    type ValueType = f64;

    fn map(&self, value: &f64, (low, high): (i32, i32)) -> i32 {
        let share = (value - self.range.start) / (self.range.end - self.range.start);
        (f64::from(low) + share * f64::from(high - low)).round() as i32
    }

    fn key_points<Hint: KeyPointHint>(&self, _: Hint) -> Vec<f64> {
        self.ticks.clone()
    }

    fn range(&self) -> Range<f64> {
        self.range.clone()
    }
}

/// The axes of a plot.
pub(super) struct Axes<'a> {
    pub(super) ranges: [Range<f64>; 2],
    pub(super) names: [&'a str; 2],
    /// Ticks of the x axis; none: round numbers.
    pub(super) x_ticks: Option<Vec<f64>>,
    /// Whether x values are decimal logarithms of what their labels say.
    pub(super) log_x: bool,
    /// Pixels left and right of the plot, and below it for the legend.
    pub(super) left: u32,
    pub(super) right: u32,
    pub(super) below: u32,
}

/// Axes with a light grid. Without a name, there is no y axis.
pub(super) fn axes<'b>(sheet: &Sheet<'b>, axes: Axes) -> Result<Plot<'b, 'b>, DrawingAreaErrorKind<std::io::Error>> {
    let [x, y] = axes.ranges;
    let x_ticks = axes.x_ticks.unwrap_or_else(|| ticks(&x, 6));
    let y_ticks = ticks(&y, 7);
    let mut plot = ChartBuilder::on(sheet)
        .margin_top(TOP)
        .margin_left(10)
        .margin_right(axes.right)
        .margin_bottom(6 + axes.below)
        .x_label_area_size(BOTTOM)
        .y_label_area_size(axes.left)
        .build_cartesian_2d(Axis { range: x, ticks: x_ticks }, Axis { range: y, ticks: y_ticks })?;
    let [x_name, y_name] = axes.names;
    let (width, height) = plot.plotting_area().dim_in_pixel();
    let log = axes.log_x;
    let x_label = move |&x: &f64| tick(if log { unlog(x) } else { x });
    let mut mesh = plot.configure_mesh();
    mesh.light_line_style(TRANSPARENT)
        .bold_line_style(FAINT)
        .axis_style(AXIS)
        .x_label_formatter(&x_label)
        .y_label_formatter(&|&x| tick(x))
        .label_style(("sans-serif", TEXT).into_font().color(&INK))
        .axis_desc_style(("sans-serif", TEXT).into_font().color(&INK))
        .x_desc(fitting(x_name, width as i32, TEXT));
    if y_name.is_empty() {
        mesh.disable_y_mesh().disable_y_axis();
    } else {
        mesh.y_desc(fitting(y_name, height as i32 + 30, TEXT));
    }
    mesh.draw()?;
    Ok(plot)
}

/// The symbol of an entry of the legend.
#[derive(Clone, Copy)]
pub(super) enum Key {
    /// A line, with or without its marker.
    Line(Look, bool),
    /// A filled circle of this radius.
    Dot(RGBColor, i32),
    /// A circle of this radius.
    Ring(RGBColor, i32),
    /// No symbol: a sentence.
    Note,
}

/// A legend below a plot: entries in rows that fit the width. Entries beyond its last row are counted.
pub(super) struct Legend {
    entries: Vec<(Key, String)>,
    /// Row and left end of each entry.
    places: Vec<(u32, i32)>,
}

const SYMBOL: i32 = 34;

impl Legend {
    pub(super) fn new(all: Vec<(Key, String)>) -> Self {
        let (notes, all): (Vec<_>, Vec<_>) = all.into_iter().partition(|(key, _)| matches!(key, Key::Note));
        let fits =
            (0..=all.len()).rev().find(|&shown| Self::layout(&Self::with_rest(&all, shown)).1 < MAX_ROWS as u32).unwrap_or(0);
        let mut entries = Self::with_rest(&all, fits);
        let (mut places, last) = Self::layout(&entries);
        // A sentence has rows of its own.
        let mut row = if entries.is_empty() { 0 } else { last + 1 };
        for (_, note) in notes {
            for line in wrapped(&note, WIDTH as i32 - 24) {
                entries.push((Key::Note, line));
                places.push((row, 12));
                row += 1;
            }
        }
        Self { entries, places }
    }

    /// The first `shown` entries, and how many more there are.
    fn with_rest(all: &[(Key, String)], shown: usize) -> Vec<(Key, String)> {
        let names: Vec<&str> = all.iter().map(|(_, name)| name.as_str()).collect();
        let names = all_fitting(&names, WIDTH as i32 - 20 - SYMBOL, TEXT);
        let mut entries: Vec<_> = all.iter().zip(names).take(shown).map(|((key, _), name)| (*key, name)).collect();
        if shown < all.len() {
            entries.push((Key::Note, format!("and {} more", all.len() - shown)));
        }
        entries
    }

    /// Places of entries, and the last row.
    fn layout(entries: &[(Key, String)]) -> (Vec<(u32, i32)>, u32) {
        let (mut row, mut left) = (0, 12);
        let mut places = Vec::with_capacity(entries.len());
        for (key, name) in entries {
            let width = text_width(name, TEXT) + if matches!(key, Key::Note) { 0 } else { SYMBOL };
            if left > 12 && left + width > WIDTH as i32 - 8 {
                (row, left) = (row + 1, 12);
            }
            places.push((row, left));
            left += width + 18;
        }
        (places, row)
    }

    /// Pixels that the legend needs.
    pub(super) fn height(&self) -> u32 {
        self.places.last().map_or(0, |(row, _)| (row + 1) * ROW + 4)
    }

    /// Draws it at the bottom of `sheet`.
    pub(super) fn draw(&self, sheet: &Sheet) -> Drawn {
        let top = (sheet.dim_in_pixel().1 - self.height()) as i32;
        let style = text(TEXT, INK, HPos::Left, VPos::Center);
        for ((key, name), (row, left)) in self.entries.iter().zip(&self.places) {
            let y = top + (row * ROW + ROW / 2) as i32;
            let middle = (left + 13, y);
            match *key {
                Key::Line(look, marked) => {
                    for (from, to) in dashes(26, look.dash) {
                        sheet.draw(&PathElement::new([(left + from, y), (left + to, y)], look.colour().stroke_width(3)))?;
                    }
                    if marked {
                        marker(sheet, look, middle)?;
                    }
                }
                Key::Dot(colour, radius) => sheet.draw(&Circle::new(middle, radius, colour.filled()))?,
                Key::Ring(colour, radius) => sheet.draw(&Circle::new(middle, radius, colour.stroke_width(2)))?,
                Key::Note => {}
            }
            let x = left + if matches!(key, Key::Note) { 0 } else { SYMBOL };
            sheet.draw(&Text::new(name.clone(), (x, y), style.clone()))?;
        }
        Ok(())
    }
}

/// The strokes of a line of `length` pixels.
fn dashes(length: i32, dash: Option<(i32, i32)>) -> Vec<(i32, i32)> {
    let Some((stroke, gap)) = dash else { return vec![(0, length)] };
    (0..length).step_by((stroke + gap) as usize).map(|from| (from, (from + stroke).min(length))).collect()
}

/// The marker of a series at a place in pixels.
pub(super) fn marker(sheet: &Sheet, look: Look, (x, y): (i32, i32)) -> Drawn {
    let style = look.colour().filled();
    let line = look.colour().stroke_width(2);
    // The inner side of an open marker hides the line through it.
    match look.marker {
        Marker::Circle => sheet.draw(&Circle::new((x, y), 5, style)),
        Marker::Square => sheet.draw(&Rectangle::new([(x - 4, y - 4), (x + 4, y + 4)], style)),
        Marker::Triangle => sheet.draw(&Polygon::new(vec![(x, y - 6), (x + 6, y + 5), (x - 6, y + 5)], style)),
        Marker::Diamond => sheet.draw(&Polygon::new(vec![(x, y - 6), (x + 6, y), (x, y + 6), (x - 6, y)], style)),
        Marker::Ring => {
            sheet.draw(&Circle::new((x, y), 5, WHITE.filled()))?;
            sheet.draw(&Circle::new((x, y), 5, line))
        }
        Marker::Cross => {
            sheet.draw(&PathElement::new([(x - 5, y - 5), (x + 5, y + 5)], line))?;
            sheet.draw(&PathElement::new([(x - 5, y + 5), (x + 5, y - 5)], line))
        }
        Marker::Frame => {
            sheet.draw(&Rectangle::new([(x - 5, y - 5), (x + 5, y + 5)], WHITE.filled()))?;
            sheet.draw(&Rectangle::new([(x - 5, y - 5), (x + 5, y + 5)], line))
        }
    }
}

/// About the width of a text in pixels: fonts differ, so it is rather too large.
pub(super) fn text_width(text: &str, size: i32) -> i32 {
    let width = |c: char| match c {
        'i' | 'j' | 'l' | 't' | 'f' | ' ' | '.' | ',' | ':' | ';' | '|' | '\'' => 0.34,
        'm' | 'w' | 'M' | 'W' | '%' | '@' => 0.95,
        c if c.is_uppercase() || !c.is_ascii() => 0.74,
        _ => 0.6,
    };
    (text.chars().map(width).sum::<f64>() * f64::from(size)).ceil() as i32
}

/// `text` shortened so that it fits into `width` pixels. The middle is left out, because file names differ at either end.
pub(super) fn fitting(text: &str, width: i32, size: i32) -> String {
    let all: Vec<char> = text.chars().take(1000).map(printable).collect();
    let cut = |kept: usize| -> String {
        if kept >= all.len() {
            return all.iter().collect();
        }
        let head = kept.div_ceil(2);
        all[..head].iter().chain(&['…']).chain(&all[all.len() - (kept - head)..]).collect()
    };
    // The longest that fits.
    let fits = (0..=all.len()).collect::<Vec<_>>().partition_point(|&kept| text_width(&cut(kept), size) <= width);
    cut(fits.saturating_sub(1))
}

/// All of `texts` shortened so that each fits into `width` pixels, and different ones stay different: where shortened ones would be the
/// same, what the texts have in common at their beginning is left out, and if that is not enough, they are numbered.
pub(super) fn all_fitting(texts: &[&str], width: i32, size: i32) -> Vec<String> {
    let mut short: Vec<String> = texts.iter().map(|text| fitting(text, width, size)).collect();
    for i in 0..texts.len() {
        let alike: Vec<usize> = (0..texts.len()).filter(|&j| short[j] == short[i]).collect();
        if alike.iter().all(|&j| texts[j] == texts[i]) {
            continue;
        }
        let common = alike.iter().map(|&j| common_prefix(texts[i], texts[j])).min().unwrap_or(0);
        for &j in &alike {
            let rest: String = texts[j].chars().skip(common.saturating_sub(CONTEXT)).collect();
            short[j] = fitting(&format!("…{rest}"), width, size);
        }
    }
    for i in 1..texts.len() {
        let is_taken = |name: &str| (0..i).any(|j| short[j] == name && texts[j] != texts[i]);
        let numbered = |number: usize| {
            let end = format!(" ({number})");
            fitting(&short[i], width - text_width(&end, size), size) + &end
        };
        if is_taken(&short[i]) {
            let free = (2..=texts.len() + 1).map(numbered).find(|name| !is_taken(name));
            short[i] = free.expect("there are more numbers than texts");
        }
    }
    short
}

/// Letters before the first difference that a shortened text keeps.
const CONTEXT: usize = 12;

/// Number of letters with which both begin.
fn common_prefix(one: &str, other: &str) -> usize {
    one.chars().zip(other.chars()).take_while(|(a, b)| a == b).count()
}

/// `text` in lines that fit into `width` pixels, broken at spaces.
fn wrapped(text: &str, width: i32) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in text.split_whitespace() {
        match lines.last_mut() {
            Some(line) if text_width(&format!("{line} {word}"), TEXT) <= width => {
                line.push(' ');
                line.push_str(word);
            }
            _ => lines.push(fitting(word, width, TEXT)),
        }
    }
    lines
}
