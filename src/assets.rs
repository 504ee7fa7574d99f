//! The web pages and scripts, embedded in the program.

use std::path::Path;

/// All files below `static/` by name, sorted.
pub static FILES: &[(&str, &[u8])] = include!(concat!(env!("OUT_DIR"), "/pages.rs"));

/// The contents of a file below `static/`.
pub fn file(name: &str) -> Option<&'static [u8]> {
    FILES.binary_search_by_key(&name, |f| f.0).ok().map(|at| FILES[at].1)
}

/// Media type of a file, by its extension.
pub fn content_type(name: &str) -> &'static str {
    match Path::new(name).extension().and_then(|e| e.to_str()).unwrap_or_default() {
        "html" => "text/html; charset=utf-8",
        "js" | "mjs" => "text/javascript; charset=utf-8",
        "css" => "text/css; charset=utf-8",
        "json" | "map" => "application/json",
        "svg" => "image/svg+xml",
        "png" => "image/png",
        "jpg" | "jpeg" => "image/jpeg",
        "webp" => "image/webp",
        "ico" => "image/x-icon",
        "wasm" => "application/wasm",
        "woff2" => "font/woff2",
        "tmpi" => tmpi_core::container::MEDIA_TYPE,
        "wgsl" | "txt" | "md" => "text/plain; charset=utf-8",
        _ => "application/octet-stream",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_is_sorted_and_holds_the_shader() {
        assert!(FILES.is_sorted_by(|a, b| a.0 < b.0));
        assert!(file("draw/tmpi.wgsl").is_some_and(|f| !f.is_empty()));
        assert!(file("nothing").is_none());
    }
}
