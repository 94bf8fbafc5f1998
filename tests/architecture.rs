//! Folders are layers; a file imports only from layers below it (ARCHITECTURE.md). This test keeps the picture true.

use std::fs;
use std::path::{Path, PathBuf};

/// Each layer with the layers it may import from. A layer may always import from itself.
const LAYERS: &[(&str, &[&str])] = &[
    ("clock", &[]),
    ("draining", &[]),
    ("invalid", &[]),
    ("error_code", &[]),
    ("rng", &[]),
    ("files", &[]),
    ("wire", &[]),
    ("nn", &["invalid", "rng"]),
    ("env", &["invalid", "rng"]),
    ("plot", &["env", "invalid"]),
    ("policy", &["env", "nn", "invalid", "rng"]),
    ("train_config", &["policy", "env", "invalid"]),
    ("checkpoint", &["train_config", "policy", "env", "nn", "invalid"]),
    ("learner", &["checkpoint", "train_config", "policy", "env", "nn", "invalid", "rng"]),
    ("experiment", &["learner", "checkpoint", "train_config", "plot", "policy", "env", "invalid", "rng"]),
    ("store", &["train_config", "invalid"]),
    ("jobs", &["clock", "draining", "store", "checkpoint", "train_config", "learner", "policy", "env", "invalid", "rng", "wire"]),
    ("serving", &["clock", "checkpoint", "train_config", "learner", "policy", "env", "invalid", "error_code", "rng"]),
    (
        "service",
        &[
            "clock",
            "draining",
            "jobs",
            "serving",
            "store",
            "checkpoint",
            "train_config",
            "learner",
            "policy",
            "env",
            "invalid",
            "error_code",
            "rng",
        ],
    ),
    (
        "api",
        &[
            "clock",
            "draining",
            "service",
            "jobs",
            "serving",
            "store",
            "checkpoint",
            "train_config",
            "learner",
            "policy",
            "env",
            "invalid",
            "error_code",
            "wire",
        ],
    ),
    ("telemetry", &[]),
    ("config", &["service", "jobs", "serving", "invalid"]),
    (
        "server",
        &["clock", "draining", "api", "service", "jobs", "serving", "store", "config", "telemetry", "wire", "invalid", "files"],
    ),
    (
        "cli",
        &[
            "clock",
            "server",
            "config",
            "telemetry",
            "service",
            "jobs",
            "serving",
            "experiment",
            "checkpoint",
            "train_config",
            "learner",
            "plot",
            "policy",
            "env",
            "nn",
            "invalid",
            "error_code",
            "rng",
            "files",
            "wire",
        ],
    ),
];

/// What the pure layers never touch.
const IMPURE: &[&str] =
    &["tokio", "tonic", "axum", "sqlx", "std::fs", "std::net", "std::process", "std::time", "SystemTime", "rand::rng("];
const PURE: &[&str] = &["invalid", "error_code", "rng", "nn", "env", "policy", "learner", "checkpoint", "plot", "experiment"];

fn sources(dir: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in fs::read_dir(dir).expect("src is there") {
        let path = entry.expect("readable").path();
        if path.is_dir() {
            found.extend(sources(&path));
        } else if path.extension().is_some_and(|e| e == "rs") {
            found.push(path);
        }
    }
    found.sort();
    found
}

fn layer_of(path: &Path) -> String {
    let inside = path.strip_prefix(concat!(env!("CARGO_MANIFEST_DIR"), "/src")).expect("below src");
    let first = inside.components().next().expect("a name").as_os_str().to_string_lossy().into_owned();
    first.trim_end_matches(".rs").to_owned()
}

/// The code of a file, without comments and without its unit tests (which come last in a file).
fn code(path: &Path) -> String {
    let text = fs::read_to_string(path).expect("readable");
    let body = text.split("#[cfg(test)]\nmod tests {").next().expect("split yields at least one part");
    body.lines().map(|line| line.split("//").next().unwrap_or("")).collect::<Vec<_>>().join("\n")
}

/// Layers named after `crate::` in `code`, also inside `use crate::{a, b::c}`.
fn imports(code: &str) -> Vec<String> {
    let name = |s: &str| s.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect::<String>();
    let mut found = Vec::new();
    for rest in code.split("crate::").skip(1) {
        let Some(group) = rest.strip_prefix('{') else {
            found.push(name(rest));
            continue;
        };
        let mut depth = 0;
        let mut start = true;
        for (i, c) in group.char_indices() {
            match c {
                '{' => depth += 1,
                '}' if depth == 0 => break,
                '}' => depth -= 1,
                ',' if depth == 0 => start = true,
                c if start && c.is_alphabetic() => {
                    found.push(name(&group[i..]));
                    start = false;
                }
                _ => {}
            }
        }
    }
    found
}

#[test]
fn imports_point_downwards() {
    let src = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/src"));
    let mut wrong = Vec::new();
    let mut files = 0;
    for path in sources(src) {
        let layer = layer_of(&path);
        if layer == "lib" || layer == "main" {
            continue;
        }
        files += 1;
        let Some((_, below)) = LAYERS.iter().find(|(name, _)| *name == layer) else {
            wrong.push(format!("{}: no layer called {layer}; add it to the table", path.display()));
            continue;
        };
        for import in imports(&code(&path)) {
            let known = LAYERS.iter().any(|(name, _)| *name == import);
            if known && import != layer && !below.contains(&import.as_str()) {
                wrong.push(format!("{}: {layer} must not import {import}", path.display()));
            }
        }
    }
    assert!(files > 20, "only {files} files were looked at");
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn pure_layers_stay_pure() {
    let src = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/src"));
    let mut wrong = Vec::new();
    for path in sources(src).iter().filter(|path| PURE.contains(&layer_of(path).as_str())) {
        let code = code(path);
        wrong.extend(IMPURE.iter().filter(|word| code.contains(**word)).map(|word| format!("{}: {word}", path.display())));
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn transports_do_not_call_each_other() {
    let api = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/src/api"));
    for (from, to) in [("grpc", "rest"), ("rest", "grpc")] {
        for path in sources(&api.join(from)) {
            let needle = format!("{to}::");
            assert!(!code(&path).contains(&format!("api::{needle}")), "{} calls {to}", path.display());
            assert!(!code(&path).contains(&format!("super::super::{needle}")), "{} calls {to}", path.display());
        }
    }
}

#[test]
fn the_reader_of_imports_sees_groups() {
    assert_eq!(imports("use crate::{env::{A, B}, policy::C, rng};"), ["env", "policy", "rng"]);
    assert_eq!(imports("crate::nn::gemm(); use crate::env;"), ["nn", "env"]);
}
