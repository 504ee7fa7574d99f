//! Pairs the photos of a folder with the depth maps beside them by name, by the rules of the upload page (`static/app/depth-pairs.js`).

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};

use super::files::extension;

/// Suffixes of a depth map's name, after a separator and without the extension.
const ENDS: [&str; 10] = ["depth", "depth-", "depth_", "depth ", "depthmap", "depth-map", "depth_map", "depth map", "disparity", "disp"];
/// Extensions of depth maps that are never photos.
pub(super) const MAPS: [&str; 2] = ["pfm", "exr"];
const SEPARATORS: [char; 4] = ['-', '_', '.', ' '];

/// The file name without its last extension, in lower case.
fn stem(path: &Path) -> String {
    let name = path.file_name().unwrap_or_default().to_string_lossy().to_lowercase();
    name.rsplit_once('.').map_or(name.as_str(), |(stem, _)| stem).to_owned()
}

/// Whether a file is named as the depth map of some photo.
pub(super) fn is_named_as_map(file: &Path) -> bool {
    photo_of(&stem(file)).is_some()
}

/// The name of the photo to which a depth map of this name would belong.
fn photo_of(map: &str) -> Option<&str> {
    let before = |end: &&str| map.strip_suffix(*end)?.strip_suffix(SEPARATORS).filter(|photo| !photo.is_empty());
    ENDS.iter().filter_map(before).max_by_key(|photo| photo.len())
}

/// Each photo with its map, in the order of the photos. A map belongs to the first photo of that name in its folder. If a photo has several
/// maps, the first is used, pictures before [`MAPS`], and the others are dropped. A map without a photo counts as a photo.
pub(super) fn pairs(files: Vec<PathBuf>) -> Vec<(PathBuf, Option<PathBuf>)> {
    let mut named: HashMap<(PathBuf, String), usize> = HashMap::new();
    let folder = |file: &Path| file.parent().unwrap_or(Path::new("")).to_owned();
    let (never_photos, pictures): (Vec<_>, Vec<_>) = files.iter().enumerate().partition(|(_, file)| MAPS.contains(&&*extension(file)));
    for (i, file) in &pictures {
        named.entry((folder(file), stem(file))).or_insert(*i);
    }
    let (mut maps, mut depths) = (HashSet::new(), HashMap::new());
    for (i, file) in pictures.into_iter().chain(never_photos) {
        let stem = stem(file);
        let photo = photo_of(&stem).and_then(|photo| named.get(&(folder(file), photo.to_owned())));
        if let Some(photo) = photo {
            maps.insert(i);
            depths.entry(*photo).or_insert_with(|| file.clone());
        }
    }
    let photos = files.into_iter().enumerate().filter(|(i, _)| !maps.contains(i));
    photos.map(|(i, photo)| (photo, depths.remove(&i))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn named(files: &[&str]) -> Vec<(String, Option<String>)> {
        let text = |path: PathBuf| path.to_string_lossy().into_owned();
        pairs(files.iter().map(PathBuf::from).collect()).into_iter().map(|(photo, map)| (text(photo), map.map(text))).collect()
    }

    fn wanted(all: &[(&str, Option<&str>)]) -> Vec<(String, Option<String>)> {
        all.iter().map(|(photo, map)| ((*photo).to_owned(), map.map(str::to_owned))).collect()
    }

    #[test]
    fn a_map_goes_with_its_photo_in_any_order_and_with_any_extension() {
        assert_eq!(named(&["a_depth.png", "a.jpg", "b.jpg"]), wanted(&[("a.jpg", Some("a_depth.png")), ("b.jpg", None)]));
        for map in ["A-Depth.jpg", "a.depthmap.webp", "a_depth_map.png", "a disparity.png", "a_disp.png", "a.depth .png", "a_depth-.png"] {
            assert_eq!(named(&["a.jpg", map]), wanted(&[("a.jpg", Some(map))]), "{map}");
        }
        // the first of several photos with the same name
        assert_eq!(named(&["a.jpg", "a.png", "a_depth.png"]), wanted(&[("a.jpg", Some("a_depth.png")), ("a.png", None)]));
    }

    #[test]
    fn a_depth_name_without_its_photo_is_a_photo() {
        for file in ["depth.png", "in-depth.jpg", "_depth.png", "adepth.png", "b_depths.png"] {
            assert_eq!(named(&[file, "a.jpg"]), wanted(&[(file, None), ("a.jpg", None)]), "{file}");
        }
        // a rendered picture beside its file of passes
        let render = named(&["render.exr", "render.png", "render_depth.exr"]);
        assert_eq!(render, wanted(&[("render.exr", None), ("render.png", Some("render_depth.exr"))]));
        assert_eq!(named(&["a.jpg", "a_depth.exr", "a_depth.png"]), wanted(&[("a.jpg", Some("a_depth.png"))]));
        // a second map of a photo does not count as a photo
        assert_eq!(named(&["a.jpg", "a_depth.png", "a-depth.png"]), wanted(&[("a.jpg", Some("a_depth.png"))]));
    }

    #[test]
    fn a_map_goes_with_a_photo_of_its_own_folder() {
        assert_eq!(
            named(&["x/a.jpg", "x/a_depth.png", "y/a.jpg", "y/a_depth.png"]),
            wanted(&[("x/a.jpg", Some("x/a_depth.png")), ("y/a.jpg", Some("y/a_depth.png"))])
        );
        assert_eq!(named(&["x/a.jpg", "y/a_depth.png"]), wanted(&[("x/a.jpg", None), ("y/a_depth.png", None)]));
    }
}
