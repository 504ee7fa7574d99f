//! Checks the documentation: links resolve, every page is in the table of contents, commands have valid options, blocks marked `<!--
//! runs -->` run, and generated pages are current.
#![allow(clippy::format_push_string, clippy::assigning_clones, clippy::format_collect, reason = "pages are short")]
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "test")]

mod api;
mod commands;
mod element;
mod proto;
mod settings;

use std::fs;
use std::path::{Path, PathBuf};

/// Checked pages outside `docs`.
const OTHERS: [&str; 6] =
    ["README.md", "ARCHITECTURE.md", "CONTRIBUTING.md", "docker/README.md", "training/README.md", "tests/load/README.md"];
/// Marks the next code block to run, in a folder with `photo.jpg`.
const RUNS: &str = "<!-- runs -->";
/// The same beside a server with data in `tmpi-data`, which has a photo `ID`.
const RUNS_WITH_SERVER: &str = "<!-- runs with a server -->";

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// A page of the documentation.
struct Page {
    /// Its path from the root of the repository.
    name: String,
    text: String,
}

/// A code block of a page.
struct Block {
    lines: Vec<String>,
    runs: bool,
    needs_server: bool,
}

fn pages() -> Vec<Page> {
    let of_book = tmpi_testing::files_below(&root().join("docs")).into_iter().filter(|path| path.extension().is_some_and(|e| e == "md"));
    let paths: Vec<PathBuf> = OTHERS.iter().map(|o| root().join(o)).chain(of_book).collect();
    let page = |path: PathBuf| Page {
        name: path.strip_prefix(root()).unwrap().to_string_lossy().into_owned(),
        text: fs::read_to_string(&path).unwrap(),
    };
    paths.into_iter().map(page).collect()
}

impl Page {
    /// Targets of `[text](target)`, without those in code.
    fn links(&self) -> Vec<&str> {
        let prose = self.text.lines().filter(|l| !l.starts_with("    "));
        prose.flat_map(|l| l.split("](").skip(1).filter_map(|rest| rest.split_once(')').map(|(target, _)| target))).collect()
    }

    /// Anchors of its headings, as forges make them.
    fn anchors(&self) -> Vec<String> {
        let headings = self.text.lines().filter(|l| l.starts_with('#')).map(|l| l.trim_start_matches('#').trim());
        let anchor = |heading: &str| {
            let kept = heading.to_lowercase().chars().filter(|c| c.is_alphanumeric() || " -_".contains(*c)).collect::<String>();
            kept.replace(' ', "-")
        };
        headings.map(anchor).collect()
    }

    /// Blocks that are indented by four spaces.
    fn blocks(&self) -> Vec<Block> {
        let mut blocks: Vec<Block> = Vec::new();
        let (mut is_open, mut mark) = (false, "");
        for line in self.text.lines() {
            if let Some(code) = line.strip_prefix("    ") {
                if !is_open {
                    let needs_server = mark == RUNS_WITH_SERVER;
                    blocks.push(Block { lines: Vec::new(), runs: needs_server || mark == RUNS, needs_server });
                    mark = "";
                }
                blocks.last_mut().unwrap().lines.push(code.to_owned());
                is_open = true;
            } else if !line.is_empty() {
                is_open = false;
                mark = line;
            }
        }
        blocks
    }
}

#[test]
fn internal_links_resolve() {
    let pages = pages();
    let mut count = 0;
    for page in &pages {
        let folder = root().join(&page.name).parent().unwrap().to_owned();
        for link in page.links().into_iter().filter(|l| !l.contains("://")) {
            count += 1;
            let (file, anchor) = link.split_once('#').unwrap_or((link, ""));
            let target = if file.is_empty() { root().join(&page.name) } else { folder.join(file) };
            assert!(target.exists(), "{}: {link}", page.name);
            let target = target.canonicalize().unwrap();
            let of_target = pages.iter().find(|p| root().join(&p.name).canonicalize().unwrap() == target);
            let is_there = anchor.is_empty() || of_target.is_some_and(|p| p.anchors().iter().any(|a| a == anchor));
            assert!(is_there, "{}: {link} names no heading", page.name);
        }
    }
    println!("{count} links were checked");
    assert!(count > 100, "{count} links were checked");
}

#[test]
fn every_page_is_in_the_table_of_contents() {
    let pages = pages();
    let summary = pages.iter().find(|p| p.name == "docs/SUMMARY.md").unwrap();
    let listed = summary.links();
    let of_book = pages.iter().filter_map(|p| p.name.strip_prefix("docs/")).filter(|n| *n != "SUMMARY.md");
    let missing: Vec<&str> = of_book.filter(|n| !listed.contains(n)).collect();
    assert!(missing.is_empty(), "{missing:?}");
}

/// Compares a generated page with the file, or writes it.
fn check_generated(name: &str, page: &str) {
    let path = root().join(name);
    if std::env::var("TMPI_BLESS").is_ok_and(|v| v == "docs") {
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(&path, page).unwrap();
    } else {
        let written = fs::read_to_string(&path).unwrap_or_default();
        assert!(written == page, "{name} is stale: TMPI_BLESS=docs cargo test --test docs writes it");
    }
}
