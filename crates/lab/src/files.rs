//! Reads and writes files; errors name the path.

use std::path::{Path, PathBuf};

use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::LabError;

/// Paths of everything in a folder, sorted by name.
pub fn entries(folder: &Path) -> Result<Vec<PathBuf>, LabError> {
    let bad = |e| LabError::file(folder, e);
    let entries = std::fs::read_dir(folder).map_err(bad)?;
    let mut paths = entries.map(|entry| Ok(entry?.path())).collect::<std::io::Result<Vec<_>>>().map_err(bad)?;
    paths.sort();
    Ok(paths)
}

pub fn read(path: &Path) -> Result<Vec<u8>, LabError> {
    std::fs::read(path).map_err(|e| LabError::file(path, e))
}

pub fn read_json<T: DeserializeOwned>(path: &Path) -> Result<T, LabError> {
    serde_json::from_slice(&read(path)?).map_err(|e| LabError::file(path, e))
}

/// Writes a file, and creates missing folders.
pub fn write(path: &Path, bytes: &[u8]) -> Result<(), LabError> {
    let folder = path.parent().unwrap_or(path);
    std::fs::create_dir_all(folder).and_then(|()| std::fs::write(path, bytes)).map_err(|e| LabError::file(path, e))
}

/// Writes a value as a JSON file, and creates missing folders.
pub fn write_json(path: &Path, value: &impl Serialize) -> Result<(), LabError> {
    write(path, &serde_json::to_vec_pretty(value).map_err(|e| LabError::file(path, e))?)
}

/// The last part of a path.
pub fn name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}
