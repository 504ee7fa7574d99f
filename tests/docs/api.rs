//! Pages that the `OpenAPI` document generates: routes, and the report.

use serde_json::Value;

use crate::check_generated;

const ABOUT: &str = "`TMPI_BLESS=docs cargo test --test docs` writes it.";

fn document() -> Value {
    serde_json::from_slice(&tmpi::server::openapi().unwrap()).unwrap()
}

/// Text for a cell of a table.
fn cell(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ").replace('|', "\\|")
}

/// The names of schemas that a schema refers to, or of its JSON types, without null.
fn kinds(schema: &Value) -> Vec<String> {
    if schema["format"] == "binary" {
        return vec!["file".to_owned()];
    }
    if let Some(name) = schema["$ref"].as_str() {
        return vec![name.rsplit('/').next().unwrap().to_owned()];
    }
    for several in ["oneOf", "allOf", "anyOf"] {
        if let Some(all) = schema[several].as_array() {
            return all.iter().flat_map(kinds).collect();
        }
    }
    let types = schema["type"].as_array().cloned().unwrap_or_else(|| vec![schema["type"].clone()]);
    let types: Vec<String> = types.iter().filter_map(Value::as_str).filter(|t| *t != "null").map(str::to_owned).collect();
    match types.first().map(String::as_str) {
        Some("array") => kinds(&schema["items"]).into_iter().map(|kind| format!("list of {kind}")).collect(),
        _ => types,
    }
}

/// The type of a field or parameter, with its allowed values.
fn kind(schema: &Value) -> String {
    if let Some(words) = schema["enum"].as_array() {
        return words.iter().filter_map(Value::as_str).map(|w| format!("`{w}`")).collect::<Vec<_>>().join(", ");
    }
    let number = |name: &str| schema[name].as_f64().map(|n| n.to_string());
    let range = match (number("minimum"), number("maximum")) {
        (Some(least), Some(most)) => format!(", {least} to {most}"),
        _ => String::new(),
    };
    kinds(schema).join(" or ") + &range
}

/// The description of a field: its own, or that of its only alternative.
fn described(field: &Value) -> String {
    let own = field["description"].as_str();
    let of_others = || field["oneOf"].as_array()?.iter().find_map(|one| one["description"].as_str());
    cell(own.or_else(of_others).unwrap_or_default())
}

/// Rows for the fields of a schema.
fn fields(schema: &Value, link: impl Fn(&str) -> String) -> String {
    let row = |(name, field): (&String, &Value)| format!("| `{name}` | {} | {} |\n", link(&kind(field)), described(field));
    schema["properties"].as_object().unwrap().iter().map(row).collect()
}

/// Adds a schema of the report, and those that it refers to.
fn add_schema(document: &Value, name: &str, done: &mut Vec<String>, page: &mut String) {
    let schemas = &document["components"]["schemas"];
    let schema = &schemas[name];
    let linked = |kind: &str| if schemas[kind].is_object() { format!("[{kind}](#{})", kind.to_lowercase()) } else { kind.to_owned() };
    let rows = fields(schema, |kinds| kinds.split(' ').map(linked).collect::<Vec<_>>().join(" "));
    *page += &format!("\n## {name}\n\n{}\n\n| field | type | what |\n|---|---|---|\n{rows}", described(schema));
    done.push(name.to_owned());
    for field in schema["properties"].as_object().unwrap().values() {
        for below in kinds(field).iter().map(|k| k.trim_start_matches("list of ")) {
            if schemas[below].is_object() && !done.iter().any(|d| d == below) {
                add_schema(document, below, done, page);
            }
        }
    }
}

#[test]
fn the_report_reference_is_current() {
    let mut page = format!(
        "# Report reference\n\nThis page is generated: {ABOUT}\n\n`tmpi make --report FILE` and `GET /v1/photos/{{id}}/report` give the report of a photo as JSON. \
         Fields of approximations that were not applied are `null`.\n"
    );
    add_schema(&document(), "Report", &mut Vec::new(), &mut page);
    check_generated("docs/reference/report.md", &page);
}

/// A route with its parameters, the fields of its form, and its answers.
fn route(document: &Value, method: &str, path: &str, operation: &Value) -> String {
    let mut text = format!("\n### {} {path}\n\n{}\n", method.to_uppercase(), cell(operation["summary"].as_str().unwrap()));
    if let Some(more) = operation["description"].as_str() {
        text += &format!("\n{}\n", cell(more));
    }
    let parameter = |p: &Value| {
        format!("| `{}` | {} | {} | {} |\n", p["name"].as_str().unwrap(), p["in"].as_str().unwrap(), kind(&p["schema"]), described(p))
    };
    let parameters: String =
        operation["parameters"].as_array().into_iter().flatten().filter(|p| p["in"] != "path").map(parameter).collect();
    if !parameters.is_empty() {
        text += &format!("\n| parameter | in | type | what |\n|---|---|---|---|\n{parameters}");
    }
    let bodies = operation["requestBody"]["content"].as_object().into_iter().flatten();
    let named = |(media, body): (&String, &Value)| Some((media.clone(), body["schema"]["$ref"].as_str()?.rsplit('/').next()?.to_owned()));
    let mut shown = Vec::new();
    for (media, name) in bodies.filter_map(named) {
        if !shown.contains(&name) {
            let rows = fields(&document["components"]["schemas"][&name], str::to_owned);
            text += &format!("\n| field of `{media}` | type | what |\n|---|---|---|\n{rows}");
            shown.push(name);
        }
    }
    let answer = |(status, answer): (&String, &Value)| format!("| {status} | {} |\n", described(answer));
    let answers: String = operation["responses"].as_object().unwrap().iter().map(answer).collect();
    text + &format!("\n| status | when |\n|---|---|\n{answers}")
}

#[test]
fn the_http_reference_is_current() {
    let document = document();
    let mut page = format!(
        "# HTTP reference\n\nThis page is generated from `/openapi.json`, which also has the fields of all answers: {ABOUT}\n\n{}\n",
        cell(document["info"]["description"].as_str().unwrap())
    );
    for tag in document["tags"].as_array().unwrap() {
        page += &format!("\n## {}\n\n{}.\n", tag["name"].as_str().unwrap(), described(tag));
        for (path, item) in document["paths"].as_object().unwrap() {
            let operations = item.as_object().unwrap().iter().filter(|(_, operation)| operation["tags"][0] == tag["name"]);
            page.extend(operations.map(|(method, operation)| route(&document, method, path, operation)));
        }
    }
    check_generated("docs/reference/http.md", &page);
}
