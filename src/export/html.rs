//! Exports a self-contained page with viewer and photo. It opens from disk and makes no requests.

use std::fmt::Write as _;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use sha2::{Digest, Sha256};

use super::script::{self, Linked};
use super::{ExportError, photo_file};
use crate::assets;

/// Template of the page; `{{…}}` are placeholders.
const PAGE: &str = include_str!("page.html");
const STYLE: &str = include_str!("page.css");
const LOADER: &str = include_str!("module-loader.js");
/// Entry module, with paths relative to the top of the viewer's folders.
const ENTRY: &str = include_str!("page.js");
const ENTRY_NAME: &str = "page.js";

/// Writes a page with this title that shows the scene of `container`.
///
/// The page contains the container once, in three pieces. The middle piece is the photo, which browsers without scripts display as a
/// picture.
///
/// # Errors
/// [`ExportError::Atlas`] if the container is invalid.
pub fn html(container: &[u8], title: &str) -> Result<Vec<u8>, ExportError> {
    let photo = photo_file(container)?;
    let script = script();
    let hash = |text: &str| format!("'sha256-{}'", STANDARD.encode(Sha256::digest(text)));
    // forbids everything outside this page; allows only the page's own script and its worker
    let policy = format!(
        "default-src 'none'; script-src {} data: blob: 'wasm-unsafe-eval'; worker-src data: blob:; connect-src data: blob:; img-src data: blob:; style-src {}; \
         base-uri 'none'; form-action 'none'",
        hash(&script),
        hash(STYLE),
    );
    let (title, version) = (escaped(title), env!("CARGO_PKG_VERSION"));
    let source = format!("data:{};base64,{}", photo.media_type, STANDARD.encode(photo.bytes));
    let (before, after) = (STANDARD.encode(&container[..photo.range.start]), STANDARD.encode(&container[photo.range.end..]));
    let mut out = String::with_capacity(PAGE.len() + 8 * STYLE.len() + script.len() + container.len() / 3 * 4 + 1024);
    let mut rest = PAGE;
    while let Some((text, tail)) = rest.split_once("{{") {
        out.push_str(text);
        let (name, tail) = tail.split_once("}}").unwrap_or((tail, ""));
        out.push_str(match name {
            "policy" => &policy,
            "title" => &title,
            "version" => version,
            "style" => STYLE,
            "photo" => &source,
            "before" => &before,
            "after" => &after,
            "script" => &script,
            _ => "",
        });
        rest = tail;
    }
    out.push_str(rest);
    Ok(out.into_bytes())
}

fn linked() -> Linked {
    script::link(ENTRY_NAME, &|name| if name == ENTRY_NAME { Some(ENTRY.as_bytes()) } else { assets::file(name) })
}

/// The viewer, linked into one script.
fn script() -> String {
    let linked = linked();
    let mut text = format!("{}\nstart({{\n", LOADER.trim_end());
    for (name, module) in &linked.modules {
        // writing to a string cannot fail
        let _ = writeln!(text, "{name:?}: {module},");
    }
    text.push_str("}, {\n");
    for (name, bytes) in &linked.assets {
        let media_type = assets::content_type(name).replace(' ', "");
        let _ = writeln!(text, "{name:?}: \"data:{media_type};base64,{}\",", STANDARD.encode(bytes));
    }
    let _ = writeln!(text, "}}, {ENTRY_NAME:?});");
    // these sequences would end the script element anywhere; in strings, templates and patterns the backslash has no effect
    text.replace("</script", "<\\/script").replace("<!--", "<\\!--")
}

/// Escapes text for elements and attributes.
pub fn escaped(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\'' => out.push_str("&#39;"),
            c if c.is_control() => out.push(' '),
            c => out.push(c),
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::super::testing;
    use super::*;

    fn between<'a>(text: &'a str, from: &str, to: &str) -> &'a str {
        text.split_once(from).and_then(|(_, rest)| rest.split_once(to)).map_or_else(|| panic!("{from} … {to}"), |(inner, _)| inner)
    }

    #[test]
    fn the_page_contains_the_container_once() {
        let (container, _) = testing::sample();
        let page = String::from_utf8(html(container, "a").unwrap()).unwrap();
        let photo = between(&page, "src=\"data:image/jpeg;base64,", "\"");
        let pieces = [between(&page, "id=\"before\">", "<"), photo, between(&page, "id=\"after\">", "<")];
        let joined: Vec<u8> = pieces.iter().flat_map(|p| STANDARD.decode(p).unwrap()).collect();
        assert!(joined == *container);
        assert_eq!(page.matches(&photo[..64]).count(), 1);
    }

    #[test]
    fn the_page_refers_to_no_other_files() {
        let page = String::from_utf8(html(&testing::sample().0, "a").unwrap()).unwrap();
        for word in ["src=\"", "href=\"", "url(", "@import"] {
            for (_, rest) in page.match_indices(word).map(|(at, w)| page.split_at(at + w.len())) {
                assert!(rest.starts_with("data:"), "{word}{}", &rest[..40]);
            }
        }
        for (at, _) in PAGE.match_indices("{{") {
            let end = PAGE[at..].find("}}").unwrap();
            assert!(!page.contains(&PAGE[at..at + end + 2]));
        }
        assert!(page.contains("default-src 'none'"));
        assert_eq!(page.matches("<script").count(), page.matches("</script").count());
    }

    #[test]
    fn the_viewer_follows_the_conventions_of_the_linker() {
        let linked = linked();
        assert!(linked.modules.len() > 20 && linked.assets.len() > 2);
        for (name, text) in &linked.modules {
            assert!(name == ENTRY_NAME || assets::file(name).is_some(), "{name} is missing");
            let unconverted = ["import", "export"].iter().any(|word| text.lines().any(|line| line.starts_with(word)));
            assert!(!unconverted && !text.contains("import.meta"), "{name} has another form of import or export");
            let mut imports = text.lines().filter(|line| line.contains(" = $use("));
            assert!(imports.all(|line| line.starts_with("const {")), "{name} has an import without names");
        }
        for (name, bytes) in &linked.assets {
            assert!(!bytes.is_empty(), "{name} is missing");
        }
    }

    #[test]
    fn titles_are_escaped() {
        let page = String::from_utf8(html(&testing::sample().0, "</title><script>'\"&{{script}}").unwrap()).unwrap();
        assert!(page.contains("<title>&lt;/title&gt;&lt;script&gt;&#39;&quot;&amp;{{script}}</title>"));
    }
}
