//! A curve drawn with Braille characters, each of which has 2 x 4 dots.

/// Characters of the drawing.
const WIDTH: usize = 64;
const HEIGHT: usize = 10;
/// The bits of the dots of a character, by column and row.
const DOTS: [[u32; 4]; 2] = [[0x01, 0x02, 0x04, 0x40], [0x08, 0x10, 0x20, 0x80]];

/// The lines of the drawing of `points` (x, y) over x from 0 to `end`; none without points.
pub fn draw(points: &[[f64; 2]], end: f64) -> Vec<String> {
    let points: Vec<[f64; 2]> = points.iter().copied().filter(|point| point.iter().all(|x| x.is_finite())).collect();
    let fold = |from: f64, pick: fn(f64, f64) -> f64| points.iter().map(|point| point[1]).fold(from, pick);
    let (low, high) = (fold(f64::INFINITY, f64::min), fold(f64::NEG_INFINITY, f64::max));
    let Some(last) = points.last() else { return Vec::new() };
    let end = end.max(last[0]).max(1.0);
    let column = |x: f64| (x.max(0.0) / end * (2 * WIDTH - 1) as f64).round() as usize;
    let span = if high > low { high - low } else { 1.0 };
    let row = |y: f64| ((high - y) / span * (4 * HEIGHT - 1) as f64).round() as usize;
    let mut cells = vec![[0_u32; WIDTH]; HEIGHT];
    let mut dot = |x: usize, y: usize| cells[(y / 4).min(HEIGHT - 1)][(x / 2).min(WIDTH - 1)] |= DOTS[x % 2][y % 4];
    dot(column(points[0][0]), row(points[0][1]));
    for pair in points.windows(2) {
        let ([x0, y0], [x1, y1]) = (pair[0], pair[1]);
        let (from, to) = (column(x0), column(x1));
        let dots = (to.abs_diff(from)).max(row(y0).abs_diff(row(y1))).max(1);
        for k in 0..=dots {
            let share = k as f64 / dots as f64;
            dot(column(x0 + (x1 - x0) * share), row(y0 + (y1 - y0) * share));
        }
    }
    let label = |i: usize| match i {
        0 => format!("{high:8.2}"),
        _ if i == HEIGHT - 1 => format!("{low:8.2}"),
        _ => " ".repeat(8),
    };
    let line = |(i, cells): (usize, &[u32; WIDTH])| {
        let drawn: String = cells.iter().map(|&dots| char::from_u32(0x2800 + dots).unwrap_or(' ')).collect();
        format!("{} \u{2502}{drawn}", label(i))
    };
    let mut lines: Vec<String> = cells.iter().enumerate().map(line).collect();
    lines.push(format!("{:8} \u{2514}{}", "", "\u{2500}".repeat(WIDTH)));
    lines.push(format!("{:10}0{:>width$.0}", "", end, width = WIDTH - 1));
    lines
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_curve_spans_the_drawing() {
        assert!(draw(&[], 10.0).is_empty());
        let lines = draw(&[[0.0, 9.0], [100.0, 1.0]], 100.0);
        assert_eq!(lines.len(), HEIGHT + 2);
        assert!(lines[0].starts_with("    9.00") && lines[HEIGHT - 1].starts_with("    1.00"), "{lines:#?}");
        assert!(lines[..HEIGHT].iter().all(|line| line.chars().count() == 10 + WIDTH));
        let drawn = |line: &str| line.chars().skip(10).map(|c| c != '\u{2800}').collect::<Vec<_>>();
        assert!(drawn(&lines[0])[0] && drawn(&lines[HEIGHT - 1])[WIDTH - 1], "{lines:#?}");
        assert!(lines[HEIGHT + 1].ends_with("100"));
    }

    #[test]
    fn numbers_of_every_kind_are_drawn() {
        for y in [0.0, f64::NAN, f64::INFINITY, 1e300, -1e300, f64::MIN_POSITIVE] {
            for x in [0.0, -5.0, f64::NAN, 1e300] {
                draw(&[[0.0, 1.0], [x, y], [x, 2.0]], 10.0);
                draw(&[[x, y]], 0.0);
            }
        }
    }
}
