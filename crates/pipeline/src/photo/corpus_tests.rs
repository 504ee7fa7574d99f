//! Files of real cameras and programs, if the data is available (`TMPI_DATA`).

use std::path::{Path, PathBuf};

use tmpi_core::container::EncodedPhoto;

use super::tests::ok;
use super::*;

fn files(folder: &Path, out: &mut Vec<PathBuf>) {
    let mut entries: Vec<_> = std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().path()).collect();
    entries.sort();
    for path in entries {
        if path.is_dir() { files(&path, out) } else { out.push(path) }
    }
}

#[test]
fn odd_and_broken_real_files_decode_or_are_refused() {
    let Some(root) = tmpi_testing::data("torture") else { return };
    let mut all = Vec::new();
    files(&root, &mut all);
    let (mut read, mut refused, mut stripped) = (0, 0, 0);
    for path in all {
        let bytes = std::fs::read(&path).unwrap();
        let name = path.strip_prefix(&root).unwrap().display();
        match decode(&bytes, &Limits::default(), None) {
            Ok(got) => {
                read += 1;
                assert_eq!(got.photo.rgb.len(), got.photo.width as usize * got.photo.height as usize);
                assert!(got.intrinsics.is_valid());
                if let Some(file) = got.stripped {
                    stripped += 1;
                    assert_eq!(ok(&file).photo, got.photo, "{name} changes when stripped");
                    assert!(file.len() <= bytes.len() + 18, "{name} grew");
                    // as readers of a container decode it, which keeps this file
                    let kept = EncodedPhoto { bytes: file, format: got.format }.decode();
                    assert_eq!(kept.unwrap(), got.photo, "{name} differs in a container");
                }
            }
            Err(e) => {
                assert!(!e.to_string().contains("the decoder failed"), "{name}: a decoder panicked");
                if PhotoFormat::sniff(&bytes).is_some() {
                    refused += 1;
                    eprintln!("refused {name}: {e}");
                }
            }
        }
    }
    eprintln!("{read} read, {refused} refused, {stripped} stripped");
    assert!(read > 100);
}

#[test]
fn orientations_of_real_files_agree() {
    let Some(root) = tmpi_testing::data("torture/exif_orientation") else { return };
    for kind in ["Landscape", "Portrait"] {
        let thumb = |n: u32| {
            let bytes = std::fs::read(root.join(format!("{kind}_{n}.jpg"))).unwrap();
            decode(&bytes, &Limits::default(), Some(64)).unwrap().photo
        };
        let base = thumb(1);
        for n in 2..=8 {
            let got = thumb(n);
            assert_eq!((got.width, got.height), (base.width, base.height), "{kind}_{n}");
            let off: f64 = got.rgb.iter().flatten().zip(base.rgb.iter().flatten()).map(|(a, b)| f64::from(a.abs_diff(*b))).sum();
            assert!(off / (got.rgb.len() as f64 * 3.0) < 10.0, "{kind}_{n} is turned the wrong way");
        }
    }
}
