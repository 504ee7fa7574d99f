//! A cache with a budget in bytes and one computation per key.

use std::hash::Hash;
use std::sync::Arc;
use std::time::Duration;

use moka::future::{Cache as Kept, CacheBuilder};
use moka::policy::EvictionPolicy;

use tmpi_library::PhotoId;

/// Bytes of an entry besides its key and value, measured on views of one pixel: slots, counts and lists of the cache, and fragmentation of
/// the allocator.
const OVERHEAD: usize = 1536;

/// Epochs after which removed entries are freed, and one that may have begun already.
const EPOCHS: usize = 3;

/// A version of a photo: id and when it was made, so that an entry of a deleted photo never serves a new one with the same id.
pub type Version = (PhotoId, u64);

/// Part of a cache entry.
pub trait Weight: Clone + Send + Sync + 'static {
    /// Bytes on the heap.
    fn weight(&self) -> usize {
        0
    }
}

type Entries<K, V> = Kept<(Version, K), V>;

/// Keeps values by version and key, of at most `budget` bytes together; evicts the least recently used first.
pub struct Cache<K, V> {
    kept: Entries<K, V>,
}

impl<K: Weight + Eq + Hash, V: Weight> Cache<K, V> {
    /// An empty cache of `budget` bytes.
    pub fn new(budget: usize) -> Self {
        Self::built(budget, Kept::builder())
    }

    /// A cache in memory, which also drops entries unused for `idle_time`, at the next [`Self::evict_idle`] at the latest.
    pub fn with_idle_timeout(budget: usize, idle_time: Duration) -> Self {
        Self::built(budget, Kept::builder().time_to_idle(idle_time))
    }

    fn built(budget: usize, builder: CacheBuilder<(Version, K), V, Entries<K, V>>) -> Self {
        let weigh = |(_, key): &(Version, K), value: &V| u32::try_from(key.weight() + value.weight() + OVERHEAD).unwrap_or(u32::MAX);
        let kept = builder
            .max_capacity(budget as u64)
            .weigher(weigh)
            .eviction_policy(EvictionPolicy::lru())
            .support_invalidation_closures()
            .build();
        Self { kept }
    }

    /// The value of `key`; computes it with `make` if it is missing. Concurrent callers for the same key wait for that one computation; if
    /// its caller leaves, the next one runs its own. Failures are not cached.
    ///
    /// # Errors
    /// The error of `make`.
    pub async fn get<E, F>(&self, key: (Version, K), make: F) -> Result<V, E>
    where
        E: Clone + Send + Sync + 'static,
        F: Future<Output = Result<V, E>>,
    {
        let entry = self.kept.entry(key).or_try_insert_with(make).await.map_err(|error: Arc<E>| E::clone(&error))?;
        if entry.is_fresh() {
            // at once, rather than after some more entries: one may be half of the memory
            self.evict_idle().await;
        }
        Ok(entry.into_value())
    }

    /// Removes entries that rested long enough, and frees removed ones at once: otherwise they wait, whatever their size, until this thread
    /// has removed some dozens more.
    pub async fn evict_idle(&self) {
        self.kept.run_pending_tasks().await;
        // entries removed in one epoch are freed two epochs later
        for _ in 0..EPOCHS {
            crossbeam_epoch::pin().flush();
        }
    }

    pub async fn evict_photo(&self, photo: PhotoId) {
        if let Err(error) = self.kept.invalidate_entries_if(move |((of, _), _), _| *of == photo) {
            // on error they age out: their keys are not used again
            tracing::error!(%error, "forgetting a photo");
        }
        self.evict_idle().await;
    }

    pub async fn clear(&self) {
        self.kept.invalidate_all();
        self.evict_idle().await;
    }

    /// Bytes of all entries.
    pub fn bytes(&self) -> u64 {
        self.kept.weighted_size()
    }

