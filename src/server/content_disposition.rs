//! `Content-Disposition`: the file names of downloads.

use icu_properties::CodePointMapData;
use icu_properties::props::{GeneralCategory, GeneralCategoryGroup};
use percent_encoding::{AsciiSet, NON_ALPHANUMERIC, utf8_percent_encode};
use tmpi_library::Photo;

/// What a parameter of a header does not have as it is (RFC 8187).
const CODED: AsciiSet = NON_ALPHANUMERIC.remove(b'.').remove(b'_').remove(b'-');

/// `Content-Disposition` (RFC 6266) of a download: named by the photo's title, else by its id.
pub fn content_disposition(photo: &Photo, ending: &str) -> String {
    let id = photo.id.to_string();
    let stem = photo.title().map(stem).filter(|stem| !stem.is_empty());
    match stem {
        Some(stem) if stem.is_ascii() => format!("attachment; filename=\"{stem}.{ending}\""),
        // clients that know the second form prefer it, for letters of other scripts
        Some(stem) => format!("attachment; filename=\"{id}.{ending}\"; filename*=UTF-8''{}.{ending}", utf8_percent_encode(&stem, &CODED)),
        None => format!("attachment; filename=\"{id}.{ending}\""),
    }
}

/// A title as a file name: letters with their marks, digits, dots and `_`; all else becomes `-`.
fn stem(title: &str) -> String {
    let categories = CodePointMapData::<GeneralCategory>::new();
    let stays = |c: char| c.is_alphanumeric() || matches!(c, '.' | '_' | '-') || GeneralCategoryGroup::Mark.contains(categories.get(c));
    let kept = title.split(|c: char| !stays(c)).filter(|part| !part.is_empty());
    kept.collect::<Vec<_>>().join("-").trim_matches(['.', '-']).to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn titles_become_file_names() {
        for (title, name) in [
            ("By the lake", "By-the-lake"),
            ("a/b\\c\"d\r\n", "a-b-c-d"),
            ("..", ""),
            ("\u{1f300}", ""),
            ("Größe 3.5", "Größe-3.5"),
            // combining marks without a composed form
            ("हिन्दी १", "हिन्दी-१"),
            ("ภูเก็ต", "ภูเก็ต"),
            ("e\u{301}te\u{301}", "e\u{301}te\u{301}"),
        ] {
            assert_eq!(stem(title), name, "{title:?}");
        }
    }
}
