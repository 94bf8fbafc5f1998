//! Plots are well-formed SVG for all numbers, and the same data gives the same bytes.

use super::*;

fn chart(points: Vec<[f64; 2]>, band: Option<Vec<[f64; 2]>>, markers: bool) -> Chart {
    let series = Series { name: "a <b> & \"c\"".into(), points, band };
    Chart { title: "t <&>".into(), x: "x".into(), y: "AoI (slots)".into(), series: vec![series], markers, ..Chart::default() }
}

/// Every tag is closed and no text breaks out of its element.
fn assert_well_formed(svg: &str) {
    assert!(svg.starts_with("<svg") && svg.trim_end().ends_with("</svg>"), "{svg}");
    assert_eq!(svg.matches("<text").count(), svg.matches("</text>").count());
    assert!(!svg.contains("<b>") && !svg.contains("NaN") && !svg.contains("inf\""), "{svg}");
    assert!(svg.contains(" role=\"img\"><title>") && svg.contains("</desc>"), "{svg}");
}

#[test]
fn the_same_data_gives_the_same_bytes() {
    let chart = chart(vec![[0.0, 1.0], [1.0, 3.0], [2.0, 2.0]], Some(vec![[0.5, 1.5], [2.0, 4.0], [1.0, 3.0]]), false);
    let svg = lines(&chart);
    assert_well_formed(&svg);
    assert_eq!(svg, lines(&chart));
    assert!(svg.contains("a &lt;b&gt; &amp;") && svg.contains("AoI (slots)") && svg.contains("<polygon"));
}

#[test]
fn plots_without_data_say_no_data() {
    let empty_plots = [
        lines(&Chart::default()),
        lines(&chart(Vec::new(), None, true)),
        lines(&chart(vec![[f64::NAN, 1.0], [1.0, f64::INFINITY]], None, false)),
        bars("t", "y", "n", &[]),
        bars("t", "y", "n", &[Bar { name: "a".into(), mean: f64::NAN, low: f64::NAN, high: f64::NAN }]),
        distribution("t", "x", &[("a".into(), Vec::new())]),
        distribution("t", "x", &[]),
        trajectories("t", &Trajectories::default()),
        trajectories(
            "t",
            &Trajectories { uavs: vec![vec![[f64::NAN; 2]]], users: vec![], transmission_range: f64::NAN, note: String::new() },
        ),
    ];
    for svg in empty_plots {
        assert_well_formed(&svg);
        assert!(svg.contains("no data"), "{svg}");
    }
}

#[test]
fn numbers_of_every_kind_give_well_formed_plots() {
    let strange = [0.0, -0.0, 1.0, -1.0, 1e-300, 1e12, -1e12, 1e300, f64::MAX, f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1e-9];
    for &a in &strange {
        for &b in &strange {
            for markers in [false, true] {
                let points = vec![[a, b], [b, a], [0.5, a], [a, a]];
                let linear = chart(points.clone(), Some(points), markers);
                assert_well_formed(&lines(&linear));
                assert_well_formed(&lines(&Chart { log_x: true, ..linear }));
            }
            assert_well_formed(&bars("t", "y", "n", &[Bar { name: "a".into(), mean: a, low: b, high: a }]));
            assert_well_formed(&distribution("t", "x", &[("a".into(), vec![a, b]), ("b".into(), vec![])]));
            let shown = Trajectories {
                uavs: vec![vec![[a, b], [b, b], [0.0, a]], vec![]],
                users: vec![[a, a]],
                transmission_range: b,
                note: String::new(),
            };
            assert_well_formed(&trajectories("t", &shown));
        }
    }
}

#[test]
fn series_beyond_the_legend_are_counted() {
    let series = |i: usize| Series { name: format!("policy {i}"), points: vec![[0.0, i as f64], [1.0, 1.0]], band: None };
    let chart = Chart { series: (0..40).map(series).collect(), ..chart(Vec::new(), None, false) };
    let svg = lines(&chart);
    assert!(svg.contains("policy 3") && svg.contains("more"), "{svg}");
    let shown = Trajectories {
        uavs: vec![vec![[0.5; 2]; 3]; 100],
        users: vec![[0.1, 0.2]; 100],
        transmission_range: 0.1,
        note: String::new(),
    };
    assert_well_formed(&trajectories("t", &shown));
}

#[test]
fn a_distribution_is_a_curve_of_shares() {
    let svg = distribution("t", "mean AoI (slots)", &[("a".into(), vec![3.0, 1.0, 2.0])]);
    assert!(svg.contains("share of layouts") && svg.contains("<polyline"));
}

