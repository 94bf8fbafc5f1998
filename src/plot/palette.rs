//! One colour, dash and marker per algorithm, the same in every plot and in the dashboard (`clients/web/palette.js`; a test compares
//! the two). The hues are those of Okabe and Ito, which colour-blind readers can tell apart; some are darker, to be seen on white.

use plotters::style::RGBColor;

/// A colour on white and, of the same hue, on a dark page.
pub(super) struct Tone {
    pub(super) light: RGBColor,
    pub(super) dark: &'static str,
}

const fn tone(r: u8, g: u8, b: u8, dark: &'static str) -> Tone {
    Tone { light: RGBColor(r, g, b), dark }
}

pub(super) const TONES: [Tone; 8] = [
    tone(0x00, 0x72, 0xb2, "#4aa8e8"),
    tone(0xd5, 0x5e, 0x00, "#f0803c"),
    tone(0x00, 0x9e, 0x73, "#2cc49a"),
    tone(0xb8, 0x7d, 0x00, "#f0b840"),
    tone(0xb5, 0x52, 0x8c, "#dd94bd"),
    tone(0x2c, 0x93, 0xcf, "#8fd0f5"),
    tone(0x44, 0x44, 0x44, "#e0e0e0"),
    tone(0x8a, 0x8a, 0x8a, "#9a9a9a"),
];

/// The place of each algorithm, then of each baseline. A name that contains another comes before it.
pub(super) const PLACES: [(&str, usize); 14] = [
    ("qedgix", 0),
    ("qmix", 1),
    ("vdn", 2),
    ("iql", 3),
    ("agggnn", 4),
    ("rgcn", 6),
    ("greedy-global", 5),
    ("tour", 7),
    ("sweep-shared", 3),
    ("sweep", 2),
    ("nearest", 4),
    ("max-aoi", 5),
    ("random", 7),
    ("persistent", 6),
];
/// Number of algorithms in [`PLACES`].
const ALGORITHMS: usize = 6;

/// How a series is drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Look {
    /// Index into [`TONES`].
    pub(super) place: usize,
    /// Lengths of a dash and the gap after it; none: a solid line.
    pub(super) dash: Option<(i32, i32)>,
    pub(super) marker: Marker,
}

/// The marker of a series. Algorithms and baselines that share a hue differ in it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Marker {
    Circle,
    Square,
    Triangle,
    Diamond,
    Ring,
    Cross,
    Frame,
}

/// Dashes of series that differ in hue as well, so that no reader needs the hue.
const DASHES: [Option<(i32, i32)>; 4] = [None, Some((9, 4)), Some((2, 4)), Some((15, 4))];
/// Markers of series that no algorithm names.
const MARKERS: [Marker; 4] = [Marker::Circle, Marker::Triangle, Marker::Square, Marker::Diamond];
/// Markers of algorithms. Baselines have others, because they share hues with algorithms.
const ALGORITHM_MARKERS: [Marker; 3] = [Marker::Circle, Marker::Triangle, Marker::Diamond];
/// Baselines are never solid.
const BASELINE_DASHES: [(i32, i32); 4] = [(5, 4), (2, 4), (10, 3), (16, 6)];
const BASELINE_MARKERS: [Marker; 4] = [Marker::Square, Marker::Ring, Marker::Cross, Marker::Frame];

impl Look {
    /// The look of series `i` of those that no algorithm names, and of UAV `i`: in the order of the palette, with dashes and markers whose
    /// pairs differ for the first 16.
    pub(super) fn of_index(i: usize) -> Self {
        let marker = MARKERS[i % MARKERS.len()];
        Self { place: i % TONES.len(), dash: DASHES[(i + i / MARKERS.len()) % DASHES.len()], marker }
    }

    /// Solid first, then dashes.
    fn of_repetition(nth: usize) -> Self {
        match nth % 3 {
            0 => Self { place: 0, dash: None, marker: Marker::Circle },
            1 => Self { place: 0, dash: Some((9, 4)), marker: Marker::Triangle },
            _ => Self { place: 0, dash: Some((2, 4)), marker: Marker::Square },
        }
    }

    pub(super) fn colour(self) -> RGBColor {
        TONES[self.place].light
    }
}

