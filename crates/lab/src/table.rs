//! Text tables.

/// Formats rows below their head as a table whose columns are as wide as their widest cell. The first `left` columns are words, aligned to
/// the left; the others are numbers, aligned to the right.
pub fn table(left: usize, head: &[impl AsRef<str>], rows: impl IntoIterator<Item = Vec<String>>) -> String {
    let head: Vec<String> = head.iter().map(|cell| cell.as_ref().to_owned()).collect();
    let rows: Vec<Vec<String>> = std::iter::once(head).chain(rows).collect();
    let mut widths = Vec::new();
    for row in &rows {
        widths.resize(row.len().max(widths.len()), 0);
        widths.iter_mut().zip(row).for_each(|(width, cell)| *width = cell.chars().count().max(*width));
    }
    let line = |row: &Vec<String>| {
        let cell =
            |(i, (cell, &width)): (usize, (&String, &usize))| if i < left { format!("{cell:width$}") } else { format!("{cell:>width$}") };
        let cells: Vec<String> = row.iter().zip(&widths).enumerate().map(cell).collect();
        format!("{}\n", cells.join("  ").trim_end())
    };
    rows.iter().map(line).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_aligned_and_separate() {
        let rows = [["mesh", "9.25"], ["tmpi-δ", "31.5"]].map(|row| row.map(str::to_owned).to_vec());
        assert_eq!(table(1, &["way", "dB"], rows), "way       dB\nmesh    9.25\ntmpi-δ  31.5\n");
    }
}
