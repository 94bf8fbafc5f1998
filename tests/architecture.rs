//! Checks the structure that ARCHITECTURE.md describes: a file imports only from layers below its own, and within a layer no
//! modules import each other in a circle.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

/// Each layer with the layers it may import from. A layer may always import from itself.
const LAYERS: &[(&str, &[&str])] = &[
    ("clock", &[]),
    ("draining", &[]),
    ("inflight", &[]),
    ("invalid", &[]),
    ("error_code", &[]),
    ("causes", &[]),
    ("rng", &[]),
    ("files", &[]),
    ("wire", &[]),
    ("threads", &[]),
    ("nn", &["rng", "threads"]),
    ("env", &["invalid", "rng"]),
    ("plot", &["env"]),
    ("policy", &["env", "nn", "invalid", "rng", "threads"]),
    ("train_config", &["policy", "env", "invalid"]),
    ("checkpoint", &["train_config", "policy", "env", "nn", "invalid"]),
    ("onnx", &["wire", "checkpoint", "policy", "env", "nn", "invalid"]),
    ("learner", &["checkpoint", "train_config", "policy", "env", "nn", "invalid", "rng"]),
    ("experiment", &["learner", "checkpoint", "train_config", "plot", "policy", "env", "invalid", "rng"]),
    ("store", &["train_config", "files"]),
    (
        "jobs",
        &[
            "clock",
            "draining",
            "files",
            "store",
            "experiment",
            "checkpoint",
            "train_config",
            "learner",
            "policy",
            "env",
            "invalid",
            "error_code",
            "rng",
            "wire",
        ],
    ),
    ("serving", &["clock", "train_config", "policy", "env", "invalid", "error_code", "rng", "threads"]),
    (
        "service",
        &[
            "causes",
            "clock",
            "draining",
            "inflight",
            "files",
            "jobs",
            "serving",
            "store",
            "experiment",
            "checkpoint",
            "train_config",
            "learner",
            "policy",
            "env",
            "invalid",
            "error_code",
        ],
    ),
    (
        "api",
        &[
            "causes",
            "draining",
            "inflight",
            "service",
            "jobs",
            "serving",
            "store",
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
    ("config", &["service", "jobs", "serving", "inflight", "invalid"]),
    (
        "server",
        &[
            "causes",
            "clock",
            "draining",
            "inflight",
            "api",
            "service",
            "jobs",
            "serving",
            "store",
            "config",
            "telemetry",
            "invalid",
            "files",
        ],
    ),
    (
        "cli",
        &[
            "causes",
            "clock",
            "server",
            "config",
            "telemetry",
            "service",
            "jobs",
            "serving",
            "experiment",
            "onnx",
            "checkpoint",
            "train_config",
            "learner",
            "plot",
            "policy",
            "env",
            "nn",
            "invalid",
            "files",
            "wire",
        ],
    ),
];

/// Names that pure layers must not contain.
const IMPURE: &[&str] =
    &["tokio", "tonic", "axum", "sqlx", "std::fs", "std::net", "std::process", "std::time", "SystemTime", "rand::rng("];
const PURE: &[&str] = &[
    "invalid",
    "error_code",
    "rng",
    "nn",
    "env",
    "policy",
    "train_config",
    "learner",
    "checkpoint",
    "onnx",
    "plot",
    "experiment",
];

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

/// A module as the names on its path: `["policy", "mixer"]`.
type Module = Vec<String>;

/// The module that a file defines.
fn module_of(path: &Path) -> Module {
    let inside = path.strip_prefix(concat!(env!("CARGO_MANIFEST_DIR"), "/src")).expect("below src").with_extension("");
    let names = inside.components().map(|part| part.as_os_str().to_string_lossy().into_owned());
    names.filter(|name| name != "mod" && name != "lib").collect()
}

/// The identifiers, `::` and other symbols of `code`.
fn tokens(code: &str) -> Vec<&str> {
    let word = |c: char| c.is_alphanumeric() || c == '_';
    let mut found = Vec::new();
    let mut rest = code.trim_start();
    while let Some(first) = rest.chars().next() {
        let length = match rest.find(|c| !word(c)) {
            Some(0) if rest.starts_with("::") => 2,
            Some(0) => first.len_utf8(),
            end => end.unwrap_or(rest.len()),
        };
        found.push(&rest[..length]);
        rest = rest[length..].trim_start();
    }
    found
}

/// Paths of a use tree that starts at `at`, each after `prefix`, with the name that each path introduces. Returns the index
/// behind the tree.
fn use_tree(tokens: &[&str], mut at: usize, prefix: &[&str], found: &mut Vec<(Vec<String>, String)>) -> usize {
    let mut path = prefix.to_vec();
    loop {
        match tokens.get(at).copied() {
            Some("::") => at += 1,
            Some("{") => {
                at += 1;
                while !matches!(tokens.get(at), Some(&("}" | ";")) | None) {
                    at = use_tree(tokens, at, &path, found);
                    at += usize::from(tokens.get(at) == Some(&","));
                }
                return at + 1;
            }
            Some("as") => {
                found.push((path.iter().map(ToString::to_string).collect(), tokens[at + 1].to_owned()));
                return at + 2;
            }
            Some("," | "}" | ";") | None => {
                if path.len() > 1 && path.last() == Some(&"self") {
                    path.pop();
                }
                let name = path.last().map(ToString::to_string).unwrap_or_default();
                found.push((path.iter().map(ToString::to_string).collect(), name));
                return at;
            }
            Some(name) => {
                path.push(name);
                at += 1;
            }
        }
    }
}

/// The paths in a file's code: in `use` declarations, with the names that they introduce, and elsewhere.
fn paths(code: &str) -> Vec<(Vec<String>, Option<String>)> {
    let tokens = tokens(code);
    let mut found = Vec::new();
    let mut at = 0;
    while at < tokens.len() {
        if tokens[at] == "use" {
            let mut tree = Vec::new();
            at = use_tree(&tokens, at + 1, &[], &mut tree);
            found.extend(tree.into_iter().map(|(path, name)| (path, Some(name))));
        } else if tokens.get(at + 1) == Some(&"::") {
            let mut path = vec![tokens[at].to_owned()];
            at += 1;
            while tokens.get(at) == Some(&"::") && tokens.get(at + 1).is_some_and(|t| t.starts_with(char::is_alphabetic)) {
                path.push(tokens[at + 1].to_owned());
                at += 2;
            }
            at += usize::from(tokens.get(at) == Some(&"::"));
            found.push((path, None));
        } else {
            at += 1;
        }
    }
    found
}

/// The modules of a source tree, the paths in each, and the names that each introduces by `use`.
struct Modules {
    paths: BTreeMap<Module, BTreeSet<Vec<String>>>,
    names: BTreeMap<(Module, String), Vec<String>>,
}

impl Modules {
    fn read(files: impl Iterator<Item = (Module, String)>) -> Self {
        let files: Vec<(Module, String)> = files.collect();
        let mut modules =
            Self { paths: files.iter().map(|(m, _)| (m.clone(), BTreeSet::new())).collect(), names: BTreeMap::new() };
        for (module, code) in &files {
            for (path, name) in paths(code) {
                let Some(path) = modules.absolute(module, &path) else { continue };
                if let Some(name) = name {
                    modules.names.insert((module.clone(), name), path.clone());
                }
                modules.paths.get_mut(module).expect("inserted above").insert(path);
            }
        }
        modules
    }

    /// `path` from the root of the crate; `None` for other crates and local names.
    fn absolute(&self, module: &Module, path: &[String]) -> Option<Vec<String>> {
        let supers = path.iter().take_while(|name| *name == "super").count();
        let (base, rest) = match path[0].as_str() {
            "crate" => (&[][..], &path[1..]),
            "self" => (&module[..], &path[1..]),
            "super" => (&module[..module.len().checked_sub(supers)?], &path[supers..]),
            child if self.paths.contains_key(&[&module[..], &[child.to_owned()]].concat()) => (&module[..], path),
            _ => return None,
        };
        Some([base, rest].concat())
    }

    /// The module that defines the item at an absolute path, behind all re-exports.
    fn definer(&self, path: &[String], depth: usize) -> Module {
        let mut length = 0;
        while length < path.len() && self.paths.contains_key(&path[..=length]) {
            length += 1;
        }
        match path.get(length).and_then(|name| self.names.get(&(path[..length].to_vec(), name.clone()))) {
            Some(target) if depth < 8 => self.definer(&[target, &path[length + 1..]].concat(), depth + 1),
            _ => path[..length].to_vec(),
        }
    }

    /// For each folder, which of its children import which others, with one example each.
    fn siblings(&self) -> BTreeMap<Module, BTreeMap<String, BTreeMap<String, String>>> {
        let mut folders = BTreeMap::<_, BTreeMap<_, BTreeMap<_, _>>>::new();
        for (from, paths) in &self.paths {
            for path in paths {
                let to = self.definer(path, 0);
                let common = from.iter().zip(&to).take_while(|(a, b)| a == b).count();
                // 0: different layers, which another test checks.
                if common > 0 && common < from.len() && common < to.len() {
                    let example = format!("{} uses {}", from.join("::"), path.join("::"));
                    let children = folders.entry(from[..common].to_vec()).or_default();
                    children.entry(from[common].clone()).or_default().entry(to[common].clone()).or_insert(example);
                }
            }
        }
        folders
    }

    /// Every import that is part of a circle.
    fn circles(&self) -> Vec<String> {
        let mut found = Vec::new();
        for children in self.siblings().values() {
            for (from, imports) in children {
                for (to, example) in imports {
                    let mut reached = BTreeSet::from([to]);
                    let mut queue = vec![to];
                    while let Some(next) = queue.pop() {
                        queue.extend(children.get(next).into_iter().flat_map(BTreeMap::keys).filter(|&n| reached.insert(n)));
                    }
                    if reached.contains(from) {
                        found.push(example.clone());
                    }
                }
            }
        }
        found
    }
}

/// The rule: of the files and folders in one folder, none imports itself by way of others. A folder counts as one with all
/// that is in it. An import counts where its item is defined, not where it is re-exported. A folder's own `mod.rs` holds what
/// its children share, so imports between a module and its descendants are free.
#[test]
fn no_modules_of_a_layer_import_each_other_in_a_circle() {
    let src = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/src"));
    let files = sources(src).into_iter().filter(|path| !path.ends_with("src/main.rs"));
    let modules = Modules::read(files.map(|path| (module_of(&path), code(&path))));
    let imports: usize = modules.siblings().values().flat_map(BTreeMap::values).map(BTreeMap::len).sum();
    assert!(imports > 100, "only {imports} imports between siblings were found");
    let circles = modules.circles();
    assert!(circles.is_empty(), "{}", circles.join("\n"));
}

#[test]
fn circles_are_found_through_re_exports_groups_and_paths_in_code() {
    let circles = |files: &[(&str, &str)]| {
        let modules = files.iter().map(|(name, code)| (name.split("::").map(str::to_owned).collect(), (*code).to_owned()));
        Modules::read(modules.collect::<Vec<_>>().into_iter()).circles()
    };
    let parent = ("a", "mod x; mod y; mod z; pub use x::{X, Inner as I}; use self::z::Z; struct Shared;");
    assert_eq!(
        circles(&[parent, ("a::x", "use super::{y::Y, Shared};"), ("a::y", "fn f() { crate::a::I::new() }"), ("a::z", "")]),
        ["a::x uses a::y::Y", "a::y uses a::I::new"]
    );
    // By way of a third module, and of a module inside a folder.
    let z = [("a::z", "mod deep;"), ("a::z::deep", "use super::super::x;")];
    assert_eq!(circles(&[parent, ("a::x", "use super::y;"), ("a::y", "use super::z::{self, deep};"), z[0], z[1]]).len(), 3);
    // Between a module and its descendants, everything is free; so is a straight line.
    let line = [("a::x", "use super::{I, Shared, y};"), ("a::y", "use crate::a::Z;"), ("a::z", "use crate::b::x;")];
    assert_eq!(circles(&[parent, line[0], line[1], line[2]]), [""; 0]);
}

#[test]
fn imports_point_downwards() {
    let src = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/src"));
    let mut wrong = Vec::new();
    let mut used = BTreeSet::new();
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
            used.insert((layer.clone(), import));
        }
    }
    let allowed = LAYERS.iter().flat_map(|(layer, below)| below.iter().map(|import| ((*layer).to_owned(), (*import).to_owned())));
    wrong.extend(allowed.filter(|pair| !used.contains(pair)).map(|(layer, import)| format!("{layer} need not import {import}")));
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
