//! Links the viewer's ES modules into one script, because a page opened from disk cannot load modules.
//!
//! This is not a bundler; it relies on conventions: `import` and `export` begin a line, literals in single quotes name files
//! (`import('./x.js')`, `new URL('./x', import.meta.url)`), imports are named, and exports are declarations of `const`, `function` or
//! `class`. Documentation comments are removed.

use std::collections::BTreeMap;
use std::path::Path;

/// Modules and other files that an entry module needs, directly or indirectly.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct Linked {
    /// Source of a function `($use, $load, $asset) => exports` for each module.
    pub modules: BTreeMap<String, String>,
    /// Contents of all other files that modules refer to; empty if a file does not exist.
    pub assets: BTreeMap<String, Vec<u8>>,
}

/// Links `entry` and everything that it refers to; `read` returns a file by name.
pub(super) fn link<'a>(entry: &str, read: &dyn Fn(&str) -> Option<&'a [u8]>) -> Linked {
    let mut linked = Linked::default();
    let mut pending = vec![entry.to_owned()];
    while let Some(name) = pending.pop() {
        if linked.modules.contains_key(&name) || linked.assets.contains_key(&name) {
            continue;
        }
        let bytes = read(&name).unwrap_or_default();
        match std::str::from_utf8(bytes) {
            Ok(text) if Path::new(&name).extension().is_some_and(|e| e == "js") => {
                let text = converted(&named(&name, &without_comments(text), &mut pending));
                linked.modules.insert(name, text);
            }
            _ => drop(linked.assets.insert(name, bytes.to_vec())),
        }
    }
    linked
}

/// Removes documentation comments that share no line with code. No multi-line string contains such a line.
fn without_comments(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    let mut lines = text.lines();
    while let Some(line) = lines.next() {
        match line.trim_start().strip_prefix("/**").map(|rest| rest.split_once("*/")) {
            Some(None) => drop(lines.by_ref().find(|line| line.trim_end().ends_with("*/"))),
            Some(Some((_, after))) if after.trim().is_empty() => {}
            _ => out.extend([line, "\n"]),
        }
    }
    out
}

/// Replaces paths relative to `module` by names below `static/`, and adds these to `files`.
fn named(module: &str, text: &str, files: &mut Vec<String>) -> String {
    let text = text.replace("import('.", "$load('.").replace("new URL('.", "$asset('.").replace("', import.meta.url)", "')");
    let folder = module.rsplit_once('/').map_or("", |(folder, _)| folder);
    let parts = text.split('\'').map(|part| {
        if !part.starts_with("./") && !part.starts_with("../") {
            return part.to_owned();
        }
        let mut path: Vec<&str> = folder.split('/').filter(|name| !name.is_empty()).collect();
        for name in part.split('/') {
            match name {
                "." => {}
                ".." => drop(path.pop()),
                _ => path.push(name),
            }
        }
        files.push(path.join("/"));
        path.join("/")
    });
    parts.collect::<Vec<_>>().join("'")
}

/// Converts a module to a function.
fn converted(text: &str) -> String {
    let mut out = String::from("($use, $load, $asset) => {\n");
    let mut exports = Vec::new();
    let mut lines = text.lines();
    while let Some(line) = lines.next() {
        if let Some(rest) = line.strip_prefix("import ") {
            // may span several lines
            let mut statement = rest.to_owned();
            while !statement.ends_with(';') {
                let Some(next) = lines.next() else { break };
                statement.push_str(next);
            }
            let statement = statement.trim_end_matches(';');
            match statement.rsplit_once(" from ") {
                Some((names, file)) => out.extend(["const ", &names.replace(" as ", ": "), " = $use(", file, ");\n"]),
                None => out.extend(["$use(", statement, ");\n"]),
            }
        } else if let Some(rest) = line.strip_prefix("export ") {
            let mut words = rest.split(|c: char| !(c.is_alphanumeric() || c == '_' || c == '$'));
            exports.extend(words.find(|word| !["", "async", "class", "const", "function"].contains(word)));
            out.extend([rest, "\n"]);
        } else {
            out.extend([line, "\n"]);
        }
    }
    out.extend(["return { ", &exports.join(", "), " };\n}"]);
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn modules_become_functions() {
        let a = "import { b, c as d } from './x/b.js';\nimport {\n  e,\n} from './x/b.js';\nimport './x/b.js';\n\
                 export const f = 1;\nexport async function g() {}\nexport class H {}\n\
                 const k = new URL('./k.wgsl', import.meta.url);\nconst l = await import('./l.js');\n\
                 /** One. */\n  /**\n   * @import { b } from './other.js'\n   */\nconst m = /** @type {1} */ (1);\n";
        let files: BTreeMap<&str, &str> = [("a.js", a), ("x/b.js", "import '../l.js';\n"), ("l.js", ""), ("k.wgsl", "shader")].into();
        let all = link("a.js", &|name| files.get(name).map(|t| t.as_bytes()));
        assert_eq!(all.modules.keys().collect::<Vec<_>>(), ["a.js", "l.js", "x/b.js"]);
        assert_eq!(all.assets, [("k.wgsl".to_owned(), b"shader".to_vec())].into());
        assert_eq!(
            all.modules["a.js"].lines().collect::<Vec<_>>(),
            [
                "($use, $load, $asset) => {",
                "const { b, c: d } = $use('x/b.js');",
                "const {  e,} = $use('x/b.js');",
                "$use('x/b.js');",
                "const f = 1;",
                "async function g() {}",
                "class H {}",
                "const k = $asset('k.wgsl');",
                "const l = await $load('l.js');",
                "const m = /** @type {1} */ (1);",
                "return { f, g, H };",
                "}",
            ]
        );
    }
}
