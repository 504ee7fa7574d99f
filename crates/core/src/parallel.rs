//! Work on tiles, rows and bands: side by side with the feature `threads`, one after the other without it. The results are the same.

#[cfg(feature = "threads")]
use rayon::prelude::*;

/// `f` of every number below `count`, in order; each thread has one `init()` that its calls use in turn.
#[cfg(feature = "threads")]
pub fn map_init<S, T: Send>(count: usize, init: impl Fn() -> S + Send + Sync, f: impl Fn(&mut S, usize) -> T + Send + Sync) -> Vec<T> {
    (0..count).into_par_iter().map_init(init, f).collect()
}

/// `f` of every number below `count`, in order; each thread has one `init()` that its calls use in turn.
#[cfg(not(feature = "threads"))]
pub fn map_init<S, T: Send>(count: usize, init: impl Fn() -> S + Send + Sync, f: impl Fn(&mut S, usize) -> T + Send + Sync) -> Vec<T> {
    let mut scratch = init();
    (0..count).map(|i| f(&mut scratch, i)).collect()
}

/// `f` of every item, until one fails.
///
/// # Errors
/// One of those that `f` gave.
pub fn try_each<T: Send, E: Send>(items: Vec<T>, f: impl Fn(T) -> Result<(), E> + Send + Sync) -> Result<(), E> {
    #[cfg(feature = "threads")]
    return items.into_par_iter().try_for_each(f);
    #[cfg(not(feature = "threads"))]
    return items.into_iter().try_for_each(f);
}

/// Both results.
pub fn join<A: Send, B: Send>(a: impl FnOnce() -> A + Send, b: impl FnOnce() -> B + Send) -> (A, B) {
    #[cfg(feature = "threads")]
    return rayon::join(a, b);
    #[cfg(not(feature = "threads"))]
    return (a(), b());
}
