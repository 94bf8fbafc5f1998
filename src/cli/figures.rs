//! The files of figures, in the formats that `--figures` asks for.

use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::{Args, ValueEnum};

use super::files::{check_writable, write_atomic};
use super::output::errln;
use crate::plot;

/// A format of figures.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Format {
    Svg,
    Pdf,
    Png,
}

/// The formats of figures.
#[derive(Args, Clone, Debug)]
pub struct FigureArgs {
    /// Format of figure files; several formats are separated by commas
    #[arg(long, env = "QEDGIX_FIGURES", value_name = "FORMAT", value_enum, value_delimiter = ',', default_value = "svg")]
    figures: Vec<Format>,
}

impl FigureArgs {
    /// The files of a figure, one per format. `svg` is the name of its SVG.
    pub fn files(&self, svg: &Path) -> Vec<PathBuf> {
        self.figures.iter().map(|format| format.file(svg)).collect()
    }

    /// Checks that the files of a figure can be written, without changing them.
    ///
    /// # Errors
    /// As [`check_writable`].
    pub fn check_writable(&self, svg: &Path) -> anyhow::Result<()> {
        self.files(svg).iter().try_for_each(|file| check_writable(file))
    }

    /// Writes the figure `text`, an SVG, to its files.
    ///
    /// # Errors
    /// A file cannot be written, or the figure is not SVG.
    pub fn write(&self, svg: &Path, text: &str) -> anyhow::Result<()> {
        for format in &self.figures {
            let file = format.file(svg);
            let converted = match format {
                Format::Svg => Ok(text.as_bytes().to_vec()),
                Format::Pdf => plot::pdf(text),
                Format::Png => plot::png(text),
            };
            write_atomic(&file, &converted.with_context(|| format!("cannot write {}", file.display()))?)?;
        }
        Ok(())
    }

    /// The value of the flag, if it is not the default.
    pub fn value(&self) -> Option<String> {
        let names = self.figures.iter().filter_map(|format| Some(format.to_possible_value()?.get_name().to_owned()));
        let value = names.collect::<Vec<_>>().join(",");
        (value != "svg").then_some(value)
    }

    /// Warns on standard error of formats that were asked for while nothing asks for figures. It is no error, because the variable may be
    /// set for all commands.
    pub fn warn_if_unused(&self, used: bool, flags: &str) {
        if let Some(value) = self.value().filter(|_| !used) {
            errln!("warning: --figures {value} writes nothing without {flags}");
        }
    }

    /// The file of a figure that a page shows: not a PDF if there is another one.
    pub fn shown(&self, svg: &str) -> String {
        let best = self.figures.iter().find(|format| **format != Format::Pdf).or(self.figures.first());
        best.unwrap_or(&Format::Svg).file(Path::new(svg)).display().to_string()
    }
}

impl Format {
    fn file(self, svg: &Path) -> PathBuf {
        match self {
            Self::Svg => svg.to_owned(),
            Self::Pdf => svg.with_extension("pdf"),
            Self::Png => svg.with_extension("png"),
        }
    }
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        figures: FigureArgs,
    }

    fn parse(words: &[&str]) -> Result<FigureArgs, clap::Error> {
        Line::try_parse_from(std::iter::once(&"x").chain(words)).map(|line| line.figures)
    }

    #[test]
    fn every_format_has_its_file_and_a_page_shows_what_browsers_show() {
        for (formats, files, shown) in [
            (None, &["a.svg"][..], "a.svg"),
            (Some("pdf"), &["a.pdf"], "a.pdf"),
            (Some("pdf,png"), &["a.pdf", "a.png"], "a.png"),
            (Some("png,svg"), &["a.png", "a.svg"], "a.png"),
        ] {
            let words: Vec<&str> = formats.iter().flat_map(|formats| ["--figures", formats]).collect();
            let figures = parse(&words).unwrap();
            assert_eq!(figures.files(Path::new("a.svg")), files.iter().map(PathBuf::from).collect::<Vec<_>>());
            assert_eq!((figures.shown("a.svg").as_str(), figures.value().as_deref()), (shown, formats));
        }
        let dir = tempfile::tempdir().unwrap();
        let svg = plot::lines(&plot::Chart::default());
        parse(&["--figures", "pdf,svg,png"]).unwrap().write(&dir.path().join("a.svg"), &svg).unwrap();
        for (file, start) in [("a.pdf", &b"%PDF"[..]), ("a.svg", b"<svg"), ("a.png", b"\x89PNG")] {
            assert!(std::fs::read(dir.path().join(file)).unwrap().starts_with(start), "{file}");
        }
        for wrong in ["gif", "", "pdf,", "PDF"] {
            assert!(parse(&["--figures", wrong]).err().unwrap().to_string().contains("--figures"), "{wrong}");
        }
    }
}