/// The looks of the series of one plot. Series of one algorithm have its colour and differ in dashes and markers; algorithms also differ in
/// markers; baselines are dashed, each in its own way. Where all are of one algorithm, or of none, they differ in all three.
pub(super) fn looks<'a>(names: impl IntoIterator<Item = &'a str>) -> Vec<Look> {
    let found: Vec<Option<usize>> = names.into_iter().map(algorithm).collect();
    let several = found.iter().flatten().any(|one| found.iter().flatten().any(|other| one != other));
    if !several {
        return (0..found.len()).map(Look::of_index).collect();
    }
    let taken: Vec<usize> = found.iter().flatten().map(|&known| PLACES[known].1).collect();
    let mut free = (0..TONES.len()).filter(|place| !taken.contains(place)).cycle();
    let mut seen = [0; PLACES.len()];
    let mut baselines = 0;
    let look = |known: Option<usize>| {
        let Some(known) = known else {
            // With every hue taken, dots tell it from the algorithm of the first.
            return free.next().map_or(Look::of_repetition(2), |place| Look { place, ..Look::of_repetition(0) });
        };
        let nth = seen[known];
        seen[known] += 1;
        let place = PLACES[known].1;
        if known < ALGORITHMS {
            return Look {
                place,
                marker: ALGORITHM_MARKERS[(known + nth) % ALGORITHM_MARKERS.len()],
                ..Look::of_repetition(nth)
            };
        }
        let nth = baselines % BASELINE_DASHES.len();
        baselines += 1;
        Look { place, dash: Some(BASELINE_DASHES[nth]), marker: BASELINE_MARKERS[nth] }
    };
    found.into_iter().map(look).collect()
}

/// The algorithm or baseline that a name contains, as an index into [`PLACES`]: `Algorithm 4 (RGCN)`, `runs/qmix.safetensors`, `sweep`.
fn algorithm(name: &str) -> Option<usize> {
    let name = name.to_lowercase();
    let alone = |from: usize, to: usize| {
        let letter = |c: Option<char>| c.is_some_and(char::is_alphanumeric);
        !letter(name[..from].chars().next_back()) && !letter(name[to..].chars().next())
    };
    PLACES.iter().position(|(known, _)| name.match_indices(known).any(|(at, found)| alone(at, at + found.len())))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_algorithm_has_its_colour_in_every_plot() {
        let place = |names: &[&str]| looks(names.iter().copied()).iter().map(|look| look.place).collect::<Vec<_>>();
        assert_eq!(place(&["sweep", "Qedgix", "Algorithm 4 (RGCN)"]), [2, 0, 6]);
        assert_eq!(place(&["QMIX", "runs/qedgix.safetensors", "sweep-shared"]), [1, 0, 3]);
        let twice = looks(["QMIX", "QMIX, 3 hops", "Qedgix"]);
        assert_eq!(twice[0].place, twice[1].place);
        assert!(twice[0].dash.is_none() && twice[1].dash.is_some() && twice[0].marker != twice[1].marker);
        // A name that says nothing takes a colour that nobody has; series of one algorithm differ in colour.
        assert_eq!(place(&["demo-job:1", "qedgix", "qmix"]), [2, 0, 1]);
        assert_eq!(place(&["qmix lr 1e-3", "qmix lr 1e-4"]), [0, 1]);
        // Baselines, algorithms and unnamed series can be told apart without their hues.
        let styles =
            |names: &[&str]| looks(names.iter().copied()).iter().map(|look| (look.dash, look.marker)).collect::<Vec<_>>();
        for names in [&["Qedgix", "sweep", "nearest", "random"][..], &["a", "b", "c", "d"], &["lr 1", "lr 2", "lr 3", "lr 4"]] {
            let styles = styles(names);
            assert!(
                (0..4).all(|i| styles[..i].iter().all(|other| other.0 != styles[i].0 && other.1 != styles[i].1)),
                "{names:?}"
            );
        }
        assert_ne!(styles(&["Qedgix", "QMIX"])[0].1, styles(&["Qedgix", "QMIX"])[1].1);
        assert_ne!(styles(&["VDN", "sweep"])[0].1, styles(&["VDN", "sweep"])[1].1, "they share a hue");
        let uavs: Vec<Look> = (0..16).map(Look::of_index).collect();
        let alike = |a: &Look, b: &Look| (a.dash, a.marker) == (b.dash, b.marker);
        assert!((0..16).all(|i| uavs[..i].iter().all(|other| !alike(other, &uavs[i]))));
        assert_eq!(algorithm("qmixed"), None);
        let many = looks(std::iter::repeat_n("x", 30));
        assert_eq!((many[8].place, many[0].place), (0, 0));
        assert_ne!(many[8], many[0]);
    }

    #[test]
    fn the_dashboard_has_the_same_palette() {
        let page = include_str!("../../clients/web/palette.js").to_lowercase();
        for (i, tone) in TONES.iter().enumerate() {
            let RGBColor(r, g, b) = tone.light;
            for colour in [format!("#{r:02x}{g:02x}{b:02x}"), tone.dark.to_owned()] {
                assert!(page.contains(&colour), "{i}: {colour}");
            }
        }
        for (name, place) in PLACES {
            let entry = if name.contains('-') { format!("'{name}': {place},") } else { format!("{name}: {place},") };
            assert!(page.contains(&entry), "{entry}");
        }
    }
}
