//! A cache in bytes with one computation per key.

use std::collections::HashMap;
use std::hash::Hash;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::sync::OnceCell;

/// Keeps values of at most `budget` bytes together; the least recently used go first.
pub struct Cache<K, V> {
    budget: usize,
    inner: Mutex<Inner<K, V>>,
}

struct Inner<K, V> {
    slots: HashMap<K, Slot<V>>,
    clock: u64,
    bytes: usize,
}

struct Slot<V> {
    cell: Arc<OnceCell<V>>,
    used: u64,
    bytes: usize,
}

impl<K: Hash + Eq + Clone, V: Clone> Cache<K, V> {
    /// An empty cache of `budget` bytes.
    #[must_use]
    pub fn new(budget: usize) -> Self {
        Self { budget, inner: Mutex::new(Inner { slots: HashMap::new(), clock: 0, bytes: 0 }) }
    }

    fn lock(&self) -> MutexGuard<'_, Inner<K, V>> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The value of `key`; where it is missing, `make` gives it and its size in bytes. Whoever asks for the same key
    /// meanwhile waits for that one computation. A failure is not kept.
    ///
    /// # Errors
    /// That of `make`.
    pub async fn get<E, F>(&self, key: K, make: F) -> Result<V, E>
    where
        F: Future<Output = Result<(V, usize), E>>,
    {
        let cell = {
            let mut inner = self.lock();
            inner.clock += 1;
            let used = inner.clock;
            let slot = inner.slots.entry(key.clone()).or_insert_with(|| Slot { cell: Arc::default(), used, bytes: 0 });
            slot.used = used;
            Arc::clone(&slot.cell)
        };
        let mut size = None;
        let value = cell
            .get_or_try_init(async || {
                let (value, bytes) = make.await?;
                size = Some(bytes);
                Ok(value)
            })
            .await
            .cloned();
        match (&value, size) {
            (Ok(_), Some(bytes)) => self.settle(&key, &cell, bytes),
            (Err(_), _) => self.forget(&key, &cell),
            _ => {}
        }
        value
    }

    /// Books a fresh value and makes room for it.
    fn settle(&self, key: &K, cell: &Arc<OnceCell<V>>, bytes: usize) {
        let mut inner = self.lock();
        let Some(slot) = inner.slots.get_mut(key).filter(|s| Arc::ptr_eq(&s.cell, cell)) else { return };
        slot.bytes = bytes;
        inner.bytes += bytes;
        if bytes > self.budget {
            inner.remove(key);
        }
        while inner.bytes > self.budget {
            let oldest = inner.slots.iter().filter(|(k, s)| s.bytes > 0 && *k != key).min_by_key(|(_, s)| s.used);
            let Some(oldest) = oldest.map(|(k, _)| k.clone()) else { break };
            inner.remove(&oldest);
        }
    }

    fn forget(&self, key: &K, cell: &Arc<OnceCell<V>>) {
        let mut inner = self.lock();
        // somebody else's computation may have succeeded meanwhile
        if inner.slots.get(key).is_some_and(|s| Arc::ptr_eq(&s.cell, cell) && s.cell.get().is_none()) {
            inner.remove(key);
        }
    }

    /// Removes the values of which the key is wanted no more.
    pub fn retain(&self, mut wanted: impl FnMut(&K) -> bool) {
        let mut inner = self.lock();
        let gone: Vec<K> = inner.slots.keys().filter(|k| !wanted(k)).cloned().collect();
        for key in gone {
            inner.remove(&key);
        }
    }

    /// Bytes of all values.
    #[must_use]
    pub fn bytes(&self) -> usize {
        self.lock().bytes
    }
}

impl<K: Hash + Eq, V> Inner<K, V> {
    fn remove(&mut self, key: &K) {
        if let Some(slot) = self.slots.remove(key) {
            self.bytes -= slot.bytes;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};
    use std::time::Duration;

    use super::*;

    async fn put(cache: &Cache<u8, u8>, key: u8, bytes: usize) -> bool {
        let mut made = false;
        let value = cache
            .get(key, async {
                made = true;
                Ok::<_, ()>((key, bytes))
            })
            .await;
        assert_eq!(value, Ok(key));
        made
    }

    #[tokio::test]
    async fn the_least_recently_used_goes_first_and_the_budget_holds() {
        let cache = Cache::new(10);
        assert!(put(&cache, 1, 4).await && put(&cache, 2, 4).await);
        assert!(!put(&cache, 1, 4).await);
        assert!(put(&cache, 3, 4).await, "goes in, 2 goes out");
        assert_eq!(cache.bytes(), 8);
        assert!(!put(&cache, 1, 4).await && put(&cache, 2, 4).await);
        assert!(put(&cache, 9, 11).await && put(&cache, 9, 11).await, "too large to be kept");
        assert!(cache.bytes() <= 10);
        assert!(put(&cache, 8, 10).await && !put(&cache, 8, 10).await, "just fits");
        cache.retain(|_| false);
        assert_eq!(cache.bytes(), 0);
    }

    #[tokio::test]
    async fn one_computation_per_key() {
        let cache = Cache::new(100);
        let runs = AtomicUsize::new(0);
        let one = || {
            cache.get(7, async {
                runs.fetch_add(1, Ordering::SeqCst);
                tokio::time::sleep(Duration::from_millis(20)).await;
                Ok::<_, ()>((1, 1))
            })
        };
        let all = futures_util::future::join_all((0..16).map(|_| one())).await;
        assert!(all.iter().all(|v| *v == Ok(1)));
        assert_eq!((runs.load(Ordering::SeqCst), cache.bytes()), (1, 1));
    }

    #[tokio::test]
    async fn a_failure_is_not_kept() {
        let cache: Cache<u8, u8> = Cache::new(100);
        assert_eq!(cache.get(1, async { Err("no") }).await, Err("no"));
        assert!(put(&cache, 1, 1).await);
    }

    #[tokio::test]
    async fn who_gives_up_does_not_block_the_next() {
        let cache: Cache<u8, u8> = Cache::new(100);
        let never = cache.get(1, std::future::pending::<Result<(u8, usize), ()>>());
        assert!(tokio::time::timeout(Duration::from_millis(5), never).await.is_err());
        assert!(put(&cache, 1, 1).await);
    }
}
