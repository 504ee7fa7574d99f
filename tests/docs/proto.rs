//! Pages that the comments of the schemas in `proto/` generate.

use std::fs;

use crate::{check_generated, root};

/// Rows of a message or an enumeration: names of fields, type, number, comment.
#[derive(Default)]
struct Section {
    name: String,
    comment: String,
    rows: Vec<[String; 4]>,
}

impl Section {
    fn add(&mut self, field: &str, kind: &str, number: &str, comment: &str) {
        match self.rows.last_mut() {
            // fields that share the comment of the first of them
            Some([names, same, numbers, _]) if comment.is_empty() && same == kind => {
                *names += &format!(", `{field}`");
                *numbers += &format!(", {number}");
            }
            _ => self.rows.push([format!("`{field}`"), kind.to_owned(), number.to_owned(), comment.to_owned()]),
        }
    }

    fn page(&self) -> String {
        let is_enum = self.rows.iter().all(|[_, kind, ..]| kind.is_empty());
        let head =
            if is_enum { "| value | number | what |\n|---|---|---|\n" } else { "| field | type | number | what |\n|---|---|---|---|\n" };
        let row = |[names, kind, number, comment]: &[String; 4]| {
            let cells = if is_enum { vec![names, number, comment] } else { vec![names, kind, number, comment] };
            format!("| {} |\n", cells.into_iter().map(|cell| cell.replace('|', "\\|")).collect::<Vec<_>>().join(" | "))
        };
        let comment = if self.comment.is_empty() { String::new() } else { format!("{}\n\n", self.comment) };
        format!("\n## {}\n\n{comment}{head}{}", self.name, self.rows.iter().map(row).collect::<String>())
    }
}

/// The head of a schema as Markdown, and its messages and enumerations.
fn read(schema: &str) -> (String, Vec<Section>) {
    let text = fs::read_to_string(root().join(schema)).unwrap();
    let (head, body) = text.split_once("syntax = ").unwrap();
    let head = head.lines().map(|line| line.trim_start_matches("//").strip_prefix(' ').unwrap_or_default());
    let head = head.map(|line| if line.starts_with("  ") { format!("    {}\n", line.trim()) } else { format!("{line}\n") }).collect();
    let (mut sections, mut open, mut comment): (Vec<Section>, Vec<usize>, String) = Default::default();
    for line in body.lines().skip(2).map(str::trim) {
        if let Some(words) = line.strip_prefix("//") {
            comment = format!("{comment} {}", words.trim()).trim().to_owned();
        } else if let Some(name) = line.strip_suffix(" {") {
            let (kind, name) = name.split_once(' ').unwrap();
            if kind == "oneof" {
                open.push(open[0]);
            } else {
                let outer = open.last().map_or_else(String::new, |&at| format!("{}.", sections[at].name));
                open.push(sections.len());
                sections.push(Section { name: outer + name, comment: std::mem::take(&mut comment), rows: Vec::new() });
            }
        } else if line == "}" {
            open.pop();
        } else if let Some((field, number)) = line.trim_end_matches(';').split_once(" = ") {
            let (kind, name) = field.rsplit_once(' ').unwrap_or(("", field));
            sections[*open.last().unwrap()].add(name, kind, number, &std::mem::take(&mut comment));
        }
    }
    (head, sections)
}

fn is_current(title: &str, schema: &str, page: &str) {
    let (head, sections) = read(schema);
    assert!(sections.len() >= 5 && sections.iter().all(|s| !s.rows.is_empty()), "{schema}");
    let about = format!("This page is generated from [`{schema}`](../../{schema}): `TMPI_BLESS=docs cargo test --test docs` writes it.");
    let sections: String = sections.iter().map(Section::page).collect();
    check_generated(page, &format!("# {title}\n\n{about}\n\n{}\n{sections}", head.trim_end()));
}

#[test]
fn the_container_reference_is_current() {
    is_current("Container format", "proto/tmpi.proto", "docs/reference/container.md");
}

#[test]
fn the_reference_of_live_messages_is_current() {
    is_current("Live messages", "proto/live.proto", "docs/reference/live-messages.md");
}
