//! What `sbatch` is asked for, and the file from which a worker knows its attempt.

use std::path::{Path, PathBuf};
use std::time::Duration;

use super::SlurmTimes;
use crate::invalid::Invalid;
use crate::jobs::Resources;

/// How workers are submitted to Slurm.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct SlurmConfig {
    /// The partition; `None`: that of the cluster.
    pub partition: Option<String>,
    /// The account that is charged; `None`: that of the user.
    pub account: Option<String>,
    /// Time limit of each attempt; `None`: that of the partition.
    pub time: Option<Duration>,
    /// Further flags of `sbatch`.
    pub extra: Vec<String>,
    /// Directory that the server and the nodes share, for the credentials and the output of workers; `None`: in the data directory.
    pub directory: Option<PathBuf>,
    /// Directory of the commands of Slurm; `None`: those of `PATH`.
    pub commands: Option<PathBuf>,
    /// How often Slurm is asked, and how long it may take.
    pub times: SlurmTimes,
}

/// Flags of `sbatch` that the server sets itself, or that would start several workers for one attempt.
const OWN_FLAGS: [&str; 21] = [
    "--array",
    "-a",
    "--requeue",
    "--no-requeue",
    "--job-name",
    "-J",
    "--output",
    "-o",
    "--error",
    "-e",
    "--input",
    "-i",
    "--open-mode",
    "--export",
    "--parsable",
    "--wrap",
    "--wait",
    "-W",
    "--ntasks",
    "-n",
    "--test-only",
];

impl SlurmConfig {
    /// Checks the further flags.
    ///
    /// # Errors
    /// [`Invalid`] for a word that is not a flag, and for a flag that the server sets itself.
    pub fn validate(&self) -> Result<(), Invalid> {
        let own = |flag: &str| {
            let name = flag.split('=').next().unwrap_or_default();
            let short = name.starts_with('-') && !name.starts_with("--");
            OWN_FLAGS.iter().any(|own| name == *own || (short && own.len() == 2 && name.starts_with(own)))
        };
        let wrong = self.extra.iter().find(|flag| !flag.starts_with('-') || flag.contains(char::is_control) || own(flag));
        let expected = "a flag of sbatch with its value in one word, such as --qos=long, that the server does not set itself";
        wrong.map_or(Ok(()), |flag| Err(Invalid::new("--slurm-extra", format!("{flag:?}"), expected)))
    }
}

/// The files of a launch.
#[derive(Clone, Debug)]
pub(super) struct LaunchFiles {
    /// What the worker reads; only its owner may read it.
    pub(super) assignment: PathBuf,
    /// The worker's output.
    pub(super) output: PathBuf,
}

impl LaunchFiles {
    pub(super) fn new(directory: &Path, name: &str) -> Self {
        Self { assignment: directory.join(format!("{name}.json")), output: directory.join(format!("{name}.log")) }
    }

    /// Removes them. They may be missing.
    pub(super) fn remove(&self) {
        let _ = (std::fs::remove_file(&self.assignment), std::fs::remove_file(&self.output));
    }
}

/// The arguments of `sbatch`, which reads the script from its standard input.
pub(super) fn arguments(config: &SlurmConfig, name: &str, resources: Resources, output: &Path) -> Vec<String> {
    let mut arguments = vec![
        "--parsable".to_owned(),
        format!("--job-name={name}"),
        "--nodes=1".into(),
        "--ntasks=1".into(),
        format!("--cpus-per-task={}", resources.threads),
        format!("--mem={}M", resources.memory.div_ceil(1 << 20)),
        // The next attempt has its own token, so an attempt does not start twice.
        "--no-requeue".into(),
        // Nothing of the server's environment, which may have secrets.
        "--export=PATH".into(),
        "--open-mode=append".into(),
        // % begins a pattern.
        format!("--output={}", output.display().to_string().replace('%', "%%")),
    ];
    let flag = |name: &str, value: &Option<String>| value.as_ref().map(|value| format!("--{name}={value}"));
    arguments.extend(flag("partition", &config.partition));
    arguments.extend(flag("account", &config.account));
    arguments.extend(config.time.map(|time| format!("--time={}", time.as_secs().div_ceil(60).max(1))));
    arguments.extend(config.extra.iter().cloned());
    arguments
}

/// The batch script: the process of the script becomes the worker.
pub(super) fn script(program: &Path, assignment: &Path) -> String {
    let quoted = |path: &Path| format!("'{}'", path.display().to_string().replace('\'', r"'\''"));
    format!("#!/bin/sh\nexec {} worker --assignment {}\n", quoted(program), quoted(assignment))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn requests_are_complete() {
        let config = SlurmConfig {
            partition: Some("long".into()),
            account: Some("lab".into()),
            time: Some(Duration::from_secs(3601)),
            extra: vec!["--qos=high".into()],
            ..SlurmConfig::default()
        };
        let resources = Resources { threads: 4, memory: (2 << 30) + 1 };
        let arguments = arguments(&config, "qedgix-1-2-ab", resources, Path::new("/share/50%/a.log"));
        let expected = [
            "--parsable",
            "--job-name=qedgix-1-2-ab",
            "--nodes=1",
            "--ntasks=1",
            "--cpus-per-task=4",
            "--mem=2049M",
            "--no-requeue",
            "--export=PATH",
            "--open-mode=append",
            "--output=/share/50%%/a.log",
            "--partition=long",
            "--account=lab",
            "--time=61",
            "--qos=high",
        ];
        assert_eq!(arguments, expected);
        let script = script(Path::new("/opt/o'neil/qedgix"), Path::new("/share/a b.json"));
        assert_eq!(script, "#!/bin/sh\nexec '/opt/o'\\''neil/qedgix' worker --assignment '/share/a b.json'\n");
    }

    #[test]
    fn flags_that_would_break_the_server_are_refused() {
        let check = |flag: &str| SlurmConfig { extra: vec![flag.into()], ..SlurmConfig::default() }.validate();
        for flag in ["--qos=a", "--exclusive", "-C", "-Cfast", "--nice=100", "--gres=gpu:1", "--constraint=a,b"] {
            assert_eq!(check(flag), Ok(()), "{flag}");
        }
        for flag in ["", "qos", "--array=1-3", "-a1-3", "--requeue", "-Jname", "--output=x", "--wrap=rm", "--a\n=1"] {
            assert_eq!(check(flag).unwrap_err().field, "--slurm-extra", "{flag}");
        }
    }
}
