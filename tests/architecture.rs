//! Checks ARCHITECTURE.md: the graph matches `cargo metadata`, dependencies follow one order, every path exists.
//!
//! `TMPI_BLESS=architecture cargo test --release --workspace --test architecture` writes the graph.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "test")]

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::process::Command;

use serde_json::Value;

/// The crates in order: each may depend only on those before it.
const ORDER: [&str; 12] = [
    "tmpi-core",
    "tmpi-client",
    "tmpi-decoder",
    "tmpi-live-decoder",
    "tmpi-unpacker",
    "tmpi-library",
    "tmpi-render",
    "tmpi-pipeline",
    "tmpi-live",
    "tmpi-testing",
    "tmpi-lab",
    "tmpi",
];
const GRAPH_START: &str = "```mermaid\ngraph LR\n";
const GRAPH_END: &str = "```\n<!-- /crates -->";

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Pairs (crate, dependency) of crates in this workspace; ordinary dependencies only.
fn dependencies() -> BTreeSet<(String, String)> {
    let cargo = std::env::var("CARGO").unwrap_or_else(|_| "cargo".into());
    let out = Command::new(cargo)
        .current_dir(root())
        .args(["metadata", "--no-deps", "--offline", "--format-version", "1"])
        .output()
        .expect("cargo runs");
    let metadata: Value = serde_json::from_slice(&out.stdout).expect("metadata is JSON");
    let text = |v: &Value| v.as_str().unwrap_or_default().to_owned();
    let packages = metadata["packages"].as_array().expect("a list of packages");
    let of_package = |p: &Value| {
        let own = text(&p["name"]);
        let all = p["dependencies"].as_array().cloned().unwrap_or_default();
        all.into_iter().filter(|d| d["path"].is_string() && d["kind"].is_null()).map(move |d| (own.clone(), text(&d["name"])))
    };
    packages.iter().flat_map(of_package).collect()
}

#[test]
fn the_crate_graph_matches_cargo_metadata() {
    let graph = dependencies().iter().map(|(name, dependency)| format!("  {dependency} --> {name}\n")).collect::<Vec<_>>().concat();
    let path = root().join("ARCHITECTURE.md");
    let page = std::fs::read_to_string(&path).unwrap();
    let from = page.find(GRAPH_START).expect("start of the graph") + GRAPH_START.len();
    let to = from + page[from..].find(GRAPH_END).expect("end of the graph");
    if std::env::var("TMPI_BLESS").is_ok_and(|v| v == "architecture") {
        std::fs::write(&path, [&page[..from], &graph, &page[to..]].concat()).unwrap();
    } else {
        assert_eq!(page[from..to], graph);
    }
}

#[test]
fn crates_depend_only_on_earlier_ones() {
    let position = |name: &str| ORDER.iter().position(|o| *o == name);
    let all = dependencies();
    assert!(all.len() >= 6, "{all:?}");
    for (name, dependency) in all.iter().filter(|(name, _)| name != "xtask") {
        let (Some(a), Some(b)) = (position(name), position(dependency)) else { panic!("{name} or {dependency} is not in ORDER") };
        assert!(b < a, "{name} depends on {dependency}");
    }
}

#[test]
fn the_program_does_not_link_the_lab() {
    let all = dependencies();
    let mut linked = BTreeSet::from(["tmpi"]);
    let mut count = 0;
    while count < linked.len() {
        count = linked.len();
        let next: Vec<&str> =
            all.iter().filter(|(name, _)| linked.contains(name.as_str())).map(|(_, dependency)| dependency.as_str()).collect();
        linked.extend(next);
    }
    assert!(linked.contains("tmpi-core") && linked.contains("tmpi-pipeline"), "{linked:?}");
    assert!(!linked.contains("tmpi-lab"), "{linked:?}");
}

#[test]
fn every_path_in_the_document_exists() {
    let page = std::fs::read_to_string(root().join("ARCHITECTURE.md")).unwrap();
    let named: Vec<&str> = page.split('`').skip(1).step_by(2).filter(|n| n.contains('/') && !n.contains(' ')).collect();
    assert!(named.len() > 20, "{named:?}");
    for name in named {
        assert!(root().join(name).exists(), "{name}");
    }
}

/// Source folders, and the largest import cycle allowed in each, in modules.
const CYCLES: [(&str, usize); 7] = [
    ("src", 3),
    ("crates/core/src", 4),
    ("crates/lab/src", 6),
    ("crates/library/src", 3),
    ("crates/live/src", 2),
    ("crates/pipeline/src", 2),
    ("crates/render/src", 2),
];

/// Path of a module or item from the crate root.
type Names = Vec<String>;

/// The source of each module of a crate.
#[derive(Default)]
struct Modules {
    sources: BTreeMap<Names, String>,
    /// Re-exported items, with the module that defines each.
    reexports: BTreeMap<Names, Names>,
}