#[test]
fn bars_show_their_values() {
    let svg = bars("t", "y", "n", &[Bar { name: "a".into(), mean: 4.937, low: 4.5, high: 5.5 }]);
    assert!(svg.contains("4.94"), "{svg}");
}

/// The sizes of all texts, and the ends of the longest as far as they can be known without a font.
fn texts(svg: &str) -> Vec<(f64, f64, String)> {
    let elements = svg.split("<text ").skip(1).map(|rest| rest.split("</text>").next().unwrap_or_default());
    let attribute = |element: &str, name: &str| {
        let value = element.split(&format!("{name}=\"")).nth(1)?.split('"').next()?;
        value.trim_end_matches("px").parse::<f64>().ok()
    };
    elements
        .map(|e| (attribute(e, "font-size").unwrap(), attribute(e, "x").unwrap(), e.lines().nth(1).unwrap_or("").to_owned()))
        .collect()
}

#[test]
fn text_is_readable_in_a_column_of_a_paper() {
    let many = (0..9).map(|i| Series {
        name: format!("a policy with a long name, number {i}"),
        points: vec![[0.0, f64::from(i)], [1e5, 2.0]],
        band: None,
    });
    let chart = Chart {
        title: "A title that is much longer than a figure is wide, so that it has to be shortened somewhere".into(),
        note: "A note that explains the bands, and that is longer than a line of the figure is wide, so that it is broken."
            .into(),
        series: many.collect(),
        levels: vec![("sweep on eval-v1".into(), 3.0)],
        ..chart(Vec::new(), None, false)
    };
    let bar = Bar { name: "runs/2026-01-01/a-policy-with-a-long-name.safetensors".into(), mean: 4.0, low: 3.0, high: 5.0 };
    let shown = Trajectories {
        uavs: vec![vec![[0.5; 2], [0.6; 2]]; 12],
        users: vec![[0.1, 0.2]; 3],
        transmission_range: 0.1,
        note: "Layout 1.".into(),
    };
    for svg in [lines(&chart), bars("t", "y", "n", &[bar]), trajectories("t", &shown)] {
        assert_well_formed(&svg);
        for (size, x, text) in texts(&svg) {
            // 504 pixels in 3.5 inches, 72 points each, and the usual ratio of plotters between size and pixels.
            assert!(size >= 14.0 / 1.24, "{text}: {size}");
            assert!((0.0..504.0).contains(&x), "{text}");
        }
    }
    assert!(lines(&chart).contains("more"));
}

#[test]
fn ticks_are_at_whole_uavs() {
    let series = Series { name: "Qedgix".into(), points: vec![[2.0, 9.0], [3.0, 6.0], [4.0, 5.0], [6.0, 3.0]], band: None };
    let svg = lines(&Chart { series: vec![series], ..chart(Vec::new(), None, true) });
    let labels: Vec<String> = texts(&svg).into_iter().map(|(_, _, text)| text.trim().to_owned()).collect();
    for whole in ["2", "3", "4", "6"] {
        assert!(labels.iter().any(|label| label == whole), "{labels:?}");
    }
    assert!(!labels.iter().any(|label| label == "2.5" || label == "5.5"), "{labels:?}");
}

#[test]
fn a_logarithmic_axis_keeps_small_values_apart_and_has_their_ticks() {
    let points = vec![[1e-5, 3.0], [3e-4, 2.0], [1e-2, 1.0], [0.1, 2.0]];
    let series = Series { name: "Qedgix".into(), points, band: None };
    let drawn = |log_x| lines(&Chart { series: vec![series.clone()], log_x, ..chart(Vec::new(), None, true) });
    let labels: Vec<String> = texts(&drawn(true)).into_iter().map(|(_, _, text)| text.trim().to_owned()).collect();
    for tick in ["1e-5", "0.0003", "0.01", "0.1"] {
        assert!(labels.iter().any(|label| label == tick), "{tick}: {labels:?}");
    }
    assert!(!texts(&drawn(false)).iter().any(|(_, _, text)| text.trim() == "1e-5"));
    for range in [-5.0..-1.0, -3.2..-3.1, 0.0..0.9, -300.0..12.0] {
        let ticks = super::scale::log_ticks(&range);
        assert!((1..=8).contains(&ticks.len()), "{range:?}: {ticks:?}");
    }
}

