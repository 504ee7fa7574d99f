//! The photos that a command works on, and the output file of each.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use anyhow::Context;

use super::Usage;
use super::depth_pairs::{MAPS, pairs};
use super::files::extension;

/// Extensions of the files in a folder that count as photos.
const PHOTOS: [&str; 5] = ["jpg", "jpeg", "png", "webp", "mpo"];
/// Extensions of images that are not supported. The program reports how many it skips.
const OTHERS: [&str; 9] = ["heic", "heif", "avif", "gif", "tif", "tiff", "bmp", "jxl", "dng"];
const CONTAINER: &str = "tmpi";

#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Item {
    pub photo: PathBuf,
    pub output: PathBuf,
    /// The depth map beside it, if the photo was found in a folder.
    pub depth: Option<PathBuf>,
    /// The photo was found in a folder, not named by the user.
    found: bool,
}

#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Batch {
    pub items: Vec<Item>,
    pub folder: bool,
    /// What is left out of folders and why, a line each.
    pub left_out: Vec<String>,
}

impl Batch {
    /// Collects the photos of `named` and their outputs. `named` holds files, and folders, which are searched recursively; depth maps there
    /// go with their photos. `output` is a file, or a folder that mirrors the structure of the input folders.
    ///
    /// # Errors
    /// [`Usage`] if `output` has the wrong kind, two photos have the same output, or an output would overwrite a photo; another error if a
    /// folder cannot be read or holds no photo.
    pub fn of(named: &[PathBuf], output: &Path) -> anyhow::Result<Self> {
        let text = output.as_os_str().to_string_lossy();
        let slash = text.ends_with(['/', std::path::MAIN_SEPARATOR]);
        let several = named.len() > 1 || named.iter().any(|p| p.is_dir());
        let ending = extension(output);
        if !several && !slash && !output.is_dir() {
            if ending != CONTAINER {
                let advice = format!("write {} for a container, or {text}/ for a folder", output.with_extension(CONTAINER).display());
                return Err(Usage(format!("--output {text} must end in .{CONTAINER}: {advice}")).into());
            }
            let item = Item { photo: named.first().cloned().unwrap_or_default(), output: output.to_owned(), depth: None, found: false };
            return Ok(Self { items: checked(vec![item])?, ..Self::default() });
        }
        check_folder(output)?;
        let mut all = Self { folder: true, ..Self::default() };
        for path in named {
            if path.is_dir() {
                let Self { items, left_out, .. } = found(path, output)?;
                anyhow::ensure!(!items.is_empty(), "{} holds no JPEG, PNG, WebP or MPO photo", path.display());
                all.items.extend(items);
                all.left_out.extend(left_out);
            } else {
                let stem = path.file_stem().unwrap_or_default();
                let output = output.join(stem).with_added_extension(CONTAINER);
                all.items.push(Item { photo: path.clone(), output, depth: None, found: false });
            }
        }
        all.items = checked(apart(all.items))?;
        Ok(all)
    }

    /// Collects the photos of one folder, which may have none.
    ///
    /// # Errors
    /// Those of [`Batch::of`] that are not about the kind of `output`.
    pub fn of_folder(folder: &Path, output: &Path) -> anyhow::Result<Self> {
        let all = found(folder, output)?;
        Ok(Self { items: checked(apart(all.items))?, ..all })
    }
}

/// The photos of a folder with the depth maps beside them.
fn found(folder: &Path, output: &Path) -> anyhow::Result<Batch> {
    let mut others = BTreeMap::new();
    let photos = below(folder, &mut others)?;
    let name = folder.display();
    let left = |(ending, n): (&String, &usize)| format!("{name}: {n} .{ending} left out, only JPEG, PNG, WebP and MPO are read");
    let mut all = Batch { left_out: others.iter().map(left).collect(), folder: true, ..Batch::default() };
    for (photo, depth) in pairs(photos) {
        if MAPS.contains(&extension(&photo).as_str()) {
            all.left_out.push(format!("{}: left out, there is no photo of its name", photo.display()));
            continue;
        }
        let place = photo.strip_prefix(folder).unwrap_or(&photo).with_extension("");
        all.items.push(Item { output: output.join(place).with_added_extension(CONTAINER), photo, depth, found: true });
    }
    Ok(all)
}

/// Checks that the output of several photos is a folder, or can become one.
///
/// # Errors
/// [`Usage`] if it is or looks like a file.
pub(super) fn check_folder(output: &Path) -> Result<(), Usage> {
    let text = output.display().to_string();
    let ending = extension(output);
    if output.is_file() {
        return Err(Usage(format!("--output {text} must be a folder for several photos; it is a file")));
    }
    let slash = text.ends_with(['/', std::path::MAIN_SEPARATOR]);
    if !slash && !output.is_dir() && (ending == CONTAINER || PHOTOS.contains(&ending.as_str())) {
        return Err(Usage(format!("--output {text} must be a folder for several photos; write {text}/ if that is its name")));
    }
    Ok(())
}

/// Photos of a folder whose names differ only in their extension keep it: `a.jpg.tmpi`, `a.png.tmpi`.
fn apart(mut items: Vec<Item>) -> Vec<Item> {
    let mut count: BTreeMap<PathBuf, usize> = BTreeMap::new();
    for item in &items {
        *count.entry(item.output.clone()).or_default() += 1;
    }
    for item in items.iter_mut().filter(|i| i.found) {
        if count.get(&item.output).is_some_and(|&n| n > 1) {
            let name = item.photo.file_name().unwrap_or_default();
            item.output = item.output.with_file_name(name).with_added_extension(CONTAINER);
        }
    }
    items
}

