//! Limits per address, so that one client cannot take all places.

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tmpi_library::client_network;

tokio::task_local! {
    /// Address of the client, if it tells clients apart: loopback is also the address of all clients behind a proxy.
    pub static CLIENT: Option<IpAddr>;
}

pub fn client_address() -> Option<IpAddr> {
    CLIENT.try_with(|address| *address).ok().flatten()
}

/// A number of places, of which one address can have a share.
#[derive(Clone, Debug)]
pub struct ClientSlots {
    all: usize,
    share: usize,
    taken: Arc<Mutex<Taken>>,
}

/// Places that are taken: in all, and by address. Those of unknown clients have no address.
#[derive(Debug, Default)]
struct Taken {
    all: usize,
    by_address: HashMap<IpAddr, usize>,
}

/// One place, until it is dropped.
#[derive(Debug)]
pub struct ClientSlot {
    slots: ClientSlots,
    address: Option<IpAddr>,
}

impl ClientSlots {
    /// So many places, of which one address can have half.
    pub fn new(all: usize) -> Self {
        Self { all, share: all.div_ceil(2), taken: Arc::default() }
    }

    /// At most so many places per address.
    pub fn per_address(share: usize) -> Self {
        Self { all: usize::MAX, share, taken: Arc::default() }
    }

    fn lock(&self) -> MutexGuard<'_, Taken> {
        self.taken.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes a place for `address`; `None` if all are taken, or it has its share.
    pub fn take(&self, address: Option<IpAddr>) -> Option<ClientSlot> {
        let address = address.map(client_network);
        let mut taken = self.lock();
        if taken.all >= self.all {
            return None;
        }
        if let Some(address) = address {
            let count = taken.by_address.get(&address).copied().unwrap_or_default();
            if count >= self.share {
                return None;
            }
            taken.by_address.insert(address, count + 1);
        }
        taken.all += 1;
        drop(taken);
        Some(ClientSlot { slots: self.clone(), address })
    }

    pub fn taken(&self) -> usize {
        self.lock().all
    }
}

impl Drop for ClientSlot {
    fn drop(&mut self) {
        let mut taken = self.slots.lock();
        taken.all -= 1;
        let Some(address) = self.address else { return };
        if let Some(count) = taken.by_address.get_mut(&address) {
            *count -= 1;
            if *count == 0 {
                taken.by_address.remove(&address);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_has_its_share_and_returns_it() {
        let slots = ClientSlots::per_address(2);
        let take = |address: &str| slots.take(Some(address.parse().unwrap()));
        let first = (take("192.0.2.1").unwrap(), take("192.0.2.1").unwrap());
        assert!(take("192.0.2.1").is_none() && take("192.0.2.2").is_some());
        assert!(take("::ffff:192.0.2.1").is_none(), "the same written otherwise");
        let net = (take("2001:db8::1").unwrap(), take("2001:db8::2").unwrap());
        assert!(take("2001:db8::3").is_none() && take("2001:db8:0:1::1").is_some());
        drop((first, net));
        assert!(take("192.0.2.1").is_some());
        assert!(slots.lock().by_address.is_empty(), "nothing is kept of who has gone");
        let unknown: Vec<_> = (0..9).map(|_| slots.take(None).unwrap()).collect();
        assert!(slots.lock().by_address.is_empty() && unknown.len() == 9);
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
