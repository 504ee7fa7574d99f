//! Groups of pictures that this node fetches from a room's origin: one request for all viewers here that want the same group.

use std::collections::BTreeMap;
use std::io;
use std::pin::pin;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use axum::body::Body;
use axum::http::Response;
use bytes::Bytes;
use futures_util::{Stream, StreamExt as _, stream};
use tokio::sync::watch;
use tokio::time::Instant;

use super::gop_store::Group;
use crate::server::Problem;

/// Most whole groups of a room to keep, as at its origin.
const KEPT: usize = 4;
/// How long to keep a whole group, for viewers that read it slowly or come late.
const KEPT_FOR: Duration = Duration::from_secs(30);
/// Most bytes of all groups of all rooms. Beyond them, the oldest whole groups go, and a group that still finds no room breaks off.
const MOST_BYTES: usize = 64 << 20;

/// A room's name and one of its groups.
pub type RoomGroup = (String, Group);

/// A group as far as it has arrived.
#[derive(Default)]
struct Arrived {
    /// Whether the origin has it; `None` before its answer.
    found: Option<Result<(), Problem>>,
    pieces: Vec<Bytes>,
    end: Option<End>,
    /// Since when it is whole.
    whole_since: Option<Instant>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum End {
    /// All of it has arrived.
    Whole,
    /// The origin broke off, or this node dropped the group.
    Broken,
}

type Arriving = Arc<watch::Sender<Arrived>>;

/// The groups that are being fetched or kept.
pub struct GroupRelay {
    groups: Mutex<BTreeMap<RoomGroup, Arriving>>,
    /// Bytes of their pieces.
    bytes: AtomicUsize,
    most: usize,
}

impl Default for GroupRelay {
    fn default() -> Self {
        Self { groups: Mutex::default(), bytes: AtomicUsize::new(0), most: MOST_BYTES }
    }
}

impl GroupRelay {
    fn lock(&self) -> MutexGuard<'_, BTreeMap<RoomGroup, Arriving>> {
        self.groups.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A group as it arrives. `fetch` asks the origin for it, unless another viewer has done so.
    ///
    /// # Errors
    /// The error of `fetch`.
    pub async fn get<F>(self: &Arc<Self>, key: RoomGroup, fetch: F) -> Result<Body, Problem>
    where
        F: Future<Output = Result<Response<Body>, Problem>> + Send + 'static,
    {
        let mut arrived = self.join(key, fetch);
        let found = arrived.wait_for(|group| group.found.is_some()).await.map(|group| group.found.clone());
        found.ok().flatten().unwrap_or_else(|| Err(Problem::internal("fetching a group of pictures", &"it was dropped")))?;
        Ok(Body::from_stream(pieces(arrived)))
    }

    fn join<F>(self: &Arc<Self>, key: RoomGroup, fetch: F) -> watch::Receiver<Arrived>
    where
        F: Future<Output = Result<Response<Body>, Problem>> + Send + 'static,
    {
        let mut groups = self.lock();
        if let Some(group) = groups.get(&key) {
            return group.subscribe();
        }
        let (sender, arrived) = watch::channel(Arrived::default());
        let group = Arc::new(sender);
        groups.insert(key.clone(), Arc::clone(&group));
        drop(groups);
        let relay = Arc::clone(self);
        tokio::spawn(async move {
            relay.keep(&key, fetch, &group).await;
            let mut groups = relay.lock();
            // another viewer may have asked for it again
            if groups.get(&key).is_some_and(|now| Arc::ptr_eq(now, &group)) {
                groups.remove(&key);
            }
            drop(groups);
            relay.drop_pieces(&group);
        });
        arrived
    }

    /// Fetches a group, and keeps it for a while if it is whole; gives up once no viewer wants it.
    async fn keep(&self, key: &RoomGroup, fetch: impl Future<Output = Result<Response<Body>, Problem>>, group: &Arriving) {
        let mut fill = pin!(self.fill(fetch, group));
        loop {
            tokio::select! {
                is_whole = &mut fill => {
                    if is_whole {
                        self.drop_older(&key.0);
                        tokio::time::sleep(KEPT_FOR).await;
                    }
                    return;
                }
                () = group.closed() => {
                    let mut groups = self.lock();
                    // viewers join under the lock
                    if group.receiver_count() == 0 {
                        groups.remove(key);
                        return;
                    }
                }
            }
        }
    }

