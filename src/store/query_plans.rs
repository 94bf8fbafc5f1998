//! Checks that statements find their rows by an index. Every statement is found in the source, so a new one is checked too.

use std::collections::BTreeSet;
use std::path::Path;

use sqlx::Row;

/// Statements that read a whole table or index, by their beginning, and why they may.
const SCANS: &[(&str, &str)] = &[
    ("SELECT state, count(*) FROM jobs", "metrics; reads only an index with short entries"),
    ("SELECT name, version, digest FROM policy_versions", "once at the start; reads only an index with short entries"),
    ("SELECT name, alias, version FROM policy_aliases", "once at the start"),
    ("SELECT name, version FROM policies_unloaded", "once at the start"),
    ("SELECT id, COALESCE(owner, id) AS owner, name,", "only after a key has changed; keys are few"),
    ("DELETE FROM snapshots WHERE sha256 IS NULL", "the index has only incomplete snapshots, which are all deleted"),
    ("SELECT j.id, l.job, l.attempt, l.name", "once at the start; as many as workers run"),
    ("DELETE FROM launches", "once at the start, of all rows"),
    ("WITH ended AS (", "every minute, if old jobs are deleted; reads only the index of jobs that have ended"),
    ("SELECT name, version FROM followed_versions", "all are compared, when a primary has changed"),
    ("SELECT at FROM followed_until", "one row"),
    ("SELECT version FROM _sqlx_migrations", "one row per migration"),
    ("SELECT version FROM written_by", "one row"),
    ("SELECT c.id, j.id AS job, c.kind, c.sha256", "only to check a copy of the database"),
];

/// The string literals of a Rust source.
fn literals(source: &str) -> Vec<String> {
    let (mut found, mut rest) = (Vec::new(), source);
    while let Some(at) = rest.find(['"', '/', '\'']) {
        let (before, token) = rest.split_at(at);
        let hashes = before.len() - before.trim_end_matches('#').len();
        if token.starts_with("//") {
            rest = token.find('\n').map_or("", |end| &token[end..]);
        } else if !token.starts_with('"') {
            // A character such as '"', a lifetime, or a division.
            rest = token.strip_prefix("'\"'").unwrap_or(&token[1..]);
        } else if before.trim_end_matches('#').ends_with('r') {
            let end = format!("\"{}", "#".repeat(hashes));
            let (literal, after) = token[1..].split_once(&end).unwrap();
            found.push(literal.to_owned());
            rest = after;
        } else {
            let mut escaped = false;
            let end = token[1..].find(|c| {
                let ends = c == '"' && !escaped;
                escaped = c == '\\' && !escaped;
                ends
            });
            let (literal, after) = token[1..].split_at(end.unwrap());
            found.push(literal.replace("\\\n", "\n").replace("\\\"", "\""));
            rest = &after[1..];
        }
    }
    found
}

fn is_statement(literal: &str) -> bool {
    ["SELECT ", "INSERT ", "UPDATE ", "DELETE ", "REPLACE ", "WITH "].iter().any(|verb| literal.starts_with(verb))
}

#[tokio::test]
async fn every_statement_uses_an_index() {
    let dir = tempfile::tempdir().unwrap();
    let store = super::Store::open(dir.path()).await.unwrap();
    let tables: Vec<String> =
        sqlx::query_scalar("SELECT name FROM sqlite_schema WHERE type = 'table'").fetch_all(&store.read).await.unwrap();
    let (mut scans, mut used) = (Vec::new(), BTreeSet::new());
    for entry in std::fs::read_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join("src/store")).unwrap() {
        let path = entry.unwrap().path();
        let source = std::fs::read_to_string(&path).unwrap();
        if path.ends_with("query_plans.rs") {
            continue;
        }
        let source = source.split("#[cfg(test)]\nmod tests").next().unwrap();
        let statements: Vec<String> = literals(source).into_iter().filter(|literal| is_statement(literal)).collect();
        let calls = ["sqlx::query(", "sqlx::query_as(", "sqlx::query_scalar("];
        let calls: usize = calls.iter().map(|call| source.matches(call).count()).sum();
        let pragmas = source.matches("\"PRAGMA ").count() + source.matches("\"VACUUM").count();
        // Statements that are put together from parts would not be checked.
        assert!(statements.len() + pragmas >= calls, "{}: a statement must be one literal", path.display());
        for statement in statements {
            let plan = sqlx::query(sqlx::AssertSqlSafe(format!("EXPLAIN QUERY PLAN {statement}"))).fetch_all(&store.read).await;
            let plan = plan.unwrap_or_else(|e| panic!("{}: {e}: {statement}", path.display()));
            let steps: Vec<String> = plan.iter().map(|row| row.get::<String, _>("detail")).collect();
            // A step without the name of a table is a subquery, or a table-valued function such as json_each.
            let scan = |step: &String| {
                let words: Vec<&str> = step.split(' ').collect();
                words[0] == "SCAN"
                    && words[1] != "sqlite_schema"
                    && (words.len() == 2 || words[2] != "VIRTUAL")
                    && !words[1].starts_with('(')
            };
            let listed = SCANS.iter().position(|(beginning, _)| statement.starts_with(beginning));
            if steps.iter().any(scan) {
                match listed {
                    Some(i) => drop(used.insert(i)),
                    None => scans.push(format!("{}: {steps:?}: {statement}", path.display())),
                }
            }
        }
    }
    assert!(tables.len() > 10 && scans.is_empty(), "statements that read a whole table:\n{}", scans.join("\n"));
    let unused: Vec<_> = (0..SCANS.len()).filter(|i| !used.contains(i)).map(|i| SCANS[i].0).collect();
    assert!(unused.is_empty(), "listed, but do not read a whole table: {unused:?}");
}

/// Without an index, a deletion would read all of the table that refers to the deleted row.
#[tokio::test]
async fn every_foreign_key_has_an_index() {
    let dir = tempfile::tempdir().unwrap();
    let store = super::Store::open(dir.path()).await.unwrap();
    let keys = "SELECT t.name, group_concat(k.\"from\", ',') FROM sqlite_schema t, pragma_foreign_key_list(t.name) k
                WHERE t.type = 'table' GROUP BY t.name, k.id ORDER BY k.seq";
    let keys: Vec<(String, String)> = sqlx::query_as(keys).fetch_all(&store.read).await.unwrap();
    assert!(keys.len() > 5);
    for (table, columns) in keys {
        let condition = columns.split(',').map(|column| format!("{column} = ?")).collect::<Vec<_>>().join(" AND ");
        let sql = format!("EXPLAIN QUERY PLAN SELECT 1 FROM {table} WHERE {condition}");
        let plan = sqlx::query(sqlx::AssertSqlSafe(sql)).fetch_all(&store.read).await.unwrap();
        let step: String = plan[0].get("detail");
        assert!(step.starts_with("SEARCH"), "{table} ({columns}): {step}");
    }
}

#[test]
fn literals_are_found() {
    let source = "// \"no\"\nlet a = \"x\\\"y\"; let c = '\"'; fn f<'a>() { r#\"z \"q\" \"#; } let b = \"two \\\n lines\"; 4 / 2";
    assert_eq!(literals(source), ["x\"y", "z \"q\" ", "two \n lines"]);
}
