//! The folder of a run: what it holds, and how far the run has come.
//!
//! `config.json`, `curve.csv`, `progress.json`; `snapshot` while the run is under way; `policy.safetensors` and
//! `last.safetensors` when training is over; `result.json` when the weights were flown. Every file is whole or absent, and
//! they are written in an order in which the later one vouches for the earlier.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::Context;
use serde::{Deserialize, Serialize};

use crate::checkpoint::Checkpoint;
use crate::cli::files::{read_if_there, write_whole};
use crate::experiment::{Curve, Experiment, Outcome, Run};
use crate::learner::Trainer;

/// A run's folder.
pub struct Folder {
    path: PathBuf,
}

/// How far a run had come when its files were last written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Progress {
    /// Environment steps.
    pub step: u64,
    /// Seconds of training.
    pub seconds: f64,
    /// Whether training is over and the weights are there.
    pub trained: bool,
    /// Whether it ended because a weight left the range of sensible numbers.
    pub diverged: bool,
}

impl Folder {
    /// The folder of `run` below `root`; not made yet.
    pub fn new(root: &Path, run: &Run) -> Self {
        Self { path: root.join("runs").join(&run.folder) }
    }

    fn read(&self, name: &str) -> anyhow::Result<Option<Vec<u8>>> {
        read_if_there(&self.path.join(name))
    }

    fn write(&self, name: &str, bytes: &[u8]) -> anyhow::Result<()> {
        write_whole(&self.path.join(name), bytes)
    }

    /// Makes the folder, and writes the configuration that it is named after.
    pub fn create(&self, run: &Run) -> anyhow::Result<()> {
        fs::create_dir_all(&self.path).with_context(|| format!("cannot make {}", self.path.display()))?;
        self.write("config.json", &serde_json::to_vec_pretty(&run.config)?)
    }

    /// What the run left, if it is finished and was flown on the layouts of this experiment.
    pub fn outcome(&self, experiment: &Experiment) -> anyhow::Result<Option<Outcome>> {
        let Some(bytes) = self.read("result.json")? else { return Ok(None) };
        // A result of another version is no result; the weights are flown again.
        let outcome: Option<Outcome> = serde_json::from_slice(&bytes).ok();
        Ok(outcome.filter(|o| o.layouts == experiment.layouts && o.best.episodes.len() == experiment.layout_seeds.len()))
    }

    /// How far training has come.
    pub fn progress(&self) -> anyhow::Result<Progress> {
        let bytes = self.read("progress.json")?;
        Ok(bytes.and_then(|bytes| serde_json::from_slice(&bytes).ok()).unwrap_or_default())
    }

    /// The run where its snapshot left it, with its curve; at its beginning where there is none that can be used.
    pub fn restore(&self, run: &Run, threads: usize) -> anyhow::Result<(Trainer, Curve, f64)> {
        if let Some(bytes) = self.read("snapshot")?
            && let Ok(trainer) = Trainer::restore(&bytes, threads)
            && *trainer.config() == run.config
        {
            let mut curve = self.curve().unwrap_or_default();
            curve.truncate(trainer.step());
            return Ok((trainer, curve, self.progress()?.seconds));
        }
        Ok((Trainer::new(run.config.clone(), threads)?, Curve::default(), 0.0))
    }

    /// The curve so far.
    pub fn curve(&self) -> anyhow::Result<Curve> {
        let bytes = self.read("curve.csv")?.with_context(|| format!("{} has no curve.csv", self.path.display()))?;
        let text = String::from_utf8(bytes).with_context(|| format!("{}/curve.csv", self.path.display()))?;
        Curve::parse(&text).with_context(|| format!("{}/curve.csv", self.path.display()))
    }

    /// Keeps a run that is under way.
    pub fn save(&self, snapshot: &[u8], curve: &Curve, progress: &Progress) -> anyhow::Result<()> {
        // The curve first: rows after the snapshot are computed again, missing ones are not.
        self.write("curve.csv", curve.csv().as_bytes())?;
        self.write("snapshot", snapshot)?;
        self.write("progress.json", &serde_json::to_vec(progress)?)
    }

    /// Keeps the weights of a run whose training is over.
    pub fn save_weights(
        &self,
        best: &Checkpoint,
        last: Option<&Checkpoint>,
        curve: &Curve,
        progress: &Progress,
    ) -> anyhow::Result<()> {
        self.write("curve.csv", curve.csv().as_bytes())?;
        self.write("policy.safetensors", &best.to_bytes())?;
        if let Some(last) = last {
            self.write("last.safetensors", &last.to_bytes())?;
        }
        self.write("progress.json", &serde_json::to_vec(progress)?)
    }

    /// The best weights by validation.
    pub fn best(&self) -> anyhow::Result<Checkpoint> {
        self.weights("policy.safetensors")
    }

    /// The last weights.
    pub fn last(&self) -> anyhow::Result<Checkpoint> {
        self.weights("last.safetensors")
    }

    fn weights(&self, name: &str) -> anyhow::Result<Checkpoint> {
        let path = self.path.join(name);
        let bytes = self.read(name)?.with_context(|| format!("{} is not there", path.display()))?;
        Checkpoint::from_bytes(&bytes).with_context(|| path.display().to_string())
    }

    /// Ends the run: its result is there, its snapshot is of no more use.
    pub fn finish(&self, outcome: &Outcome) -> anyhow::Result<()> {
        self.write("result.json", &serde_json::to_vec(outcome)?)?;
        // What a process left that was killed while it wrote goes too.
        for name in ["snapshot", "snapshot.partial"] {
            match fs::remove_file(self.path.join(name)) {
                Err(e) if e.kind() != std::io::ErrorKind::NotFound => return Err(e).context("removing a snapshot"),
                _ => {}
            }
        }
        Ok(())
    }
}
