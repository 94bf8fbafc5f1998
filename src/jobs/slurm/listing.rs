//! What `squeue` and `sacct` print, in the forms of several versions of Slurm. Pure: text in, jobs out.
//!
//! The fields differ among versions: a state is a word, a list of words or an object with a list, a number may be an object
//! `{"set": true, "number": 3}`. What is missing or has another form is left out; only a name and a state are required.

use std::fmt;

use serde_json::Value;

/// A job as Slurm lists it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct SlurmJob {
    /// Its number. Slurm uses numbers again, so jobs are found by name.
    pub(super) id: String,
    /// Its name, which is unique to a launch.
    pub(super) name: String,
    /// The words of its state, the most important one first: `RUNNING`, or `COMPLETED` and `COMPLETING`.
    pub(super) state: Vec<String>,
    /// Why it is in this state; empty if there is no reason.
    pub(super) reason: String,
    /// How often Slurm has queued it again.
    pub(super) restarts: u64,
    /// How its script ended.
    pub(super) exit: Option<ScriptExit>,
    /// Where it runs; empty if nowhere.
    pub(super) nodes: String,
}

/// How a batch script ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct ScriptExit {
    code: u64,
    signal: u64,
}

impl fmt::Display for ScriptExit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.signal {
            0 => write!(f, "exit code {}", self.code),
            signal => write!(f, "signal {signal}"),
        }
    }
}

/// How a job stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Phase {
    /// It waits for its first start, or is suspended.
    Waiting,
    /// Its script runs, or Slurm cleans up after it.
    Running,
    /// Slurm has stopped it and queued it again.
    Requeued,
    /// It will not run again.
    Ended(Ending),
}

/// How a job ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Ending {
    /// By itself, or because of its limits, or by a person.
    OfJob,
    /// By trouble of the cluster, or for the benefit of another job.
    OfCluster,
}

impl SlurmJob {
    /// How the job stands.
    pub(super) fn phase(&self) -> Phase {
        let is = |word: &str| self.state.iter().any(|state| state == word);
        if ["REQUEUED", "REQUEUE_HOLD", "REQUEUE_FED", "SPECIAL_EXIT", "RESV_DEL_HOLD"].into_iter().any(is) {
            return Phase::Requeued;
        }
        if is("COMPLETING") {
            return Phase::Running;
        }
        match self.state.first().map_or("", String::as_str) {
            "PENDING" | "CONFIGURING" if self.restarts > 0 => Phase::Requeued,
            "PENDING" | "CONFIGURING" | "SUSPENDED" | "STOPPED" => Phase::Waiting,
            "COMPLETED" | "FAILED" | "OUT_OF_MEMORY" | "TIMEOUT" | "DEADLINE" | "CANCELLED" => Phase::Ended(Ending::OfJob),
            "NODE_FAIL" | "BOOT_FAIL" | "PREEMPTED" | "REVOKED" | "LAUNCH_FAILED" | "RECONFIG_FAIL" => {
                Phase::Ended(Ending::OfCluster)
            }
            // RUNNING, STAGE_OUT, SIGNALING, RESIZING, and states of later versions: heartbeats tell whether the worker lives.
            _ => Phase::Running,
        }
    }
}

/// As `Slurm job 12 is PENDING (Resources)`.
impl fmt::Display for SlurmJob {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Slurm job {} is {}", self.id, self.state.join("+"))?;
        if let (Phase::Ended(_), Some(exit)) = (self.phase(), self.exit) {
            write!(f, ", {exit}")?;
        }
        if !self.reason.is_empty() {
            write!(f, " ({})", self.reason)?;
        }
        if self.nodes.is_empty() { Ok(()) } else { write!(f, " on {}", self.nodes) }
    }
}

/// The jobs in the output of `squeue --json` or `sacct --json`; `None` if it is not that.
pub(super) fn from_json(output: &[u8]) -> Option<Vec<SlurmJob>> {
    let document: Value = serde_json::from_slice(output).ok()?;
    Some(document.get("jobs")?.as_array()?.iter().filter_map(job).collect())
}

