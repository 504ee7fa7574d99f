//! Links the viewer's ES modules into one script, because a page opened from disk cannot load modules.
//!
//! This is not a bundler; it relies on conventions: `import` and `export` statements begin a line, literals name files
//! (`import('./x.js')`, `new URL('./x', import.meta.url)`), and there are no default exports. Anything else is an error. Documentation
//! comments are removed.

use std::collections::BTreeMap;
use std::path::Path;

/// A module that cannot be linked.
#[derive(Clone, Debug, thiserror::Error, PartialEq, Eq)]
pub enum ScriptError {
    /// A file that a module refers to does not exist.
    #[error("{from} refers to {name:?}, which does not exist")]
    Missing {
        /// The module that refers to it.
        from: String,
        /// The file's name.
        name: String,
    },
    /// A statement has an unsupported form.
    #[error("{module}: {what}")]
    Unknown {
        /// The module.
        module: String,
        /// The statement, or why it is not supported.
        what: String,
    },
}

/// Modules and other files that an entry module needs, directly or indirectly.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct Linked {
    /// Source of a function `($use, $load, $asset) => exports` for each module.
    pub modules: BTreeMap<String, String>,
    /// Contents of all other files that modules refer to.
    pub assets: BTreeMap<String, Vec<u8>>,
}

/// Links `entry` and everything that it refers to; `read` returns a file by name.
pub(super) fn link<'a>(entry: &str, read: &dyn Fn(&str) -> Option<&'a [u8]>) -> Result<Linked, ScriptError> {
    let mut linked = Linked::default();
    let mut pending = vec![(String::new(), entry.to_owned())];
    while let Some((from, name)) = pending.pop() {
        if linked.modules.contains_key(&name) || linked.assets.contains_key(&name) {
            continue;
        }
        let Some(bytes) = read(&name) else { return Err(ScriptError::Missing { from, name }) };
        if Path::new(&name).extension().is_none_or(|e| e != "js") {
            linked.assets.insert(name, bytes.to_vec());
            continue;
        }
        let text = std::str::from_utf8(bytes).map_err(|_| unknown(&name, "it is not UTF-8"))?;
        let mut module = Module { name: &name, files: Vec::new(), exports: Vec::new() };
        let text = module.convert(text)?;
        pending.extend(module.files.into_iter().map(|file| (name.clone(), file)));
        linked.modules.insert(name, text);
    }
    Ok(linked)
}

fn unknown(module: &str, what: impl Into<String>) -> ScriptError {
    ScriptError::Unknown { module: module.to_owned(), what: what.into() }
}

struct Module<'a> {
    name: &'a str,
    /// Files that it refers to.
    files: Vec<String>,
    /// `exported: local` pairs for an object literal.
    exports: Vec<String>,
}