    /// Drops the oldest whole groups of a room beyond [`KEPT`].
    fn drop_older(&self, room: &str) {
        let mut groups = self.lock();
        let of_room = groups.iter().filter(|((name, _), group)| name == room && group.borrow().end == Some(End::Whole));
        let whole: Vec<RoomGroup> = of_room.map(|(key, _)| key.clone()).collect();
        for key in whole.iter().rev().skip(KEPT) {
            if let Some(group) = groups.remove(key) {
                self.drop_pieces(&group);
            }
        }
    }

    /// Frees the memory of a group that viewers may still read.
    fn drop_pieces(&self, group: &Arriving) {
        group.send_modify(|group| {
            let pieces = std::mem::take(&mut group.pieces);
            self.bytes.fetch_sub(pieces.iter().map(Bytes::len).sum(), Ordering::Relaxed);
            group.end = Some(End::Broken);
        });
    }

    /// Adds a piece to a group, in place of the oldest whole groups if all take too many bytes; false if it finds no room.
    fn add(&self, group: &Arriving, piece: Bytes) -> bool {
        // only this adds bytes, under the lock
        let mut groups = self.lock();
        while self.bytes.load(Ordering::Relaxed) + piece.len() > self.most {
            let whole = groups.iter().filter_map(|(key, group)| Some((group.borrow().whole_since?, key)));
            let Some(oldest) = whole.min().map(|(_, key)| key.clone()) else { return false };
            if let Some(oldest) = groups.remove(&oldest) {
                self.drop_pieces(&oldest);
            }
        }
        self.bytes.fetch_add(piece.len(), Ordering::Relaxed);
        group.send_modify(|group| group.pieces.push(piece));
        true
    }

    /// Reads an origin's answer; returns whether it is whole.
    async fn fill(&self, fetch: impl Future<Output = Result<Response<Body>, Problem>>, group: &Arriving) -> bool {
        let mut body = match fetch.await {
            Ok(answer) => answer.into_body().into_data_stream(),
            Err(problem) => {
                group.send_modify(|group| group.found = Some(Err(problem)));
                return false;
            }
        };
        group.send_modify(|group| group.found = Some(Ok(())));
        while let Some(piece) = body.next().await {
            let Ok(piece) = piece else { return false };
            if !self.add(group, piece) {
                return false;
            }
        }
        group.send_modify(|group| (group.end, group.whole_since) = (Some(End::Whole), Some(Instant::now())));
        true
    }
}

/// The pieces of a group, as they arrive.
fn pieces(arrived: watch::Receiver<Arrived>) -> impl Stream<Item = io::Result<Bytes>> + Send {
    stream::try_unfold((arrived, 0), |(mut arrived, at)| async move {
        let next = {
            let group = arrived.wait_for(|group| group.pieces.len() > at || group.end.is_some()).await.map_err(io::Error::other)?;
            match group.pieces.get(at) {
                Some(piece) => Some(piece.clone()),
                None if group.end == Some(End::Whole) => None,
                // an error, so that caches see that the response is incomplete
                None => return Err(io::Error::other("the group was dropped")),
            }
        };
        Ok(next.map(|piece| (piece, (arrived, at + 1))))
    })
}

#[cfg(test)]
mod tests {
    use axum::body::to_bytes;
    use tokio::sync::{mpsc, oneshot};

    use super::*;

    fn key(number: u64) -> RoomGroup {
        ("attic".to_owned(), Group { epoch: 1, number })
    }

    fn answer(pieces: mpsc::UnboundedReceiver<io::Result<Bytes>>) -> Response<Body> {
        let pieces = stream::unfold(pieces, |mut pieces| async move { pieces.recv().await.map(|piece| (piece, pieces)) });
        Response::new(Body::from_stream(pieces))
    }

    async fn whole(body: Body) -> Option<Bytes> {
        to_bytes(body, usize::MAX).await.ok()
    }

    async fn until(is_so: impl Fn() -> bool) {
        while !is_so() {
            tokio::task::yield_now().await;
        }
    }

    fn never() -> std::future::Pending<Result<Response<Body>, Problem>> {
        std::future::pending()
    }

