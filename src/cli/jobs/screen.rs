//! A followed job on the terminal: redrawn in place on a terminal, one line per change elsewhere.

use std::fmt::Write as _;
use std::io::IsTerminal;
use std::time::Duration;

use indicatif::{HumanCount, ProgressBar, ProgressStyle};

use super::chart;
use super::follow::JobEvent;
use super::view::{JobView, News};
use crate::cli::output::{OutputError, errln, outln};
use crate::cli::table::sparkline;

/// Time between two drawings of a terminal.
const REDRAW: Duration = Duration::from_millis(250);
/// Characters of the bar.
const BAR: u64 = 32;

/// Where lines go when nothing is drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Lines {
    /// To standard output: they are what the command is for.
    Out,
    /// To standard error: the command prints something else.
    Error,
}

/// A followed job on the terminal.
pub struct Screen {
    /// The job.
    pub view: JobView,
    lines: Lines,
    /// None: not on a terminal.
    drawing: Option<ProgressBar>,
    terminal: bool,
}

impl Screen {
    /// Shows this job. Drawings go to standard error.
    pub fn new(view: JobView, lines: Lines) -> Self {
        let terminal = std::io::stderr().is_terminal() && (lines == Lines::Error || std::io::stdout().is_terminal());
        let mut screen = Self { view, lines, drawing: None, terminal };
        if terminal {
            screen.draw();
        }
        screen
    }

    /// Whether a person watches and can be asked.
    pub fn is_interactive(&self) -> bool {
        self.terminal && std::io::stdin().is_terminal()
    }

    /// Whether the job was drawn, so that nothing of it is left on the terminal.
    pub fn was_drawn(&self) -> bool {
        self.terminal
    }

    /// The job in two lines: what remains of a drawing.
    pub fn summary(&self) -> String {
        let view = &self.view;
        let best =
            view.best().map(|[step, aoi]| format!("\nmean AoI {}  best {aoi:.2} at step {step}", sparkline(&view.values())));
        status(view) + &best.unwrap_or_default()
    }

    /// Begins to draw.
    pub fn draw(&mut self) {
        let style = ProgressStyle::with_template("{msg}").expect("the template is valid");
        let drawing = ProgressBar::new_spinner().with_style(style).with_message(picture(&self.view));
        drawing.enable_steady_tick(REDRAW);
        self.drawing = Some(drawing);
    }

    /// Removes the drawing.
    pub fn clear(&mut self) {
        if let Some(drawing) = self.drawing.take() {
            drawing.finish_and_clear();
        }
    }

    /// Shows what an event of the job says.
    ///
    /// # Errors
    /// Standard output cannot be written.
    pub fn apply(&mut self, event: JobEvent) -> Result<(), OutputError> {
        let news = self.view.apply(event);
        match &self.drawing {
            Some(drawing) => drawing.set_message(picture(&self.view)),
            None => {
                for line in news.iter().map(|news| line(&self.view, news)) {
                    self.print(&line)?;
                }
            }
        }
        Ok(())
    }

    /// Tells something about the connection.
    pub fn say(&self, line: &str) {
        match &self.drawing {
            Some(drawing) => drawing.println(line),
            None => errln!("{line}"),
        }
    }

    fn print(&self, line: &str) -> Result<(), OutputError> {
        match self.lines {
            Lines::Out => outln!("{line}"),
            Lines::Error => {
                errln!("{line}");
                Ok(())
            }
        }
    }
}

/// What is new, as a line.
fn line(view: &JobView, news: &News) -> String {
    match news {
        News::State => status(view),
        News::Evaluation(step, aoi) => {
            let pace = view.pace();
            let pace = if pace.is_empty() { pace } else { format!("  {pace}") };
            format!("step {step:>8}  mean AoI {aoi:6.2}  {}{pace}", sparkline(&view.values()))
        }
    }
}

/// `job ID (NAME): running, attempt 2`.
fn status(view: &JobView) -> String {
    let mut text = format!("job {}", view.id);
    if !view.name.is_empty() {
        let _ = write!(text, " ({})", view.name);
    }
    let _ = write!(text, ": {}", if view.state.is_empty() { "waiting for the server" } else { &view.state });
    if view.attempt > 1 {
        let _ = write!(text, ", attempt {}", view.attempt);
    }
    if let Some(reason) = &view.reason {
        let _ = write!(text, ": {reason}");
    }
    text
}

/// The job as lines of a terminal.
fn picture(view: &JobView) -> String {
    let done = (BAR * view.per_cent() / 100).min(BAR) as usize;
    let bar = "\u{2588}".repeat(done) + &"\u{2591}".repeat(BAR as usize - done);
    let progress = format!("{bar} {:>3} %  step {} of {}", view.per_cent(), HumanCount(view.step), HumanCount(view.steps));
    let mut lines = vec![status(view), format!("{progress}  {}", view.pace()).trim_end().to_owned()];
    if let Some([step, aoi]) = view.best() {
        lines.push(format!("mean AoI on the validation layouts, in slots; best {aoi:.2} at step {}", HumanCount(step as u64)));
        lines.extend(chart::draw(&view.curve, view.steps as f64));
    }
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_and_pictures_say_where_the_job_is() {
        let mut view = JobView { id: "id".into(), name: "n".into(), steps: 1000, ..JobView::default() };
        assert!(status(&view).contains("waiting"));
        (view.state, view.attempt, view.reason) = ("failed".into(), 2, Some("no memory".into()));
        assert_eq!(status(&view), "job id (n): failed, attempt 2: no memory");
        (view.step, view.speed, view.curve) = (500, Some(100.0), vec![[0.0, 4.0], [500.0, 2.0]]);
        assert_eq!(
            line(&view, &News::Evaluation(500, 2.0)),
            "step      500  mean AoI   2.00  \u{2588}\u{2581}  100 steps/s, 5s left"
        );
        let picture = picture(&view);
        assert!(picture.contains(" 50 %  step 500 of 1,000") && picture.contains("best 2.00 at step 500"), "{picture}");
        assert!(!picture.contains('\u{1b}'), "colours are the terminal's business");
    }
}