impl Module<'_> {
    fn convert(&mut self, text: &str) -> Result<String, ScriptError> {
        let text = self.addresses(text)?;
        let mut out = String::from("($use, $load, $asset) => {\n");
        let mut lines = text.lines();
        while let Some(line) = lines.next() {
            if starts_comment(line) {
                // remove documentation comments
                if !line.trim_end().ends_with("*/") {
                    let _ = lines.by_ref().find(|l| l.trim_end().ends_with("*/"));
                }
                continue;
            }
            if !line.starts_with("import ") && !line.starts_with("import{") && !starts_export(line) {
                out.push_str(line);
                out.push('\n');
                continue;
            }
            if let Some(rest) = line.strip_prefix("export ").filter(|r| !r.starts_with(['{', '*'])) {
                self.declaration(rest)?;
                out.push_str(rest);
                out.push('\n');
                continue;
            }
            // imports and export lists may span several lines
            let mut statement = line.to_owned();
            while !statement.trim_end().ends_with(';') {
                let next = lines.next().ok_or_else(|| unknown(self.name, format!("unterminated statement {line:?}")))?;
                statement.push(' ');
                statement.push_str(next);
            }
            let statement = statement.trim_end().trim_end_matches(';').trim_end();
            let converted = match statement.strip_prefix("import") {
                Some(rest) => self.import(rest.trim_start())?,
                None => self.list(statement)?,
            };
            out.push_str(&converted);
            out.push('\n');
        }
        out.push_str("return { ");
        out.push_str(&self.exports.join(", "));
        out.push_str(" };\n}");
        Ok(out)
    }

    /// Records `export const NAME`, `export function NAME`, …; the declaration itself stays.
    fn declaration(&mut self, rest: &str) -> Result<(), ScriptError> {
        let mut words = rest.split(|c: char| !(c.is_alphanumeric() || c == '_' || c == '$')).filter(|w| !w.is_empty());
        let kind = words.find(|w| *w != "async");
        match (kind, words.next()) {
            // importers see a `var`'s value after the module has run
            (Some("const" | "var" | "function" | "class"), Some(name)) if !rest.starts_with("const {") && !rest.starts_with("const [") => {
                self.exports.push(name.to_owned());
                Ok(())
            }
            _ => Err(unknown(self.name, format!("export {rest}"))),
        }
    }

    /// Converts `export { a, b as c }`, optionally with `from './x.js'`.
    fn list(&mut self, statement: &str) -> Result<String, ScriptError> {
        let wrong = || unknown(self.name, statement);
        let (names, from) = statement.strip_prefix("export").and_then(|s| braces(s.trim_start())).ok_or_else(wrong)?;
        let pairs = pairs(names).ok_or_else(wrong)?;
        let Some(from) = from.strip_prefix("from") else {
            self.exports.extend(pairs.iter().map(|(local, outer)| format!("{outer}: {local}")));
            return if from.is_empty() { Ok(String::new()) } else { Err(wrong()) };
        };
        let module = self.file(literal(from.trim()).ok_or_else(wrong)?);
        let hidden = format!("$from{}", self.exports.len());
        self.exports.extend(pairs.iter().map(|(inner, outer)| format!("{outer}: {hidden}.{inner}")));
        Ok(format!("const {hidden} = $use({module:?});"))
    }

    /// Converts an import, without the keyword: `'./x.js'`, `{ a, b as c } from './x.js'` or `* as a from './x.js'`.
    fn import(&mut self, rest: &str) -> Result<String, ScriptError> {
        let wrong = || unknown(self.name, format!("import {rest}"));
        if let Some(file) = literal(rest) {
            return Ok(format!("$use({:?});", self.file(file)));
        }
        let (what, from) = if let Some(rest) = rest.strip_prefix('*') {
            let (name, from) = rest.trim().strip_prefix("as ").and_then(|r| r.trim().split_once(' ')).ok_or_else(wrong)?;
            (name.to_owned(), from)
        } else {
            let (names, from) = braces(rest).ok_or_else(wrong)?;
            let pairs = pairs(names).ok_or_else(wrong)?;
            let names: Vec<String> = pairs.iter().map(|(outer, local)| format!("{outer}: {local}")).collect();
            (format!("{{ {} }}", names.join(", ")), from)
        };
        let file = from.trim().strip_prefix("from").and_then(|f| literal(f.trim())).ok_or_else(wrong)?;
        Ok(format!("const {what} = $use({:?});", self.file(file)))
    }

    /// Replaces `new URL('./x', import.meta.url)` and `import('./x.js')`.
    fn addresses(&mut self, text: &str) -> Result<String, ScriptError> {
        let mut out = String::with_capacity(text.len());
        let mut rest = text;
        while let Some(at) = rest.find("import.meta") {
            let wrong = || unknown(self.name, "import.meta is supported only in new URL('./name', import.meta.url)");
            let before = rest[..at].trim_end().strip_suffix(',').ok_or_else(wrong)?;
            let start = before.rfind("new URL(").ok_or_else(wrong)?;
            let file = literal(before[start + "new URL(".len()..].trim()).ok_or_else(wrong)?;
            let after = rest[at..].strip_prefix("import.meta.url").and_then(|r| r.trim_start().strip_prefix(')')).ok_or_else(wrong)?;
            out.extend([&rest[..start], &format!("$asset({:?})", self.file(file))]);
            rest = after;
        }
        out.push_str(rest);
        let text = std::mem::take(&mut out);
        let mut rest = text.as_str();
        while let Some(at) = rest.find("import(") {
            let (head, tail) = (&rest[..at], &rest[at + "import(".len()..]);
            let end = tail.find(')').unwrap_or(0);
            let file = literal(tail[..end].trim()).ok_or_else(|| unknown(self.name, "import() requires a literal"))?;
            out.extend([head, &format!("$load({:?}", self.file(file))]);
            rest = &tail[end..];
        }
        out.push_str(rest);
        Ok(out)
    }

    /// Resolves a path relative to this module to a name below `static/`, and records the file as needed.
    fn file(&mut self, relative: &str) -> String {
        let mut parts: Vec<&str> = self.name.split('/').collect();
        parts.pop();
        for part in relative.split('/') {
            match part {
                "." => {}
                ".." => drop(parts.pop()),
                _ => parts.push(part),
            }
        }
        let name = parts.join("/");
        self.files.push(name.clone());
        name
    }
}

