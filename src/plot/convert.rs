//! Figures as PDF and PNG. Text has a font that is part of the program, so no font of the machine is needed. The same figure gives the same
//! PNG; PDFs of it show the same, but number their objects in any order.

use std::sync::{Arc, LazyLock};

use resvg::tiny_skia::{Pixmap, Transform};
use resvg::usvg::{self, Tree, fontdb};

/// Pixels per inch: a figure is 3.5 inches wide, the column of most papers.
const DPI: f32 = 144.0;
/// Pixels of a PNG per pixel of the figure, which makes 288 per inch.
const SCALE: u32 = 2;

static FONTS: LazyLock<Arc<fontdb::Database>> = LazyLock::new(|| {
    let mut fonts = fontdb::Database::new();
    for font in [include_bytes!("fonts/OpenSans-Regular.ttf").as_slice(), include_bytes!("fonts/OpenSans-Bold.ttf")] {
        fonts.load_font_source(fontdb::Source::Binary(Arc::new(font)));
    }
    fonts.set_sans_serif_family("Open Sans");
    Arc::new(fonts)
});

/// Why a figure has no other form.
#[derive(Debug, thiserror::Error)]
pub enum ConversionError {
    /// It is not SVG.
    #[error("the figure is not SVG")]
    Svg(#[from] usvg::Error),
    /// It has no PDF.
    #[error("the figure has no PDF: {0}")]
    Pdf(svg2pdf::ConversionError),
    /// It has no PNG: it is too large, or it cannot be encoded.
    #[error("the figure has no PNG: {0}")]
    Png(String),
}

fn tree(svg: &str) -> Result<Tree, usvg::Error> {
    Tree::from_str(svg, &usvg::Options { fontdb: Arc::clone(&FONTS), ..usvg::Options::default() })
}

/// The figure as a PDF of one page with the size of the figure. Text stays text.
///
/// # Errors
/// `svg` is no figure of this module.
pub fn pdf(svg: &str) -> Result<Vec<u8>, ConversionError> {
    let page = svg2pdf::PageOptions { dpi: DPI };
    svg2pdf::to_pdf(&tree(svg)?, svg2pdf::ConversionOptions::default(), page).map_err(ConversionError::Pdf)
}

/// The figure as a PNG, twice as wide and high as its SVG.
///
/// # Errors
/// `svg` is no figure of this module.
pub fn png(svg: &str) -> Result<Vec<u8>, ConversionError> {
    let tree = tree(svg)?;
    let size = tree.size().to_int_size();
    let pixmap = Pixmap::new(size.width().saturating_mul(SCALE), size.height().saturating_mul(SCALE));
    let mut pixmap = pixmap.ok_or_else(|| ConversionError::Png("it is too large".into()))?;
    resvg::render(&tree, Transform::from_scale(SCALE as f32, SCALE as f32), &mut pixmap.as_mut());
    pixmap.encode_png().map_err(|error| ConversionError::Png(error.to_string()))
}
