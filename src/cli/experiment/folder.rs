//! The folder of a run and the progress of the run.
//!
//! Always: `config.json`, `curve.csv`, `progress.json`. During training: `snapshot`. After training: `policy.safetensors` and
//! `last.safetensors`. After evaluation: `result.json`. Files are written atomically, and a file is written after those that it
//! implies.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::Context;
use serde::{Deserialize, Serialize};

use crate::checkpoint::Checkpoint;
use crate::cli::files::{read_if_exists, write_atomic};
use crate::experiment::{Experiment, Run, RunResult, TrainingCurve};
use crate::files::partial_path;
use crate::learner::Trainer;

/// A run's folder.
pub struct RunFolder {
    path: PathBuf,
}

/// The progress of a run when its files were last written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct RunProgress {
    /// Environment steps.
    pub step: u64,
    /// Seconds of training.
    pub seconds: f64,
    /// Whether training has ended and the weights are written.
    pub trained: bool,
    /// Whether training ended because it diverged.
    pub diverged: bool,
}

impl RunFolder {
    /// The folder of `run` below `root`. Does not create it.
    pub fn new(root: &Path, run: &Run) -> Self {
        Self { path: root.join("runs").join(&run.folder) }
    }

    fn read(&self, name: &str) -> anyhow::Result<Option<Vec<u8>>> {
        read_if_exists(&self.path.join(name))
    }

    fn write(&self, name: &str, bytes: &[u8]) -> anyhow::Result<()> {
        write_atomic(&self.path.join(name), bytes)
    }

    /// Creates the folder and writes the configuration.
    ///
    /// # Errors
    /// The folder or the file cannot be written.
    pub fn create(&self, run: &Run) -> anyhow::Result<()> {
        fs::create_dir_all(&self.path).with_context(|| format!("cannot create {}", self.path.display()))?;
        self.write("config.json", &serde_json::to_vec_pretty(&run.config)?)
    }

    /// The result of the run, if it is finished and was evaluated on the layouts of this experiment.
    ///
    /// # Errors
    /// The file exists and cannot be read.
    pub fn result(&self, experiment: &Experiment) -> anyhow::Result<Option<RunResult>> {
        let Some(bytes) = self.read("result.json")? else { return Ok(None) };
        // A result of another version is ignored, and the weights are evaluated again.
        let result: Option<RunResult> = serde_json::from_slice(&bytes).ok();
        Ok(result
            .filter(|result| result.layouts == experiment.layouts && result.best.episodes.len() == experiment.layout_seeds.len()))
    }

    /// The progress of the run.
    ///
    /// # Errors
    /// The file exists and cannot be read.
    pub fn progress(&self) -> anyhow::Result<RunProgress> {
        let bytes = self.read("progress.json")?;
        Ok(bytes.and_then(|bytes| serde_json::from_slice(&bytes).ok()).unwrap_or_default())
    }

    /// The trainer, curve and seconds of the last snapshot; a new trainer if there is no usable snapshot.
    ///
    /// # Errors
    /// A file exists and cannot be read, or the configuration of the run is invalid.
    pub fn restore(&self, run: &Run, threads: usize) -> anyhow::Result<(Trainer, TrainingCurve, f64)> {
        if let Some(bytes) = self.read("snapshot")?
            && let Ok(trainer) = Trainer::restore(&bytes, threads)
            && *trainer.config() == run.config
        {
            let mut curve = self.curve().unwrap_or_default();
            curve.truncate(trainer.env_steps());
            return Ok((trainer, curve, self.progress()?.seconds));
        }
        Ok((Trainer::new(run.config.clone(), threads)?, TrainingCurve::default(), 0.0))
    }

    /// The curve so far.
    ///
    /// # Errors
    /// The file is missing, or is not a curve.
    pub fn curve(&self) -> anyhow::Result<TrainingCurve> {
        let bytes = self.read("curve.csv")?.with_context(|| format!("{} has no curve.csv", self.path.display()))?;
        let text = String::from_utf8(bytes).with_context(|| format!("{}/curve.csv", self.path.display()))?;
        TrainingCurve::parse(&text).with_context(|| format!("{}/curve.csv", self.path.display()))
    }

    /// Saves the state of a run in progress.
    ///
    /// # Errors
    /// A file cannot be written.
    pub fn save(&self, snapshot: &[u8], curve: &TrainingCurve, progress: &RunProgress) -> anyhow::Result<()> {
        // The curve first: rows after the snapshot are computed again, rows before it are not.
        self.write("curve.csv", curve.csv().as_bytes())?;
        self.write("snapshot", snapshot)?;
        self.write("progress.json", &serde_json::to_vec(progress)?)
    }

    /// Saves the weights of a run whose training has ended.
    ///
    /// # Errors
    /// A file cannot be written.
    pub fn save_weights(
        &self,
        best: &Checkpoint,
        last: Option<&Checkpoint>,
        curve: &TrainingCurve,
        progress: &RunProgress,
    ) -> anyhow::Result<()> {
        self.write("curve.csv", curve.csv().as_bytes())?;
        self.write("policy.safetensors", &best.to_bytes())?;
        if let Some(last) = last {
            self.write("last.safetensors", &last.to_bytes())?;
        }
        self.write("progress.json", &serde_json::to_vec(progress)?)
    }

    /// The best weights by validation.
    ///
    /// # Errors
    /// The file is missing, or is not a checkpoint.
    pub fn best(&self) -> anyhow::Result<Checkpoint> {
        self.weights("policy.safetensors")
    }

    /// The last weights.
    ///
    /// # Errors
    /// The file is missing, or is not a checkpoint.
    pub fn last(&self) -> anyhow::Result<Checkpoint> {
        self.weights("last.safetensors")
    }

    fn weights(&self, name: &str) -> anyhow::Result<Checkpoint> {
        let path = self.path.join(name);
        let bytes = self.read(name)?.with_context(|| format!("{} does not exist", path.display()))?;
        Checkpoint::from_bytes(&bytes).with_context(|| path.display().to_string())
    }

    /// Removes the snapshot and writes the result.
    ///
    /// # Errors
    /// The snapshot cannot be removed, or the result cannot be written.
    pub fn finish(&self, result: &RunResult) -> anyhow::Result<()> {
        // The snapshot first: a run with a result is finished, and its folder is not touched again. Without a snapshot, a run
        // whose training has ended still has its weights.
        let snapshot = self.path.join("snapshot");
        // The partial file is left by a process that was killed during a write.
        for path in [partial_path(&snapshot), snapshot] {
            match fs::remove_file(&path) {
                Err(e) if e.kind() != std::io::ErrorKind::NotFound => {
                    return Err(e).with_context(|| format!("cannot remove {}", path.display()));
                }
                _ => {}
            }
        }
        self.write("result.json", &serde_json::to_vec(result)?)
    }
}
