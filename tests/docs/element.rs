//! The page of `<tmpi-viewer>`, which its TypeScript declarations generate.

use std::fs;

use crate::{check_generated, root};

const DECLARATIONS: &str = "npm/tmpi-viewer.d.ts";
const HEAD: &str = "# Element reference

This page is generated from [`npm/tmpi-viewer.d.ts`](../../npm/tmpi-viewer.d.ts): `TMPI_BLESS=docs cargo test --test docs` writes it.
[Embedding](../guides/embedding.md) explains how to use the element, its slots and its CSS parts.
";

/// Members of an interface: their comments, joined, and declarations.
fn members(text: &str, interface: &str) -> Vec<(String, String)> {
    let (_, body) = text.split_once(&format!("export interface {interface} ")).unwrap();
    let body = body.split_once("{\n").unwrap().1.split("\n}").next().unwrap();
    let (mut found, mut comment) = (Vec::new(), String::new());
    for line in body.lines().filter(|l| l.starts_with("  ") && !l.starts_with("    ")).map(str::trim) {
        let words = line.trim_start_matches("/**").trim_end_matches("*/").trim_start_matches('*').trim();
        if line.starts_with('*') || line.starts_with("/*") {
            comment = format!("{comment} {words}").trim().to_owned();
        } else if !comment.is_empty() {
            found.push((std::mem::take(&mut comment), line.trim_end_matches(';').to_owned()));
        }
    }
    found
}

/// The attribute of a property: `auto-rotate` of `autoRotate`.
fn attribute(property: &str) -> String {
    property.chars().map(|c| if c.is_ascii_uppercase() { format!("-{}", c.to_ascii_lowercase()) } else { c.to_string() }).collect()
}

fn table(head: &str, rows: &[[String; 3]]) -> String {
    let cell = |text: &String| text.replace('|', "\\|");
    let rows: String = rows.iter().map(|row| format!("| {} |\n", row.iter().map(cell).collect::<Vec<_>>().join(" | "))).collect();
    format!("{head}\n|---|---|---|\n{rows}")
}

#[test]
fn the_element_reference_is_current() {
    let text = fs::read_to_string(root().join(DECLARATIONS)).unwrap();
    let (mut attributes, mut others) = (Vec::new(), Vec::new());
    for (comment, declaration) in members(&text, "TmpiViewerElement") {
        if let Some((name, kind)) = declaration.strip_prefix("get ").and_then(|d| d.split_once("(): ")) {
            attributes.push([format!("`{}`", attribute(name)), format!("`{name}`: {kind}"), comment]);
        } else {
            let (name, kind) = declaration.trim_start_matches("readonly ").rsplit_once(": ").unwrap();
            others.push([format!("`{name}`"), format!("`{kind}`"), comment]);
        }
    }
    let event = |(comment, declaration): (String, String)| {
        let (name, detail) = declaration.split_once(": ").unwrap();
        [format!("`{}`", name.trim_matches('\'')), format!("`{detail}`"), comment]
    };
    let events: Vec<_> = members(&text, "TmpiViewerEvents").into_iter().map(event).collect();
    let statistics: Vec<_> = members(&text, "RoomStatistics").into_iter().map(event).collect();
    let element = fs::read_to_string(root().join("static/element/tmpi-viewer.js")).unwrap();
    let head: Vec<&str> = element.lines().take_while(|line| line.starts_with("//")).collect();
    for [name, ..] in attributes.iter().chain(&events) {
        assert!(head.iter().any(|line| line.contains(name.trim_matches('`'))), "{name} is missing at the head of the element");
    }
    let page = [
        HEAD,
        "\n## Attributes\n\nEach attribute is also a property. `off` and `false` turn a boolean off.\n\n",
        &table("| attribute | property | what |", &attributes),
        "\n## Other properties and methods\n\n",
        &table("| name | type | what |", &others),
        "\n## Events\n\n",
        &table("| event | `detail` | what |", &events),
        "\n## Statistics of a room\n\n",
        &table("| field | type | what |", &statistics),
    ];
    check_generated("docs/reference/element.md", &page.concat());
}