fn job(job: &Value) -> Option<SlurmJob> {
    let state = job.get("job_state").or_else(|| job.get("state"))?;
    let reason = job.get("state_reason").or_else(|| state.get("reason")).and_then(Value::as_str).unwrap_or_default();
    let state = words(state.get("current").unwrap_or(state));
    Some(SlurmJob {
        id: number(job.get("job_id")?)?.to_string(),
        name: job.get("name")?.as_str()?.to_owned(),
        state: Some(state).filter(|words| !words.is_empty())?,
        reason: meaningful(reason),
        restarts: ["restart_cnt", "restart_count"].iter().find_map(|field| number(job.get(field)?)).unwrap_or_default(),
        exit: job.get("exit_code").and_then(script_exit),
        nodes: job.get("nodes").and_then(Value::as_str).map(meaningful).unwrap_or_default(),
    })
}

/// A word, or a list of words.
fn words(value: &Value) -> Vec<String> {
    match value {
        Value::String(word) => state_words(word),
        Value::Array(all) => all.iter().filter_map(Value::as_str).flat_map(state_words).collect(),
        _ => Vec::new(),
    }
}

/// A number, also as text or as `{"set": true, "number": 3}`.
fn number(value: &Value) -> Option<u64> {
    match value {
        Value::Number(number) => number.as_u64(),
        Value::String(text) => text.parse().ok(),
        Value::Object(object) if object.get("set") != Some(&Value::Bool(false)) => object.get("number")?.as_u64(),
        _ => None,
    }
}

/// `squeue` of early versions prints the status of `wait`, others an object.
fn script_exit(value: &Value) -> Option<ScriptExit> {
    if let Some(status) = value.as_u64() {
        return Some(ScriptExit { code: (status >> 8) & 0xff, signal: status & 0x7f });
    }
    let signal = value.get("signal").and_then(|signal| ["id", "signal_id"].iter().find_map(|field| number(signal.get(field)?)));
    Some(ScriptExit { code: number(value.get("return_code")?).unwrap_or_default(), signal: signal.unwrap_or_default() })
}

/// `CANCELLED by 1000` and `CANCELLED+` are `CANCELLED`.
fn state_words(text: &str) -> Vec<String> {
    let first = text.split_whitespace().next().unwrap_or_default();
    first.split('+').filter(|word| !word.is_empty()).map(str::to_uppercase).collect()
}

/// A text of Slurm without its words for "nothing".
fn meaningful(text: &str) -> String {
    let nothing = ["", "None", "(null)", "N/A", "None assigned"].contains(&text);
    if nothing { String::new() } else { text.to_owned() }
}

/// Columns of `squeue --format` that [`from_squeue_text`] reads.
pub(super) const SQUEUE_FORMAT: &str = "%A|%j|%T|%r|%N";

/// The jobs in the output of `squeue --noheader --format` with [`SQUEUE_FORMAT`].
pub(super) fn from_squeue_text(output: &str) -> Vec<SlurmJob> {
    output.lines().filter_map(|line| from_columns(line, |rest| (rest.first().copied(), None, rest.get(1).copied()))).collect()
}

/// Columns of `sacct --format` that [`from_sacct_text`] reads.
pub(super) const SACCT_FORMAT: &str = "JobIDRaw,JobName,State,ExitCode,NodeList";

/// The jobs in the output of `sacct --noheader --parsable2 --format` with [`SACCT_FORMAT`].
pub(super) fn from_sacct_text(output: &str) -> Vec<SlurmJob> {
    output.lines().filter_map(|line| from_columns(line, |rest| (None, rest.first().copied(), rest.get(1).copied()))).collect()
}

/// Optional texts of the last columns: the reason, the exit code, and the nodes.
type LastColumns<'a> = (Option<&'a str>, Option<&'a str>, Option<&'a str>);

