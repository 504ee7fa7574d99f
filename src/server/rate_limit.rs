//! Rate limits: a token bucket for each key and each address (GCRA).

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use axum::extract::{MatchedPath, Request};
use axum::http::{HeaderName, Method, StatusCode};
use axum::response::Response;

use super::conditional::insert;
use super::limits;
use super::problem::Problem;
use tmpi_library::client_network;

/// Current state of a bucket.
const RATE_LIMIT: HeaderName = HeaderName::from_static("ratelimit");
/// Policy of a bucket.
const POLICY: HeaderName = HeaderName::from_static("ratelimit-policy");
/// Period of the limits; a bucket holds as many tokens as refill in it.
const WINDOW: Duration = Duration::from_mins(1);
/// Most callers to track; full buckets are dropped first, then the half with the fewest requests.
const MOST: usize = 100_000;

/// Owner of a bucket.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub enum RateKey {
    /// Holder of the key with this name.
    Key(String),
    /// Client at this address.
    Address(IpAddr),
}

impl RateKey {
    /// By the name of a key, else by address; `None` if neither is known.
    pub fn of(key: Option<String>, address: Option<IpAddr>) -> Option<Self> {
        key.map(Self::Key).or_else(|| address.map(client_network).map(Self::Address))
    }
}

/// A limit and its buckets.
#[derive(Debug)]
struct Buckets {
    name: &'static str,
    /// Tokens in a full bucket; as many refill in [`WINDOW`].
    most: u32,
    /// When each bucket is full again.
    full: Mutex<HashMap<RateKey, Instant>>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct BucketState {
    name: &'static str,
    most: u32,
    left: u32,
    /// Seconds until it is full, rounded up.
    reset: u64,
    /// Seconds until the next token, rounded up, if there was none.
    wait: Option<u64>,
}

fn seconds_up(time: Duration) -> u64 {
    time.as_secs() + u64::from(time.subsec_nanos() > 0)
}

impl Buckets {
    fn new(name: &'static str, most: u32) -> Option<Self> {
        (most > 0).then(|| Self { name, most, full: Mutex::default() })
    }

    /// Takes a token of `client`'s bucket, if it has one.
    fn take(&self, client: &RateKey, now: Instant) -> BucketState {
        let each = WINDOW / self.most;
        let mut all = self.full.lock().unwrap_or_else(PoisonError::into_inner);
        let missing = all.get(client).map_or(Duration::ZERO, |full| full.saturating_duration_since(now));
        let fits = missing + each <= WINDOW;
        let after = if fits { missing + each } else { missing };
        if fits {
            if all.len() >= MOST && !all.contains_key(client) {
                all.retain(|_, full| *full > now);
                if all.len() >= MOST {
                    // keep those with the most requests, so that a flood of addresses does not reset their buckets
                    let mut times: Vec<Instant> = all.values().copied().collect();
                    let (_, middle, _) = times.select_nth_unstable(MOST / 2);
                    let middle = *middle;
                    all.retain(|_, full| *full > middle);
                }
            }
            all.insert(client.clone(), now + after);
        }
        let left = (WINDOW.saturating_sub(after).as_nanos() / each.as_nanos().max(1)) as u32;
        let wait = (!fits).then(|| seconds_up((missing + each).saturating_sub(WINDOW)));
        BucketState { name: self.name, most: self.most, left: left.min(self.most), reset: seconds_up(after), wait }
    }
}

#[derive(Debug)]
pub struct RateLimiter {
    requests: Option<Buckets>,
    uploads: Option<Buckets>,
    views: Option<Buckets>,
}

/// Rate-limit headers for the answer.
#[derive(Debug, Default)]
pub struct RateHeaders(Vec<BucketState>);

impl RateLimiter {
    pub fn new(limits: &limits::Rates) -> Self {
        Self {
            requests: Buckets::new("requests", limits.requests),
            uploads: Buckets::new("uploads", limits.uploads),
            views: Buckets::new("views", limits.views),
        }
    }

