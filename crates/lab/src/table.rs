//! Text tables.

/// Formats rows as a table whose columns are as wide as their widest cell. The first `left` columns are words, aligned to the left; the
/// others are numbers, aligned to the right.
pub fn table(left: usize, rows: &[Vec<String>]) -> String {
    let mut widths = Vec::new();
    for row in rows {
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

/// A row of these cells.
pub fn row<const N: usize>(cells: [&str; N]) -> Vec<String> {
    cells.map(str::to_owned).into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_aligned_and_separate() {
        let rows = [row(["way", "dB"]), row(["mesh", "9.25"]), row(["tmpi-δ", "31.5"])];
        assert_eq!(table(1, &rows), "way       dB\nmesh    9.25\ntmpi-δ  31.5\n");
    }
}