/// Whether a documentation comment begins at this line and shares no line with code. No multi-line string contains such a line.
fn starts_comment(line: &str) -> bool {
    line.trim_start().strip_prefix("/**").is_some_and(|rest| rest.split_once("*/").is_none_or(|(_, after)| after.trim().is_empty()))
}

fn starts_export(line: &str) -> bool {
    line.starts_with("export ") || line.starts_with("export{") || line.starts_with("export*")
}

/// The text of a string literal with a relative path.
fn literal(text: &str) -> Option<&str> {
    let quote = text.chars().next().filter(|c| matches!(c, '\'' | '"'))?;
    let inner = text.strip_prefix(quote)?.strip_suffix(quote)?;
    (inner.starts_with("./") || inner.starts_with("../")).then_some(inner).filter(|i| !i.contains(['\'', '"', '\\', '`', '\n']))
}

/// Splits `{ … } rest` into the text in the braces and the rest.
fn braces(text: &str) -> Option<(&str, &str)> {
    let (inner, after) = text.strip_prefix('{')?.split_once('}')?;
    Some((inner, after.trim()))
}

/// Parses `a, b as c` into the pairs (a, a), (b, c).
fn pairs(text: &str) -> Option<Vec<(&str, &str)>> {
    let name = |n: &str| !n.is_empty() && n != "default" && n.chars().all(|c| c.is_alphanumeric() || c == '_' || c == '$');
    let pair = |item| {
        let (a, b) = str::split_once(item, " as ").unwrap_or((item, item));
        Some((a.trim(), b.trim())).filter(|(a, b)| name(a) && name(b))
    };
    text.split(',').map(str::trim).filter(|item| !item.is_empty()).map(pair).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn linked(files: &[(&str, &'static str)]) -> Result<Linked, ScriptError> {
        let files: BTreeMap<String, &'static str> = files.iter().map(|(n, t)| ((*n).to_owned(), *t)).collect();
        link("a.js", &|name| files.get(name).map(|t| t.as_bytes()))
    }

    #[test]
    fn supported_statements_are_converted() {
        let a = "import { b, c as d } from './x/b.js';\nimport {\n  e,\n} from \"./x/b.js\";\nimport * as all from './x/b.js';\nimport './x/b.js';\n\
                 export const f = 1;\nexport async function g() {}\nexport class H {}\nexport { d as i, e };\nexport { b as j } from './x/b.js';\n\
                 const k = new URL('./k.wgsl', import.meta.url);\nconst l = await import('./l.js');\n\
                 /** One. */\n  /**\n   * @import { b } from './x/b.js'\n   */\nconst m = /** @type {1} */ (1);\n";
        let all = linked(&[("a.js", a), ("x/b.js", "import '../l.js';\n"), ("l.js", ""), ("k.wgsl", "shader")]).unwrap();
        assert_eq!(all.modules.keys().collect::<Vec<_>>(), ["a.js", "l.js", "x/b.js"]);
        assert_eq!(all.assets["k.wgsl"], b"shader");
        assert_eq!(
            all.modules["a.js"].lines().map(str::trim_end).collect::<Vec<_>>(),
            [
                "($use, $load, $asset) => {",
                "const { b: b, c: d } = $use(\"x/b.js\");",
                "const { e: e } = $use(\"x/b.js\");",
                "const all = $use(\"x/b.js\");",
                "$use(\"x/b.js\");",
                "const f = 1;",
                "async function g() {}",
                "class H {}",
                "",
                "const $from5 = $use(\"x/b.js\");",
                "const k = $asset(\"k.wgsl\");",
                "const l = await $load(\"l.js\");",
                "const m = /** @type {1} */ (1);",
                "return { f, g, H, i: d, e: e, j: $from5.b };",
                "}",
            ]
        );
    }

    #[test]
    fn unsupported_statements_are_errors() {
        for bad in [
            "import b from './b.js';",
            "import { b } from 'b';",
            "import { b } from './b.js'",
            "export default 1;",
            "export let x = 1;",
            "export const { x } = y;",
            "export * from './b.js';",
            "const x = import.meta.env;",
            "const x = await import(name);",
        ] {
            let text: &'static str = Box::leak(format!("{bad}\n").into_boxed_str());
            assert!(matches!(linked(&[("a.js", text), ("b.js", "")]), Err(ScriptError::Unknown { .. })), "{bad}");
        }
        assert!(matches!(linked(&[("a.js", "import './b.js';\n")]), Err(ScriptError::Missing { .. })));
    }
}