/// A line with number, name and state first.
fn from_columns<'a>(line: &'a str, last: impl Fn(&[&'a str]) -> LastColumns<'a>) -> Option<SlurmJob> {
    let columns: Vec<&str> = line.split('|').map(str::trim).collect();
    let [id, name, state, rest @ ..] = columns.as_slice() else { return None };
    let (reason, exit, nodes) = last(rest);
    let exit = exit.and_then(|text| {
        let (code, signal) = text.split_once(':')?;
        Some(ScriptExit { code: code.parse().ok()?, signal: signal.parse().ok()? })
    });
    let state = state_words(state);
    (!state.is_empty() && id.parse::<u64>().is_ok()).then(|| SlurmJob {
        id: (*id).to_owned(),
        name: (*name).to_owned(),
        state,
        reason: reason.map(meaningful).unwrap_or_default(),
        restarts: 0,
        exit,
        nodes: nodes.map(meaningful).unwrap_or_default(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const SQUEUE_22_05: &[u8] = include_bytes!("fixtures/squeue-22.05.json");
    const SQUEUE_23_11: &[u8] = include_bytes!("fixtures/squeue-23.11.json");
    const SACCT_22_05: &[u8] = include_bytes!("fixtures/sacct-22.05.json");
    const SACCT_24_05: &[u8] = include_bytes!("fixtures/sacct-24.05.json");

    fn described(jobs: &[SlurmJob]) -> Vec<(String, Phase)> {
        jobs.iter().map(|job| (job.to_string(), job.phase())).collect()
    }

    #[test]
    fn squeue_of_several_versions_is_read() {
        let old = from_json(SQUEUE_22_05).unwrap();
        let expected = [
            ("Slurm job 1 is RUNNING on vm", Phase::Running),
            ("Slurm job 2 is PENDING (Resources)", Phase::Waiting),
            ("Slurm job 3 is FAILED, exit code 3 (NonZeroExitCode) on vm", Phase::Ended(Ending::OfJob)),
            ("Slurm job 4 is PENDING (BeginTime)", Phase::Requeued),
        ];
        assert_eq!(described(&old), expected.map(|(text, phase)| (text.to_owned(), phase)));
        assert_eq!(old[1].name, "qedgix-b");
        let new = from_json(SQUEUE_23_11).unwrap();
        let expected = [
            ("Slurm job 1618871 is RUNNING on r6i0n1", Phase::Running),
            ("Slurm job 1618872 is COMPLETED+COMPLETING on r6i0n2", Phase::Running),
            ("Slurm job 1618873 is PREEMPTED, signal 15 on r6i0n3", Phase::Ended(Ending::OfCluster)),
            ("Slurm job 1618874 is PENDING+REQUEUED (BeginTime)", Phase::Requeued),
            ("Slurm job 1618875 is OUT_OF_MEMORY, signal 9 on r6i0n3", Phase::Ended(Ending::OfJob)),
        ];
        assert_eq!(described(&new), expected.map(|(text, phase)| (text.to_owned(), phase)));
    }

    #[test]
    fn sacct_of_several_versions_is_read() {
        let old = from_json(SACCT_22_05).unwrap();
        assert_eq!(described(&old), [("Slurm job 12 is NODE_FAIL, exit code 1 on n1".into(), Phase::Ended(Ending::OfCluster))]);
        let new = from_json(SACCT_24_05).unwrap();
        let expected = ("Slurm job 34 is TIMEOUT, signal 15 on n[1-2]".to_owned(), Phase::Ended(Ending::OfJob));
        assert_eq!(described(&new), [expected]);
    }

    #[test]
    fn text_is_read_where_json_is_missing() {
        let squeue = "4|qedgix-d|FAILED|BadConstraints|\n2|qedgix-b|PENDING|Resources|\n1|qedgix-a|RUNNING|None|vm\nnonsense\n\n";
        let expected = [
            ("Slurm job 4 is FAILED (BadConstraints)", Phase::Ended(Ending::OfJob)),
            ("Slurm job 2 is PENDING (Resources)", Phase::Waiting),
            ("Slurm job 1 is RUNNING on vm", Phase::Running),
        ];
        assert_eq!(described(&from_squeue_text(squeue)), expected.map(|(text, phase)| (text.to_owned(), phase)));
        let sacct =
            "7|qedgix-e|CANCELLED by 1000|0:15|n1\n7.batch|batch|CANCELLED|0:15|n1\n8|qedgix-f|PREEMPTED|0:0|None assigned\n";
        let expected = [
            ("Slurm job 7 is CANCELLED, signal 15 on n1", Phase::Ended(Ending::OfJob)),
            ("Slurm job 8 is PREEMPTED, exit code 0", Phase::Ended(Ending::OfCluster)),
        ];
        assert_eq!(described(&from_sacct_text(sacct)), expected.map(|(text, phase)| (text.to_owned(), phase)));
    }

    #[test]
    fn what_cannot_be_read_is_left_out() {
        assert_eq!(from_json(b"Slurm accounting storage is disabled"), None);
        assert_eq!(from_json(br#"{"errors": []}"#), None);
        let odd = br#"{"jobs": [7, {}, {"job_id": 1}, {"job_id": {"set": false, "number": 0}, "name": "a", "job_state": "RUNNING"},
            {"job_id": 2, "name": "b", "job_state": []}, {"job_id": "3", "name": "c", "job_state": "NEW_STATE", "exit_code": []}]}"#;
        assert_eq!(described(&from_json(odd).unwrap()), [("Slurm job 3 is NEW_STATE".into(), Phase::Running)]);
    }
}