#[test]
fn the_marker_of_a_series_is_seen_over_its_error_bar() {
    let series = |name: &str| Series { name: name.into(), points: vec![[1.0, 2.0], [2.0, 3.0]], band: Some(vec![[1.0, 3.0]; 2]) };
    let svg = lines(&Chart { series: vec![series("QMIX"), series("sweep")], ..chart(Vec::new(), None, true) });
    // Triangles and squares: two in the plot and one in the legend; a circle would be the mean of an error bar.
    assert!(!svg.contains("<circle"), "{svg}");
    assert_eq!(svg.matches("<polygon").count(), 3);
}

#[test]
fn names_that_are_cut_stay_different() {
    let long = "algorithm qedgix, reward_scale 0.0125, learning_rate 0.001, gamma 0.95, steps 30000, teacher";
    let names = [format!("{long} -"), format!("{long} sweep"), "short".to_owned(), "short".to_owned()];
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    let cut = super::canvas::all_fitting(&names, 200, 15);
    assert!(cut[0] != cut[1] && cut[1].ends_with("sweep") && cut[2..] == ["short", "short"], "{cut:?}");
    let middle = ["a".repeat(90) + "1" + &"b".repeat(90), "a".repeat(90) + "2" + &"b".repeat(90)];
    let cut = super::canvas::all_fitting(&[&middle[0], &middle[1]], 100, 15);
    assert!(cut[0] != cut[1], "{cut:?}");
    assert!(cut.iter().all(|name| super::canvas::text_width(name, 15) <= 100));
}

#[test]
fn ticks_are_round_and_few() {
    assert_eq!(super::scale::ticks(&(0.0..80.0), 6), [0.0, 20.0, 40.0, 60.0, 80.0]);
    for range in [0.0..1e-300, -1e12..1e12, 3.0..3.000_001, 0.0..1.02] {
        let ticks = super::scale::ticks(&range, 7);
        assert!(ticks.len() <= 8 && !ticks.is_empty() && ticks.iter().all(|tick| tick.is_finite()), "{range:?}: {ticks:?}");
    }
}

#[test]
fn a_figure_has_the_same_text_as_pdf_and_png_without_fonts_of_the_machine() {
    let points = vec![[0.0, 1.0], [1.0, 3.0], [2.0, 2.0]];
    let svg = lines(&chart(points.clone(), Some(points), true));
    let pdf = pdf(&svg).unwrap();
    assert!(pdf.starts_with(b"%PDF-") && pdf.trim_ascii_end().ends_with(b"%%EOF"));
    let text = String::from_utf8_lossy(&pdf);
    // Both weights are embedded, as fonts whose glyphs have letters.
    for part in ["+OpenSans\n", "+OpenSans-Bold\n", "/FontFile", "/ToUnicode", "/MediaBox [0 0 252 "] {
        assert!(text.contains(part), "{part}");
    }
    let png = png(&svg).unwrap();
    assert_eq!(size(&png), [2 * canvas::WIDTH, 2 * height(&svg)]);
    assert_eq!(png, super::png(&svg).unwrap());
    // Text is drawn: without it, the picture is another one.
    let without: String = svg.split("<text").map(|part| part.split_once("</text>").map_or(part, |(_, rest)| rest)).collect();
    assert_ne!(png, super::png(&without).unwrap());
}

/// Width and height of a PNG.
fn size(png: &[u8]) -> [u32; 2] {
    assert!(png.starts_with(b"\x89PNG\r\n\x1a\n"));
    [16, 20].map(|at| u32::from_be_bytes(png[at..at + 4].try_into().unwrap()))
}

fn height(svg: &str) -> u32 {
    let (_, rest) = svg.split_once("height=\"").unwrap();
    rest.split_once('"').unwrap().0.parse().unwrap()
}

#[test]
fn names_of_any_letters_are_converted_and_what_is_no_figure_is_refused() {
    for name in ["Größe, Ελλάδα, Москва", "漢字 \u{1f681} \u{202e}", "\u{fffe}\u{ffff}\u{7f}", "&#0;<>&\"'", ""] {
        let svg = distribution(name, name, &[(name.into(), vec![1.0, 2.0])]);
        assert!(pdf(&svg).unwrap().starts_with(b"%PDF-"), "{name:?}");
        size(&png(&svg).unwrap());
    }
    for wrong in ["", "no", "<svg>", "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"1e9\" height=\"1e9\"/>"] {
        assert!(png(wrong).is_err(), "{wrong}");
    }
    assert!(pdf("no").is_err());
}