    /// The additional limit of a request, by its method and route.
    fn class(&self, method: &Method, path: &str) -> Option<&Buckets> {
        match (method, path) {
            (&Method::POST, "/v1/photos" | "/v1/photos/{id}/remake") | (&Method::PATCH, "/v1/photos/{id}/strokes") => self.uploads.as_ref(),
            // HEAD renders, too, to know the length
            (&Method::GET | &Method::HEAD, "/v1/photos/{id}/view" | "/v1/photos/{id}/export")
            | (&Method::POST, "/v1/photos/{id}/exports") => self.views.as_ref(),
            _ => None,
        }
    }

    /// Counts a request.
    ///
    /// # Errors
    /// 429 that names the exceeded limit and says when to retry.
    pub fn count(&self, client: Option<RateKey>, request: &Request) -> (RateHeaders, Result<(), Problem>) {
        let path = request.extensions().get::<MatchedPath>().map_or("", MatchedPath::as_str);
        self.take(client, request.method(), path)
    }

    fn take(&self, client: Option<RateKey>, method: &Method, path: &str) -> (RateHeaders, Result<(), Problem>) {
        let mut told = RateHeaders::default();
        let Some(client) = client else { return (told, Ok(())) };
        let now = Instant::now();
        for buckets in self.requests.iter().chain(self.class(method, path)) {
            let standing = buckets.take(&client, now);
            told.0.push(standing);
            if let Some(seconds) = standing.wait {
                let of = if matches!(client, RateKey::Key(_)) { "key" } else { "address" };
                let detail = format!("{} are {} a minute at most for a {of}", standing.name, standing.most);
                let problem = Problem::registered(StatusCode::TOO_MANY_REQUESTS, "quota-exceeded", detail).retry_after(seconds.max(1));
                return (told, Err(problem));
            }
        }
        (told, Ok(()))
    }
}

impl RateHeaders {
    /// Sets the headers of draft-ietf-httpapi-ratelimit-headers.
    pub fn put(&self, response: &mut Response) {
        if self.0.is_empty() {
            return;
        }
        let list = |item: fn(&BucketState) -> String| self.0.iter().map(item).collect::<Vec<_>>().join(", ");
        insert(response, POLICY, &list(|of| format!("\"{}\";q={};w={}", of.name, of.most, WINDOW.as_secs())));
        insert(response, RATE_LIMIT, &list(|of| format!("\"{}\";r={};t={}", of.name, of.left, of.wait.unwrap_or(of.reset))));
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn address(text: &str) -> RateKey {
        RateKey::of(None, Some(text.parse().unwrap())).unwrap()
    }

    #[test]
    fn each_client_has_its_own_bucket() {
        let (buckets, start) = (Buckets::new("uploads", 3).unwrap(), Instant::now());
        let (ann, bob) = (address("192.0.2.1"), RateKey::of(Some("site".into()), Some("192.0.2.1".parse().unwrap())).unwrap());
        let left: Vec<_> = (0..3).map(|_| buckets.take(&ann, start).left).collect();
        assert_eq!(left, [2, 1, 0]);
        let refused = buckets.take(&ann, start);
        assert_eq!((refused.wait, refused.left, refused.reset), (Some(20), 0, 60));
        assert_eq!(buckets.take(&bob, start).wait, None, "a key has its own");
        assert_eq!(buckets.take(&address("192.0.2.2"), start).left, 2);
        let later = start + Duration::from_secs(19);
        assert_eq!(buckets.take(&ann, later).wait, Some(1));
        assert_eq!(buckets.take(&ann, start + Duration::from_secs(20)).wait, None);
        assert_eq!(buckets.take(&ann, start + Duration::from_mins(9)).left, 2, "no fuller than full");
    }

    #[test]
    fn an_ipv6_network_is_one_client_and_unknown_clients_are_not_counted() {
        assert_eq!(address("2001:db8::1"), address("2001:db8::2"));
        assert_ne!(address("2001:db8::1"), address("2001:db8:0:1::1"));
        let rates = RateLimiter::new(&limits::Rates { requests: 1, ..limits::Rates::default() });
        let take = |client| rates.take(client, &Method::GET, "/").1;
        assert!((0..9).all(|_| take(RateKey::of(None, None)).is_ok()));
        let one = || Some(address("192.0.2.1"));
        assert!(take(one()).is_ok());
        let refused = take(one()).unwrap_err();
        assert_eq!((refused.status, refused.retry_after), (429, Some(60)));
    }

    #[test]
    fn a_head_request_for_a_view_counts_as_a_view() {
        let rates = RateLimiter::new(&limits::Rates { views: 1, ..limits::Rates::default() });
        for (n, path) in ["/v1/photos/{id}/view", "/v1/photos/{id}/export"].into_iter().enumerate() {
            let take = |method| rates.take(Some(RateKey::Key(n.to_string())), &method, path).1;
            assert!(take(Method::HEAD).is_ok() && take(Method::OPTIONS).is_ok(), "{path}");
            for method in [Method::HEAD, Method::GET] {
                assert_eq!(take(method).unwrap_err().status, 429, "{path}");
            }
        }
        let atlas = || rates.take(Some(RateKey::Key(String::new())), &Method::HEAD, "/v1/photos/{id}/atlas").1;
        assert!((0..9).all(|_| atlas().is_ok()));
    }

    #[test]
    fn full_buckets_are_dropped_first() {
        let (buckets, start) = (Buckets::new("requests", 1).unwrap(), Instant::now());
        for n in 0..MOST {
            buckets.take(&RateKey::Key(n.to_string()), start);
        }
        buckets.take(&RateKey::Key("late".into()), start + Duration::from_mins(2));
        assert_eq!(buckets.full.lock().unwrap().len(), 1);
    }

    #[test]
    fn a_flood_of_addresses_does_not_reset_the_busiest_bucket() {
        let (buckets, start) = (Buckets::new("requests", 2).unwrap(), Instant::now());
        let greedy = RateKey::Key("greedy".into());
        for is_left in [true, true, false] {
            assert_eq!(buckets.take(&greedy, start).wait.is_none(), is_left);
        }
        for n in 0..2 * MOST {
            buckets.take(&RateKey::Key(n.to_string()), start);
        }
        assert!(buckets.full.lock().unwrap().len() <= MOST);
        assert!(buckets.take(&greedy, start).wait.is_some());
    }

    proptest! {
        #[test]
        fn no_client_gets_more_than_a_full_bucket_and_its_refill(most in 1..200_u32, pauses in prop::collection::vec(0..5000_u64, 1..300)) {
            let (buckets, start) = (Buckets::new("requests", most).unwrap(), Instant::now());
            let (mut now, mut let_in) = (start, Vec::new());
            for pause in pauses {
                now += Duration::from_millis(pause);
                let standing = buckets.take(&RateKey::Key(String::new()), now);
                if standing.wait.is_none() {
                    let_in.push(now);
                }
                prop_assert!(standing.left <= most && standing.reset <= WINDOW.as_secs());
                // after the announced wait there is a token
                if let Some(seconds) = standing.wait {
                    let probe = Buckets::new("requests", most).unwrap();
                    *probe.full.lock().unwrap() = buckets.full.lock().unwrap().clone();
                    let later = probe.take(&RateKey::Key(String::new()), now + Duration::from_secs(seconds));
                    prop_assert!(later.wait.is_none());
                }
            }
            for (i, from) in let_in.iter().enumerate() {
                for (j, to) in let_in.iter().enumerate().skip(i) {
                    let most = f64::from(most) * (1.0 + to.duration_since(*from).as_secs_f64() / WINDOW.as_secs_f64());
                    prop_assert!((j - i + 1) as f64 <= most + 1e-6, "{} in {:?}", j - i + 1, to.duration_since(*from));
                }
            }
        }
    }
}
