//! Limits per address, so that one client cannot take all places.

use std::collections::HashMap;
use std::net::{IpAddr, Ipv6Addr};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::sync::{OwnedSemaphorePermit, Semaphore};

tokio::task_local! {
    /// Address of the client, if it tells clients apart: loopback is also the address of all clients behind a proxy.
    pub static CLIENT: Option<IpAddr>;
}

/// Address of the client, if known.
#[must_use]
pub fn client_address() -> Option<IpAddr> {
    CLIENT.try_with(|address| *address).ok().flatten()
}

/// Counts per address.
#[derive(Clone, Debug)]
pub struct ClientLimits {
    most: usize,
    had: Arc<Mutex<HashMap<IpAddr, usize>>>,
}

/// One place of an address, until it is dropped.
#[derive(Debug)]
pub struct ClientPermit(Option<(ClientLimits, IpAddr)>);

impl ClientLimits {
    /// At most so many per address.
    #[must_use]
    pub fn new(most: usize) -> Self {
        Self { most, had: Arc::default() }
    }

    /// Half of the total.
    #[must_use]
    pub fn half_of(all: usize) -> Self {
        Self::new(all.div_ceil(2))
    }

    fn lock(&self) -> MutexGuard<'_, HashMap<IpAddr, usize>> {
        self.had.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes a place for `address`; `None` if it has too many. Unknown clients are not counted.
    #[must_use]
    pub fn take(&self, address: Option<IpAddr>) -> Option<ClientPermit> {
        let Some(address) = address.map(client_network) else { return Some(ClientPermit(None)) };
        let mut had = self.lock();
        let count = had.get(&address).copied().unwrap_or_default();
        (count < self.most).then(|| {
            had.insert(address, count + 1);
            ClientPermit(Some((self.clone(), address)))
        })
    }

    /// Whether no place is taken.
    #[cfg(test)]
    pub fn is_empty(&self) -> bool {
        self.lock().is_empty()
    }
}

impl Drop for ClientPermit {
    fn drop(&mut self) {
        let Some((shares, of)) = self.0.take() else { return };
        let mut had = shares.lock();
        if let Some(count) = had.get_mut(&of) {
            *count -= 1;
            if *count == 0 {
                had.remove(&of);
            }
        }
    }
}

/// The address that stands for a customer: an IPv6 customer has a whole /64 network.
#[must_use]
pub fn client_network(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V6(v6) => Ipv6Addr::from(u128::from(v6) >> 64 << 64).into(),
        v4 @ IpAddr::V4(_) => v4,
    }
}

/// A number of places, of which one address can have half.
#[derive(Debug)]
pub struct ClientSlots {
    all: usize,
    free: Arc<Semaphore>,
    shares: ClientLimits,
}

/// One place, until it is dropped.
#[derive(Debug)]
pub struct ClientSlot {
    _permit: OwnedSemaphorePermit,
    _share: ClientPermit,
}

impl ClientSlots {
    /// So many places.
    #[must_use]
    pub fn new(all: usize) -> Self {
        Self { all, free: Arc::new(Semaphore::new(all)), shares: ClientLimits::half_of(all) }
    }

    /// Takes a place for `address`; `None` if all are taken, or it has half of them.
    #[must_use]
    pub fn take(&self, address: Option<IpAddr>) -> Option<ClientSlot> {
        let share = self.shares.take(address)?;
        let permit = Arc::clone(&self.free).try_acquire_owned().ok()?;
        Some(ClientSlot { _permit: permit, _share: share })
    }

    /// Number of places taken.
    #[must_use]
    pub fn taken(&self) -> usize {
        self.all - self.free.available_permits()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_has_its_share_and_returns_it() {
        let shares = ClientLimits::new(2);
        let take = |address: &str| shares.take(Some(address.parse().unwrap()));
        let first = (take("192.0.2.1").unwrap(), take("192.0.2.1").unwrap());
        assert!(take("192.0.2.1").is_none() && take("192.0.2.2").is_some());
        assert!(take("::ffff:192.0.2.1").is_none(), "the same written otherwise");
        let net = (take("2001:db8::1").unwrap(), take("2001:db8::2").unwrap());
        assert!(take("2001:db8::3").is_none() && take("2001:db8:0:1::1").is_some());
        drop((first, net));
        assert!(take("192.0.2.1").is_some());
        assert!(shares.is_empty(), "nothing is kept of who has gone");
        let unknown: Vec<_> = (0..9).map(|_| shares.take(None).unwrap()).collect();
        assert!(shares.is_empty() && unknown.len() == 9);
    }

    #[test]
    fn half_of_all_places_are_left_to_others() {
        let places = ClientSlots::new(4);
        let ask = |address: &str| places.take(Some(address.parse().unwrap()));
        let greedy = (ask("192.0.2.1"), ask("192.0.2.1"));
        assert!(greedy.0.is_some() && greedy.1.is_some() && ask("192.0.2.1").is_none());
        let others = (ask("192.0.2.2"), places.take(None));
        assert!(others.0.is_some() && others.1.is_some() && places.take(None).is_none(), "all are taken");
        assert_eq!(places.taken(), 4);
        drop(greedy);
        assert_eq!(places.taken(), 2);
        assert!(ask("192.0.2.1").is_some());
    }
}