    #[cfg(test)]
    pub fn entries(&self) -> u64 {
        self.kept.entry_count()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    impl Weight for u32 {}

    impl Weight for usize {
        fn weight(&self) -> usize {
            *self
        }
    }

    const KIB: usize = 1024;

    /// A key of one of two photos.
    fn keyed(key: u32) -> (Version, u32) {
        ((PhotoId::from_bytes([(key % 2) as u8; 16]), 0), key)
    }

    async fn put(cache: &Cache<u32, usize>, key: u32, bytes: usize) -> bool {
        let mut made = false;
        let value = cache
            .get(keyed(key), async {
                made = true;
                Ok::<_, ()>(bytes)
            })
            .await;
        assert_eq!(value, Ok(bytes));
        made
    }

    #[tokio::test]
    async fn the_least_recently_used_goes_first_and_the_budget_holds() {
        let cache = Cache::new(100 * KIB);
        assert!(put(&cache, 1, 40 * KIB).await && put(&cache, 2, 40 * KIB).await);
        assert!(!put(&cache, 1, 40 * KIB).await);
        assert!(put(&cache, 3, 40 * KIB).await, "goes in, 2 goes out");
        assert!(!put(&cache, 1, 40 * KIB).await && put(&cache, 2, 40 * KIB).await);
        assert!(put(&cache, 9, 110 * KIB).await && put(&cache, 9, 110 * KIB).await, "too large to be kept");
        assert!(cache.bytes() <= 100 * KIB as u64, "{}", cache.bytes());
    }

    #[tokio::test]
    async fn keys_and_overhead_count_so_that_small_values_are_bounded_too() {
        let cache = Cache::new(100 * KIB);
        for key in 0..5000 {
            put(&cache, key, 1).await;
        }
        assert!(cache.entries() <= (100 * KIB / OVERHEAD) as u64, "{} entries", cache.entries());
        assert!(cache.entries() > 50);
    }

    #[tokio::test]
    async fn entries_of_a_photo_can_be_removed() {
        let cache = Cache::new(100 * KIB);
        for key in 0..10 {
            put(&cache, key, 1).await;
        }
        cache.evict_photo(keyed(1).0.0).await;
        for key in 0..10 {
            assert_eq!(put(&cache, key, 1).await, key % 2 == 1, "{key}");
        }
    }

    #[derive(Clone)]
    struct Large(#[allow(dead_code, reason = "counted by who else holds it")] Arc<()>);

    impl Weight for Large {
        fn weight(&self) -> usize {
            40 * KIB
        }
    }

    #[tokio::test]
    async fn removed_entries_are_freed_at_once() {
        let cache = Cache::<u32, Large>::new(100 * KIB);
        let values: Vec<_> = (0..4).map(|_| Arc::new(())).collect();
        let held = |n: usize| Arc::strong_count(&values[n]) - 1;
        for (key, value) in values.iter().enumerate() {
            let _ = cache.get(keyed(key as u32), async { Ok::<_, ()>(Large(Arc::clone(value))) }).await;
        }
        // other threads of the tests hold up epochs briefly
        let freed = async |n: usize| {
            for _ in 0..1000 {
                cache.evict_idle().await;
                if held(n) == 0 {
                    return true;
                }
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
            false
        };
        assert!(freed(0).await && freed(1).await, "displaced");
        assert_eq!((held(2), held(3)), (1, 1));
        cache.evict_photo(keyed(2).0.0).await;
        assert!(freed(2).await, "forgotten");
        cache.clear().await;
        assert!(freed(3).await, "cleared");
    }

    #[tokio::test]
    async fn unused_entries_are_dropped() {
        let cache = Cache::<u32, usize>::with_idle_timeout(100 * KIB, Duration::from_millis(20));
        assert!(put(&cache, 1, KIB).await);
        while cache.bytes() > 0 {
            tokio::time::sleep(Duration::from_millis(5)).await;
            cache.evict_idle().await;
        }
        assert!(put(&cache, 1, KIB).await, "made anew");
    }
}