    #[tokio::test]
    async fn viewers_of_a_group_share_one_fetch_and_those_who_come_late_get_all_of_it() {
        let relay = Arc::new(GroupRelay::default());
        let (send, pieces) = mpsc::unbounded_channel();
        let first = relay.get(key(0), async { Ok(answer(pieces)) }).await.unwrap();
        send.send(Ok(Bytes::from_static(b"one "))).unwrap();
        let second = relay.get(key(0), never()).await.unwrap();
        send.send(Ok(Bytes::from_static(b"two"))).unwrap();
        drop(send);
        assert_eq!((whole(first).await.unwrap(), whole(second).await.unwrap()), ("one two".into(), "one two".into()));
        assert_eq!(whole(relay.get(key(0), never()).await.unwrap()).await.unwrap(), "one two");
    }

    #[tokio::test]
    async fn a_group_that_breaks_off_or_is_missing_is_fetched_anew() {
        let relay = Arc::new(GroupRelay::default());
        let missing = relay.get(key(0), async { Err(Problem::not_found("there is none")) }).await;
        assert_eq!(missing.unwrap_err().status, 404);
        let (send, pieces) = mpsc::unbounded_channel();
        send.send(Err(io::Error::other("the origin has gone"))).unwrap();
        until(|| !relay.lock().contains_key(&key(0))).await;
        let broken = relay.get(key(0), async { Ok(answer(pieces)) }).await.unwrap();
        assert_eq!(whole(broken).await, None);
        until(|| !relay.lock().contains_key(&key(0))).await;
        let again = relay.get(key(0), async { Ok(Response::new(Body::from("all"))) }).await.unwrap();
        assert_eq!(whole(again).await.unwrap(), "all");
    }

    #[tokio::test]
    async fn a_group_that_no_viewer_wants_any_more_is_not_fetched_on() {
        let relay = Arc::new(GroupRelay::default());
        let (dropped, gone) = oneshot::channel::<()>();
        let fetch = async move {
            let _dropped = dropped;
            never().await
        };
        let viewer = tokio::spawn({
            let relay = Arc::clone(&relay);
            async move { relay.get(key(0), fetch).await.map(drop) }
        });
        until(|| !relay.lock().is_empty()).await;
        viewer.abort();
        assert!(gone.await.is_err(), "the request ends");
        assert!(relay.lock().is_empty());
    }

    #[tokio::test]
    async fn groups_of_all_rooms_make_place_for_newer_ones() {
        let relay = Arc::new(GroupRelay { most: 10, ..GroupRelay::default() });
        let get = async |room: &str, text: &'static str| {
            let key = (room.to_owned(), Group { epoch: 1, number: 0 });
            whole(relay.get(key, async move { Ok(Response::new(Body::from(text))) }).await.unwrap()).await
        };
        for room in ["one", "two", "three"] {
            assert_eq!(get(room, "four").await.unwrap(), "four");
        }
        let kept: Vec<String> = relay.lock().keys().map(|(room, _)| room.clone()).collect();
        assert_eq!((kept, relay.bytes.load(Ordering::Relaxed)), (vec!["three".to_owned(), "two".to_owned()], 8));
        assert_eq!(get("large", "more than ten").await, None);
        until(|| relay.lock().is_empty()).await;
        until(|| relay.bytes.load(Ordering::Relaxed) == 0).await;
        assert_eq!(get("next", "ten").await.unwrap(), "ten");
    }

    #[tokio::test]
    async fn only_the_newest_whole_groups_of_a_room_are_kept() {
        let relay = Arc::new(GroupRelay::default());
        let mut slow = Vec::new();
        for number in 0..2 * KEPT as u64 {
            let body = relay.get(key(number), async { Ok(Response::new(Body::from("all"))) }).await.unwrap();
            until(|| relay.lock().get(&key(number)).is_some_and(|group| group.borrow().end == Some(End::Whole))).await;
            slow.push(body);
        }
        until(|| relay.lock().len() <= KEPT).await;
        let kept: Vec<u64> = relay.lock().keys().map(|(_, group)| group.number).collect();
        assert_eq!(kept, [4, 5, 6, 7]);
        let last = slow.pop().unwrap();
        assert_eq!(whole(last).await.unwrap(), "all");
        assert_eq!(whole(slow.remove(0)).await, None, "it was dropped");
    }
}
