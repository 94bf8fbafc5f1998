//! Names of series and points as parts of file names.

/// Each of `names` in lower case, with its words joined by `-`. Names that give the same text, or none, get a number, as `5-2` or
/// `points-3`; the first keeps the text. Names without such a clash do not depend on the others.
pub(super) fn slugs(what: &str, names: &[&str]) -> Vec<String> {
    let plain: Vec<String> = names.iter().map(|name| slug(name)).collect();
    let mut found: Vec<String> = Vec::new();
    for (i, own) in plain.iter().enumerate() {
        let is_first = !own.is_empty() && !plain[..i].contains(own);
        let slug = if is_first {
            own.clone()
        } else {
            let (stem, from) = if own.is_empty() { (what, i + 1) } else { (own.as_str(), 2) };
            let mut numbered = (from..).map(|number| format!("{stem}-{number}"));
            numbered.find(|slug| !plain.contains(slug) && !found.contains(slug)).expect("there are more numbers than names")
        };
        found.push(slug);
    }
    found
}

fn slug(name: &str) -> String {
    let words = name.split(|c: char| !c.is_ascii_alphanumeric()).filter(|word| !word.is_empty());
    words.map(str::to_ascii_lowercase).collect::<Vec<_>>().join("-")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn different_names_have_different_files() {
        for (names, expected) in [
            (&["QMIX, 3 hops", "9 xi"][..], &["qmix-3-hops", "9-xi"][..]),
            (&["Qedgix", "Qedgix+", "qedgix"], &["qedgix", "qedgix-2", "qedgix-3"]),
            (&["-1", "1"], &["1", "1-2"]),
            (&["<= 5", "> 5", "5 2"], &["5", "5-3", "5-2"]),
            (&["学习率", "折扣", "points 2"], &["points-1", "points-3", "points-2"]),
        ] {
            assert_eq!(slugs("points", names), expected);
        }
    }
}