impl Modules {
    fn read(root: &Path) -> Self {
        let mut modules = Self::default();
        for path in tmpi_testing::files_below(root).into_iter().filter(|path| path.extension().is_some_and(|e| e == "rs")) {
            let mut names: Names =
                path.with_extension("").strip_prefix(root).unwrap().iter().map(|n| n.to_str().unwrap().to_owned()).collect();
            names.pop_if(|last| ["mod", "lib", "main"].contains(&last.as_str()));
            let source = std::fs::read_to_string(&path).unwrap();
            let code: String = source.lines().map(|line| line.split("//").next().unwrap().to_owned() + "\n").collect();
            let code = code.split("#[cfg(test)]\nmod ").next().unwrap().to_owned();
            if !names.iter().any(|name| name == "tests") {
                modules.sources.insert(names, code);
            }
        }
        let sources = modules.sources.clone();
        for (names, source) in &sources {
            for (path, _) in use_declarations(source).into_iter().filter(|(_, is_public)| *is_public) {
                let module = modules.resolve(names, &path);
                if module.len() > names.len() && module.starts_with(names) {
                    modules.reexports.insert([&names[..], &path[path.len() - 1..]].concat(), module);
                }
            }
        }
        modules
    }

    /// The module that a path resolves to.
    fn resolve(&self, from: &[String], path: &[String]) -> Names {
        let mut at = from.to_vec();
        for name in path {
            match name.as_str() {
                "crate" => at.clear(),
                "self" => {}
                "super" => drop(at.pop()),
                _ => {
                    let below = [&at[..], std::slice::from_ref(name)].concat();
                    match self.reexports.get(&below) {
                        _ if self.sources.contains_key(&below) => at = below,
                        Some(module) => at.clone_from(module),
                        None => break,
                    }
                }
            }
        }
        at
    }

    /// The modules that each module imports, without its own submodules.
    fn imports<'a>(&'a self) -> BTreeMap<&'a Names, BTreeSet<Names>> {
        let of_module = |(names, source): (&'a Names, &String)| {
            let paths = use_declarations(source).into_iter().filter(|(_, is_public)| !is_public).map(|(path, _)| path);
            let all = paths.chain(inline_paths(source)).map(|path| self.resolve(names, &path));
            (names, all.filter(|other| !other.starts_with(names) && self.sources.contains_key(other)).collect())
        };
        self.sources.iter().map(of_module).collect()
    }

    /// The largest set of modules that import each other, directly or not.
    fn largest_cycle(&self) -> Vec<Names> {
        let imports = self.imports();
        let reached: BTreeMap<&Names, BTreeSet<&Names>> = imports.keys().map(|from| (*from, reachable(&imports, from))).collect();
        let cycle = |from: &&Names| reached[*from].iter().filter(|to| reached[**to].contains(from)).copied().cloned().collect::<Vec<_>>();
        reached.keys().map(cycle).max_by_key(Vec::len).unwrap_or_default()
    }
}

/// All modules that a module imports, directly or not.
fn reachable<'a>(imports: &'a BTreeMap<&Names, BTreeSet<Names>>, from: &'a Names) -> BTreeSet<&'a Names> {
    let (mut all, mut next) = (BTreeSet::new(), vec![from]);
    while let Some(module) = next.pop() {
        next.extend(imports[module].iter().filter(|to| all.insert(*to)));
    }
    all
}

/// Paths of the `use` declarations in a source, and whether each is public.
fn use_declarations(source: &str) -> Vec<(Names, bool)> {
    let mut all = Vec::new();
    for declaration in source.split(';') {
        let Some((before, tree)) = declaration.rsplit_once("use ") else { continue };
        let before = before.rsplit(['\n', '}', '{']).next().unwrap().trim();
        if before.is_empty() || before.starts_with("pub") {
            let mut paths = Vec::new();
            expand(&tree.split_whitespace().collect::<Vec<_>>().join(" "), &[], &mut paths);
            all.extend(paths.into_iter().map(|path| (path, before.starts_with("pub"))));
        }
    }
    all
}

/// Collects the paths of a `use` tree.
fn expand(tree: &str, above: &[String], paths: &mut Vec<Names>) {
    let (head, group) = tree.split_once('{').map_or((tree, None), |(head, rest)| (head, rest.rsplit_once('}').map(|(group, _)| group)));
    let names = head.split(" as ").next().unwrap().split("::").map(str::trim).filter(|name| !name.is_empty());
    let path: Names = above.iter().cloned().chain(names.map(str::to_owned)).collect();
    let Some(group) = group else { return paths.push(path) };
    let mut depth = 0;
    let is_end = |c: char| {
        depth += i32::from(c == '{') - i32::from(c == '}');
        c == ',' && depth == 0
    };
    group.split(is_end).filter(|part| !part.trim().is_empty()).for_each(|part| expand(part, &path, paths));
}

/// Paths in expressions, such as `super::problem::Problem`.
fn inline_paths(source: &str) -> Vec<Names> {
    let words = source.split(|c: char| !(c.is_alphanumeric() || c == '_' || c == ':'));
    // a path that ends with `::` starts a group
    let paths = words.filter(|word| (word.starts_with("crate::") || word.starts_with("super::")) && !word.ends_with("::"));
    paths.map(|path| path.split("::").map(str::to_owned).collect()).collect()
}

#[test]
fn import_cycles_between_modules_are_small() {
    for (folder, most) in CYCLES {
        let modules = Modules::read(&root().join(folder));
        let cycle = modules.largest_cycle();
        let paths: Vec<String> = cycle.iter().map(|names| names.join("/")).collect();
        assert!(cycle.len() <= most, "{folder}: {paths:?}");
    }
    let library = Modules::read(&root().join("crates/library/src"));
    assert!(library.imports().values().map(BTreeSet::len).sum::<usize>() > 50, "the test finds imports");
    assert!(!library.largest_cycle().is_empty());
}
