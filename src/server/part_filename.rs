//! The file name of a form part.

use axum::http::{HeaderMap, header};
use percent_encoding::percent_decode_str;

/// The name in a part's headers: `filename*` (RFC 8187) if it is readable, else `filename` as browsers write it.
#[must_use]
pub fn file_name(headers: &HeaderMap) -> Option<String> {
    let disposition = headers.get(header::CONTENT_DISPOSITION)?;
    name_of(std::str::from_utf8(disposition.as_bytes()).ok()?)
}

fn name_of(disposition: &str) -> Option<String> {
    let extended = parameter(disposition, "filename*").and_then(|value| decoded(&value));
    extended.or_else(|| parameter(disposition, "filename").map(|name| unescaped(&name)))
}

/// The value of a parameter, without its quotes.
fn parameter(header: &str, wanted: &str) -> Option<String> {
    let (_, mut rest) = header.split_once(';')?;
    loop {
        let (name, value) = rest.split_once('=')?;
        let value = value.trim_start();
        let (value, behind) = if let Some(quoted) = value.strip_prefix('"') {
            let mut ends = quoted.match_indices('"').map(|(at, _)| at);
            // a backslash is literal except before a quote: some clients send whole Windows paths
            let end = ends.find(|&at| !quoted[..at].ends_with('\\'))?;
            (quoted[..end].replace("\\\"", "\""), &quoted[end + 1..])
        } else {
            let end = value.find(';').unwrap_or(value.len());
            (value[..end].trim_end().to_owned(), &value[end..])
        };
        if name.trim().eq_ignore_ascii_case(wanted) {
            return Some(value);
        }
        rest = behind.split_once(';')?.1;
    }
}

/// A value of RFC 8187: character set, language, and bytes of which some are percent-encoded.
fn decoded(value: &str) -> Option<String> {
    let mut parts = value.splitn(3, '\'');
    let (charset, _language, text) = (parts.next()?, parts.next()?, parts.next()?);
    let bytes = percent_decode_str(text);
    if charset.eq_ignore_ascii_case("utf-8") {
        return Some(bytes.decode_utf8().ok()?.into_owned());
    }
    charset.eq_ignore_ascii_case("iso-8859-1").then(|| bytes.map(char::from).collect())
}

/// Decodes the three characters that browsers escape in a name (HTML, multipart/form-data encoding algorithm).
fn unescaped(name: &str) -> String {
    name.replace("%22", "\"").replace("%0D", "\r").replace("%0A", "\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_forms_of_file_names_are_read() {
        let name = |parameters: &str| name_of(&format!("form-data; {parameters}"));
        for (parameters, wanted) in [
            ("name=\"photo\"; filename=\"a b.jpg\"", Some("a b.jpg")),
            ("name=photo; filename=a.jpg; size=3", Some("a.jpg")),
            ("name=\"photo\"", None),
            ("filename=\"\"; name=\"photo\"", Some("")),
            // browsers, and text that is no escape
            ("filename=\"say %22cheese%22%0D%0A 100%.jpg\"", Some("say \"cheese\"\r\n 100%.jpg")),
            ("filename=\"50%25.jpg\"", Some("50%25.jpg")),
            // other programs
            (r#"filename="say \"cheese\".jpg"; name="photo""#, Some("say \"cheese\".jpg")),
            (r#"filename="C:\photos\a.jpg""#, Some(r"C:\photos\a.jpg")),
            ("FILENAME = \"a.jpg\"", Some("a.jpg")),
            // the extended one wins, at any position, unless it is inside a quoted text
            ("filename*=UTF-8''S%C3%B6hne%20am%20Meer.jpg; filename=\"So_hne.jpg\"", Some("Söhne am Meer.jpg")),
            ("filename=\"So_hne.jpg\"; filename*=utf-8'de'S%C3%B6hne.jpg", Some("Söhne.jpg")),
            ("filename*=ISO-8859-1'en'S%F6hne.jpg", Some("Söhne.jpg")),
            ("filename=\"a; filename*=UTF-8''b.jpg\"", Some("a; filename*=UTF-8''b.jpg")),
            // an unreadable one is ignored
            ("filename*=UTF-8''%FF.jpg; filename=\"a.jpg\"", Some("a.jpg")),
            ("filename*=KOI8-R''a.jpg; filename=\"b.jpg\"", Some("b.jpg")),
            ("filename*=plain.jpg; filename=\"b.jpg\"", Some("b.jpg")),
            ("filename=\"never closed", None),
        ] {
            assert_eq!(name(parameters).as_deref(), wanted, "{parameters}");
        }
        assert_eq!(name_of("form-data"), None);
    }
}
