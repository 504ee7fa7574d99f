//! Who may do what where access is private: one place that every request goes through.
//!
//! Whoever uploads owns. An owner is known by a hash of a secret that they keep: an API key's name, or a secret of one's own, which a
//! browser keeps in a cookie that no script reads, so that pictures, event streams and workers send it by themselves. What somebody may not
//! have answers as what is not there.

mod cookies;
pub mod keys;
mod links;
mod manage;
mod needs;
mod secret;
mod ticket;
mod who;

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use axum::extract::{MatchedPath, Request};
use axum::http::{HeaderMap, Method, StatusCode, Version, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::entry::Entry;
use super::hosts::Hosts;
use super::id::{PhotoId, hex};
use super::problem::Problem;
use super::rates::{Asker, Rates, Told};
use super::settings::Visibility;
use super::share::asker;
use super::time::now_ms;
use crate::live::check_origin;
use cookies::{LINK_COOKIE, cookie, keep_private, manage_cookie, owner_cookie, set_cookie};
pub use cookies::{set_manage, set_owner};
use keys::{Keys, KeysError, Scope};
use links::{Asked, Link};
pub(super) use links::{link_of_url, take_link};
use manage::seal;
use needs::{Need, need, refusal};
pub use secret::{Secret, same};
pub use ticket::SECONDS as TICKET_SECONDS;
use who::{Who, bearer, fresh, is_secret};

/// Whose a photo is: a hash, from which the secret does not follow.
#[derive(Clone, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Owner(String);

impl Owner {
    fn of(kind: &str, text: &str) -> Self {
        Self(hex(&Sha256::digest(format!("tmpi owner 1\0{kind}\0{text}"))))
    }

    /// By a secret of their own.
    #[must_use]
    pub fn of_secret(secret: &str) -> Self {
        Self::of("secret", secret)
    }

    /// Whoever has a key of this name.
    #[must_use]
    pub fn of_keys(name: &str) -> Self {
        Self::of("keys", name)
    }

    /// This machine's own user.
    fn own() -> Self {
        Self::of("own", "")
    }

    /// True for this machine's own user.
    #[must_use]
    pub fn is_own(&self) -> bool {
        *self == Self::own()
    }

    /// As text: a hash in hex.
    pub(super) fn text(&self) -> &str {
        &self.0
    }
}

/// A request's caller, and what it may have.
struct Caller {
    who: Who,
    owner: Option<Owner>,
    link: Option<Link>,
    /// A photo's own token.
    token: Option<String>,
    need: Need,
    /// Something that not everybody may see is answered.
    private: AtomicBool,
    /// The link let in whoever would not have been without it.
    linked: AtomicBool,
}

tokio::task_local! {
    static CALLER: Arc<Caller>;
}

fn caller() -> Option<Arc<Caller>> {
    CALLER.try_with(Arc::clone).ok()
}

/// What a caller was let in by.
pub struct Pass(Arc<Caller>);

/// What decides.
pub struct Guard {
    secret: Secret,
    keys: Keys,
}

/// Who uploads.
pub struct Uploader {
    /// Whose the photo will be.
    pub owner: Owner,
    /// They were nobody before: nobody has the secret of this owner, who is there for this one photo.
    pub is_new: bool,
}

impl Guard {
    /// By a secret and the keys of a data directory.
    ///
    /// # Errors
    /// These cannot be read.
    pub fn open(dir: &Path, secret: Secret) -> std::io::Result<Self> {
        let keys = Keys::open(dir).map_err(|e| match e {
            KeysError::Disk(e) => e,
            e => std::io::Error::new(std::io::ErrorKind::InvalidData, e.to_string()),
        })?;
        Ok(Self { secret, keys })
    }

    /// Lets in whoever may ask a request as often as they do, and takes a link off its address.
    ///
    /// # Errors
    /// 401, 403 and 404 by who asks for what, 429 where they ask too often.
    pub fn admit(&self, hosts: &Hosts, rates: &Rates, request: &mut Request) -> (Told, Result<Pass, Problem>) {
        let come = self.come_in(hosts, request);
        // who is refused has asked, too
        let key = come.as_ref().ok().and_then(|caller| if let Who::Key(key) = &caller.who { Some(key.name.clone()) } else { None });
        let (told, taken) = rates.count(Asker::of(key, asker()), request);
        (told, taken.and(come).map(|caller| Pass(Arc::new(caller))))
    }

    /// Answers a request by `next`, with who was let in at hand for the handlers.
    pub async fn answer(&self, Pass(caller): Pass, request: Request, next: Next) -> Response {
        let path = request.uri().path().to_owned();
        let headers = request.headers().clone();
        let link = request.extensions().get::<Asked>().and_then(|asked| asked.0.clone());
        let mut response = CALLER.scope(Arc::clone(&caller), next.run(request)).await;
        // a list is of who asks, also where it has nothing
        if caller.need == Need::List || caller.private.load(Ordering::Relaxed) {
            keep_private(&mut response);
        }
        if path == "/" && response.status() != StatusCode::NOT_MODIFIED {
            let secret = match &caller.who {
                Who::Owner(secret) => Ok(secret.clone()),
                // one that is there is not lost, though a link of another site led here
                Who::Stranger if matches!(self.of_cookie(&headers), Who::Stranger) => fresh(),
                _ => return response,
            };
            match secret {
                Ok(secret) => set_owner(&mut response, &headers, &secret),
                Err(problem) => return problem.into_response(),
            }
        }
        if let Some((id, link)) = opened(&path).zip(link).filter(|_| caller.linked.load(Ordering::Relaxed)) {
            let Link { expires, signature } = link;
            let (age, at) = (expires.saturating_sub(now()), format!("/v1/photos/{id}"));
            set_cookie(&mut response, &headers, &format!("{LINK_COOKIE}={expires}.{signature}"), &at, age);
        }
        response
    }

    /// Says who asks, and refuses what none of them may.
    fn come_in(&self, hosts: &Hosts, request: &mut Request) -> Result<Caller, Problem> {
        let need = match request.extensions().get::<MatchedPath>() {
            // the answer that there is nothing, or to what a browser asks before a request
            None => Need::Nothing,
            Some(_) if *request.method() == Method::OPTIONS => Need::Nothing,
            Some(path) => need(request.method(), path.as_str()).ok_or_else(|| refusal(request.method(), path.as_str()))?,
        };
        let asked = take_link(request.uri()).map(|(uri, link)| {
            *request.uri_mut() = uri;
            link
        });
        let is_of_page = || request.extensions().get::<MatchedPath>().is_some_and(|path| path.as_str() == "/oembed");
        let asked = asked.or_else(|| is_of_page().then(|| link_of_url(request.uri())));
        let (who, token) = if need == Need::Room { (Who::Stranger, None) } else { self.who(hosts, request)? };
        let of_cookie = || cookie(request.headers(), LINK_COOKIE).and_then(Link::of_cookie);
        let link = asked.clone().unwrap_or_else(|| of_cookie().filter(|_| check_origin(request.headers()).is_ok()));
        request.extensions_mut().insert(Asked(asked.flatten()));
        match need {
            Need::Upload => who.has_leave(Scope::Upload, "upload")?,
            Need::List => who.has_leave(Scope::Read, "read")?,
            Need::Metrics if !who.is_told(Scope::Metrics) => {
                let detail = "this is for this machine's own user, at a loopback address, and for keys with the scope metrics or admin";
                return Err(Problem::new(StatusCode::FORBIDDEN, "not-yours", detail));
            }
            Need::Admin if !who.is_admin() => {
                let detail = "this is for this machine's own user, at a loopback address, and for keys with the scope admin";
                return Err(Problem::new(StatusCode::FORBIDDEN, "not-yours", detail));
            }
            _ => {}
        }
        Ok(Caller { owner: who.owner(), who, link, token, need, private: AtomicBool::new(false), linked: AtomicBool::new(false) })
    }

    /// Who asks, and a photo's token that they have besides. A key, secret or token that is sent counts alone; else what a browser sends by
    /// itself, where no other site's page made it do so.
    fn who(&self, hosts: &Hosts, request: &Request) -> Result<(Who, Option<String>), Problem> {
        let headers = request.headers();
        let unknown = || {
            let detail = "the key is unknown or no longer good, or the secret is none";
            let problem = Problem::new(StatusCode::UNAUTHORIZED, "key", detail).field("Authorization");
            problem.header(header::WWW_AUTHENTICATE, "Bearer error=\"invalid_token\"")
        };
        // other schemes are a proxy's affair, which passes on what it let in by
        let mut given = headers.get_all(header::AUTHORIZATION).iter().filter_map(bearer);
        if let Some(text) = given.next() {
            if given.next().is_some() {
                return Err(unknown());
            }
            if text.starts_with(keys::PREFIX) {
                let found = self.keys.find(text).map_err(|e| {
                    tracing::error!(error = %e, "keys cannot be read; none counts");
                    Problem::new(StatusCode::SERVICE_UNAVAILABLE, "keys", "the server's keys cannot be read: its log says more")
                })?;
                return found.map(|key| (Who::Key(key), None)).ok_or_else(unknown);
            }
            let who = self.of_ticket(text, now()).map(Who::Ticket).or_else(|| Who::of_bearer(text)).ok_or_else(unknown)?;
            let token = matches!(who, Who::Manager).then(|| text.to_owned());
            return Ok((who, token));
        }
        if check_origin(headers).is_err() {
            return Ok((Who::Stranger, None));
        }
        let token = manage_cookie(headers).filter(|text| manage::is_token(text)).map(str::to_owned);
        // by HTTP/1.0 come proxies that were told nothing, who name neither the client nor the host that was asked for
        if hosts.is_own(headers) && request.version() != Version::HTTP_10 {
            return Ok((Who::Own, token));
        }
        Ok((self.of_cookie(headers), token))
    }

    /// Whoever a browser keeps the secret of.
    fn of_cookie(&self, headers: &HeaderMap) -> Who {
        let kept = owner_cookie(headers).filter(|text| is_secret(text) || self.is_browser(text));
        kept.map_or(Who::Stranger, |text| Who::Owner(text.to_owned()))
    }

    /// Whether a browser is already known as another owner than this one.
    #[must_use]
    pub fn is_another(&self, headers: &HeaderMap, owner: &Owner) -> bool {
        self.of_cookie(headers).owner().is_some_and(|kept| !same(kept.0.as_bytes(), owner.0.as_bytes()))
    }

    fn opens(&self, link: &Link, entry: &Entry) -> bool {
        self.secret.is_good(&seal(entry), link.expires, &link.signature, now())
    }

    /// Whether the caller of this request may have a photo as the request means to.
    #[must_use]
    pub fn allows(&self, entry: &Entry) -> bool {
        // without a caller nobody was let in
        caller().is_some_and(|caller| self.lets(&caller, entry))
    }

    fn lets(&self, caller: &Caller, entry: &Entry) -> bool {
        let everybodys = || entry.settings().visibility == Some(Visibility::Link);
        match caller.need {
            Need::Read if everybodys() => return true,
            Need::Read | Need::List if caller.has(entry, Scope::Read) => {}
            Need::Change | Need::Own if caller.has(entry, Scope::Upload) => {}
            Need::Read | Need::Change if self.is_managed(caller, entry) => {}
            Need::Read if caller.link.as_ref().is_some_and(|link| self.opens(link, entry)) => caller.linked.store(true, Ordering::Relaxed),
            _ => return false,
        }
        caller.private.store(true, Ordering::Relaxed);
        true
    }

    /// Whether the caller of this request, whatever it asks, may change a photo. An answer that depends on it is theirs alone where it is so.
    #[must_use]
    pub fn may_change(&self, entry: &Entry) -> bool {
        let caller = caller().filter(|caller| caller.has(entry, Scope::Upload) || self.is_managed(caller, entry));
        if let Some(caller) = &caller {
            caller.private.store(true, Ordering::Relaxed);
        }
        caller.is_some()
    }

    /// What the caller of this request was let in by, for answers that go on; none where there is no caller.
    #[must_use]
    pub fn pass() -> Option<Pass> {
        caller().map(Pass)
    }

    /// Whether a caller who was let in would be let in again: their key may be gone by now, the link's time over, or the photo no longer
    /// everybody's.
    #[must_use]
    pub fn still_allows(&self, Pass(caller): &Pass, entry: &Entry) -> bool {
        // keys that cannot be read let nobody in
        let good = if let Who::Key(key) = &caller.who { self.keys.is_still(key).unwrap_or(false) } else { true };
        good && self.lets(caller, entry)
    }

    /// Whose the photo will be that the caller of this request uploads.
    ///
    /// # Errors
    /// 500 where the system has no random bytes.
    pub fn uploader() -> Result<Uploader, Problem> {
        if let Some(owner) = caller().and_then(|caller| caller.owner.clone()) {
            return Ok(Uploader { owner, is_new: false });
        }
        Ok(Uploader { owner: Owner::of_secret(&fresh()?), is_new: true })
    }

    /// Who the caller of this request is known as; none where they have no secret.
    #[must_use]
    pub fn owner() -> Option<Owner> {
        caller().and_then(|caller| caller.owner.clone())
    }

    /// Whether the caller of this request has everybody's photos.
    #[must_use]
    pub fn has_all() -> bool {
        caller().is_some_and(|caller| caller.who.is_admin())
    }

    /// Id of an owner's photo, where `content` names what it is made of.
    #[must_use]
    pub fn id(&self, owner: &Owner, content: PhotoId) -> PhotoId {
        self.secret.id(owner, content)
    }

    /// The query of a link by which a photo can be read until `expires`, in seconds since 1970.
    #[must_use]
    pub fn query(&self, entry: &Entry, expires: u64) -> String {
        format!("expires={expires}&signature={}", self.secret.link(&seal(entry), expires))
    }
}

impl Caller {
    fn has(&self, entry: &Entry, scope: Scope) -> bool {
        let own = entry.accepted.owner.as_ref().zip(self.owner.as_ref());
        self.who.is_admin() || self.who.may(scope) && own.is_some_and(|(a, b)| same(a.0.as_bytes(), b.0.as_bytes()))
    }
}

/// Who is to be the owner by what who asks came with, and what a browser is to keep for it: a secret, or what a ticket is exchanged for.
#[must_use]
pub fn to_keep(guard: &Guard) -> Option<(Owner, String)> {
    match &caller()?.who {
        who @ Who::Owner(kept) => Some((who.owner()?, kept.clone())),
        Who::Ticket(owner) => Some((owner.clone(), guard.of_browser(owner))),
        _ => None,
    }
}

/// The owner by a secret that who asks is.
#[must_use]
pub fn owner_by_secret() -> Option<Owner> {
    caller().and_then(|caller| if let Who::Owner(_) = &caller.who { caller.who.owner() } else { None })
}

/// The photo's own token that who asks came with.
#[must_use]
pub fn token() -> Option<String> {
    caller().and_then(|caller| caller.token.clone())
}

/// The query of the link that let in the caller of this request, where nothing else did.
#[must_use]
pub fn link() -> Option<String> {
    caller().filter(|caller| caller.linked.load(Ordering::Relaxed))?.link.as_ref().map(Link::query)
}

/// Takes a link off a request's address where nobody is asked who they are: it has no say there.
pub fn drop_link(request: &mut Request) {
    if let Some((uri, _)) = take_link(request.uri()) {
        *request.uri_mut() = uri;
    }
}

/// Seconds since 1970.
#[must_use]
pub fn now() -> u64 {
    now_ms() / 1000
}

/// The photo whose page is at a path.
fn opened(path: &str) -> Option<PhotoId> {
    path.strip_prefix("/view/").or_else(|| path.strip_prefix("/embed/"))?.parse().ok()
}
