//! Environment variables: every flag names its own, and a misspelled one is pointed out.

use std::collections::BTreeSet;

use clap::Command;

use super::output::errln;
use crate::invalid::nearest;
use crate::nn::VECTOR_WIDTH_VARIABLE;

/// Variables that no flag has: the filter of the logs, and the vector units of networks.
const WITHOUT_FLAG: [&str; 2] = ["QEDGIX_LOG", VECTOR_WIDTH_VARIABLE];

/// Warns of variables `QEDGIX_...` that no flag has and that are similar to one that a flag has.
pub fn warn_of_misspelled(cli: &Command) {
    let set = std::env::vars_os().filter_map(|(name, _)| name.into_string().ok());
    for (name, meant) in misspelled(cli, set) {
        errln!("warning: no flag has the variable {name}; did you mean {meant}?");
    }
}

fn misspelled(cli: &Command, set: impl Iterator<Item = String>) -> Vec<(String, String)> {
    let known = all(cli);
    let unknown = set.filter(|name| name.starts_with(PREFIX) && !known.contains(name));
    // The prefix would make all names similar.
    let meant = |name: &String| nearest(&name[PREFIX.len()..], known.iter().filter_map(|known| known.strip_prefix(PREFIX)));
    let mut found: Vec<_> =
        unknown.filter_map(|name| meant(&name).map(|meant| (name.clone(), format!("{PREFIX}{meant}")))).collect();
    found.sort();
    found
}

const PREFIX: &str = "QEDGIX_";

/// The variables of all commands.
fn all(cli: &Command) -> BTreeSet<String> {
    let own = cli.get_arguments().filter_map(|flag| flag.get_env()?.to_str()).map(str::to_owned);
    let mut names: BTreeSet<String> = own.chain(cli.get_subcommands().flat_map(all)).collect();
    names.extend(WITHOUT_FLAG.map(str::to_owned));
    names
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;
    use crate::cli::Cli;

    #[test]
    fn misspelled_variables_are_found() {
        let found = |names: &[&str]| misspelled(&Cli::command(), names.iter().map(|&name| name.to_owned()));
        assert_eq!(found(&["QEDGIX_CPU_BUGET"]), [("QEDGIX_CPU_BUGET".to_owned(), "QEDGIX_CPU_BUDGET".to_owned())]);
        assert_eq!(found(&["QEDGIX_DATADIR"]), [("QEDGIX_DATADIR".to_owned(), "QEDGIX_DATA_DIR".to_owned())]);
        assert!(
            found(&["QEDGIX_CPU_BUDGET", "QEDGIX_LOG", "QEDGIX_API_KEY", "QEDGIX_WHEEL_SERVER", "PATH", "QEDGIX_"]).is_empty()
        );
    }

    #[test]
    fn every_flag_of_serve_has_its_variable() {
        let cli = Cli::command();
        let serve = cli.find_subcommand("serve").unwrap();
        for flag in serve.get_arguments().filter(|flag| !["help", "version"].contains(&flag.get_id().as_str())) {
            let name = flag.get_long().unwrap().replace('-', "_").to_uppercase();
            assert_eq!(flag.get_env().and_then(|name| name.to_str()), Some(format!("QEDGIX_{name}").as_str()));
        }
    }
}
