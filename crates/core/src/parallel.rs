//! Loops over tiles, rows and bands: parallel with the feature `threads`, sequential without it. The results are the same.

#[cfg(feature = "threads")]
use rayon::prelude::*;

/// Most calls that a thread makes before another can take over the rest. By itself, rayon leaves a quarter of all calls in one piece on two
/// cores, and the other core may wait for it.
#[cfg(feature = "threads")]
const MAX_PIECE: usize = 8;

/// Calls `f` for each number below `count` and returns the results in order. Each run of successive calls shares the state from one `init`.
#[cfg(feature = "threads")]
pub fn map_init<S, T: Send>(count: usize, init: impl Fn() -> S + Send + Sync, f: impl Fn(&mut S, usize) -> T + Send + Sync) -> Vec<T> {
    (0..count).into_par_iter().with_max_len(MAX_PIECE).map_init(init, f).collect()
}

/// Calls `f` for each number below `count` and returns the results in order. All calls share the state from one `init`.
#[cfg(not(feature = "threads"))]
pub fn map_init<S, T: Send>(count: usize, init: impl Fn() -> S + Send + Sync, f: impl Fn(&mut S, usize) -> T + Send + Sync) -> Vec<T> {
    let mut scratch = init();
    (0..count).map(|i| f(&mut scratch, i)).collect()
}

/// Calls `f` for each item until one call fails.
///
/// # Errors
/// Returns the error of a failed call; with `threads`, not necessarily that of the first item.
pub fn try_each<T: Send, E: Send>(items: Vec<T>, f: impl Fn(T) -> Result<(), E> + Send + Sync) -> Result<(), E> {
    #[cfg(feature = "threads")]
    return items.into_par_iter().try_for_each(f);
    #[cfg(not(feature = "threads"))]
    return items.into_iter().try_for_each(f);
}

/// Calls `f` with the index and the values of each piece of `length` values. The last piece may be shorter.
pub fn each_piece<T: Send>(values: &mut [T], length: usize, f: impl Fn(usize, &mut [T]) + Send + Sync) {
    #[cfg(feature = "threads")]
    values.par_chunks_mut(length).enumerate().for_each(|(i, piece)| f(i, piece));
    #[cfg(not(feature = "threads"))]
    values.chunks_mut(length).enumerate().for_each(|(i, piece)| f(i, piece));
}

/// Runs both closures and returns both results.
pub fn join<A: Send, B: Send>(a: impl FnOnce() -> A + Send, b: impl FnOnce() -> B + Send) -> (A, B) {
    #[cfg(feature = "threads")]
    return rayon::join(a, b);
    #[cfg(not(feature = "threads"))]
    return (a(), b());
}
