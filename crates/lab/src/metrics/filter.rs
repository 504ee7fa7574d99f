//! Separable filters.

/// The column or row of a picture with so many that is shown at a place, which may be beyond the picture.
pub(super) type Border = fn(isize, usize) -> usize;

/// What is shown at `n` places, and at `radius` more on both sides.
fn places(n: usize, radius: usize, border: Border) -> Vec<usize> {
    (0..n + 2 * radius).map(|i| border(i as isize - radius as isize, n)).collect()
}

/// Correlates rows with `kernel`, which has an odd number of weights.
pub(super) fn along(values: &[f64], width: usize, kernel: &[f64], border: Border) -> Vec<f64> {
    let places = places(width, kernel.len() / 2, border);
    let mut out = Vec::with_capacity(values.len());
    for row in values.chunks_exact(width) {
        let padded: Vec<f64> = places.iter().map(|i| row[*i]).collect();
        out.extend(padded.windows(kernel.len()).map(|w| w.iter().zip(kernel).map(|(v, k)| v * k).sum::<f64>()));
    }
    out
}

/// Correlates columns with `kernel`, which has an odd number of weights.
pub(super) fn down(values: &[f64], width: usize, kernel: &[f64], border: Border) -> Vec<f64> {
    let places = places(values.len() / width, kernel.len() / 2, border);
    let mut out = vec![0.0; values.len()];
    for (y, out) in out.chunks_exact_mut(width).enumerate() {
        for (k, i) in kernel.iter().zip(&places[y..]) {
            out.iter_mut().zip(&values[i * width..][..width]).for_each(|(sum, v)| *sum += k * v);
        }
    }
    out
}