/// Checks that no two items share an output and that no output is a photo.
fn checked(items: Vec<Item>) -> Result<Vec<Item>, Usage> {
    let photos: BTreeSet<&Path> = items.iter().map(|i| i.photo.as_path()).collect();
    let mut taken: BTreeMap<&Path, &Path> = BTreeMap::new();
    for Item { photo, output, .. } in &items {
        if let Some(other) = taken.insert(output, photo) {
            return Err(Usage(format!("{} and {} would both be written to {}", other.display(), photo.display(), output.display())));
        }
        if photos.contains(output.as_path()) {
            return Err(Usage(format!("{} is a photo and would be overwritten", output.display())));
        }
    }
    Ok(items)
}

/// Photos in a folder and its subfolders, sorted by name. Hidden entries and links to folders are skipped. `others` counts unsupported
/// images by extension.
fn below(folder: &Path, others: &mut BTreeMap<String, usize>) -> anyhow::Result<Vec<PathBuf>> {
    let context = || format!("reading {}", folder.display());
    let listing = std::fs::read_dir(folder).with_context(context)?;
    let mut entries = listing.collect::<Result<Vec<_>, _>>().with_context(context)?;
    entries.sort_by_key(std::fs::DirEntry::file_name);
    let mut photos = Vec::new();
    for entry in entries {
        if entry.file_name().as_encoded_bytes().starts_with(b".") {
            continue;
        }
        let path = entry.path();
        if entry.file_type().with_context(context)?.is_dir() {
            photos.extend(below(&path, others)?);
            continue;
        }
        let ending = extension(&path);
        if (PHOTOS.contains(&ending.as_str()) || MAPS.contains(&ending.as_str())) && path.is_file() {
            photos.push(path);
        } else if OTHERS.contains(&ending.as_str()) {
            *others.entry(ending).or_default() += 1;
        }
    }
    Ok(photos)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn paths(names: &[&str]) -> Vec<PathBuf> {
        names.iter().map(PathBuf::from).collect()
    }

    fn outputs(photos: &[&str], output: &str) -> anyhow::Result<Vec<PathBuf>> {
        Ok(Batch::of(&paths(photos), Path::new(output))?.items.into_iter().map(|i| i.output).collect())
    }

    fn refused(photos: &[&str], output: &str) -> String {
        outputs(photos, output).unwrap_err().downcast::<Usage>().unwrap().to_string()
    }

    #[test]
    fn one_photo_to_a_file_several_to_a_folder() {
        assert_eq!(outputs(&["a.jpg"], "x.tmpi").unwrap(), paths(&["x.tmpi"]));
        assert_eq!(outputs(&["in/a.b.jpg", "c.png"], "out").unwrap(), paths(&["out/a.b.tmpi", "out/c.tmpi"]));
        assert_eq!(outputs(&["a.jpg"], "new/").unwrap(), paths(&["new/a.tmpi"]));
    }

    #[test]
    fn outputs_that_collide_or_overwrite_are_refused() {
        assert!(refused(&["a/x.jpg", "b/x.png"], "out").contains("out/x.tmpi"));
        assert!(refused(&["a.tmpi"], "a.tmpi").contains("overwritten"));
        assert!(refused(&["a.jpg", "b.jpg"], "Cargo.toml").contains("folder"));
    }

    #[test]
    fn a_wrong_extension_is_refused_with_the_right_one() {
        assert!(refused(&["a.jpg"], "out.jpg").contains("out.tmpi"));
        assert!(refused(&["a.jpg"], "out").contains("out/"));
        assert!(refused(&["a.jpg", "b.jpg"], "all.tmpi").contains("folder"));
        assert!(outputs(&["a.jpg"], "OUT.TMPI").is_ok());
    }

    #[test]
    fn a_folder_stands_for_all_photos_below_it_and_keeps_its_structure() {
        let place = tempfile::tempdir().unwrap();
        let root = place.path().join("photos");
        std::fs::create_dir_all(root.join("2020/.cache")).unwrap();
        for name in [
            "b.jpg",
            "b_depth.pfm",
            "alone.pfm",
            "a_depth.exr",
            "beauty.exr",
            "two.MPO",
            "a.JPEG",
            "same.png",
            "same.jpg",
            "notes.txt",
            ".hidden.jpg",
            "x.heic",
            "2020/b.webp",
            "2020/.cache/t.jpg",
        ] {
            std::fs::write(root.join(name), b"x").unwrap();
        }
        let out = place.path().join("out");
        let items = Batch::of(std::slice::from_ref(&root), &out).unwrap().items;
        let got: Vec<_> = items.iter().map(|i| (i.photo.strip_prefix(&root).unwrap(), i.output.strip_prefix(&out).unwrap())).collect();
        let want = [
            ("2020/b.webp", "2020/b.tmpi"),
            ("a.JPEG", "a.tmpi"),
            ("b.jpg", "b.tmpi"),
            ("same.jpg", "same.jpg.tmpi"),
            ("same.png", "same.png.tmpi"),
            ("two.MPO", "two.tmpi"),
        ];
        assert_eq!(got, want.map(|(a, b)| (Path::new(a), Path::new(b))));
        let maps: Vec<_> = items.iter().filter_map(|i| i.depth.as_deref()).collect();
        assert_eq!(maps, [root.join("a_depth.exr").as_path(), root.join("b_depth.pfm").as_path()]);
        std::fs::create_dir(place.path().join("empty")).unwrap();
        assert!(Batch::of(&[place.path().join("empty")], &out).unwrap_err().to_string().contains("no JPEG"));
    }
}
