//! Who may do what where access is private: one place that every request goes through.
//!
//! Whoever uploads owns. An owner is known by a hash of a secret that they keep: an API key's name, or a secret of one's own, which a
//! browser keeps in a cookie that no script reads, so that pictures, event streams and workers send it by themselves. What somebody may not
//! have answers as what is not there.

mod cookies;
mod links;
mod manage;
mod needs;
mod who;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use axum::extract::{MatchedPath, Request};
use axum::http::{HeaderMap, Method, StatusCode, Version, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use tmpi_library::{Grant, KEY_PREFIX, Library, Link, Millis, Owner, Photo, PhotoId, SESSION_PREFIX, Scope, Subject};

use super::hosts::Hosts;
use super::problem::Problem;
use super::rates::{Asker, Rates, Told};
use super::settings::{Settings, Visibility};
use super::share::asker;
use crate::live::check_origin;
use cookies::{KEPT, LINK_COOKIE, cookie, keep_private, manage_cookie, owner_cookie, set_cookie};
pub use cookies::{set_manage, set_owner};
use links::Asked;
pub(super) use links::{link_of_url, query_of, take_link};
use needs::{Need, need, refusal};
use who::{Who, bearer, fresh, is_secret};

/// How long another browser can be made the same owner.
pub const TICKET: Duration = Duration::from_mins(15);
/// What a ticket begins with: a session that soon ends, and is good for nothing but another one.
const TICKET_PREFIX: &str = "tmpi_t_";

/// A request's caller, and what it may have.
struct Caller {
    who: Who,
    owner: Option<Owner>,
    link: Option<Link>,
    /// When it came, by the database's clock; only where it came with a link or a token.
    at: Millis,
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
    library: Library,
}

/// Who uploads.
pub struct Uploader {
    /// Whose the photo will be.
    pub owner: Owner,
    /// They were nobody before: nobody has the secret of this owner, who is there for this one photo.
    pub is_new: bool,
}

impl Guard {
    /// By the keys, sessions and links of a library.
    #[must_use]
    pub const fn new(library: Library) -> Self {
        Self { library }
    }

    /// Lets in whoever may ask a request as often as they do, and takes a link off its address.
    ///
    /// # Errors
    /// 401, 403 and 404 by who asks for what, 429 where they ask too often.
    pub async fn admit(&self, hosts: &Hosts, rates: &Rates, request: &mut Request) -> (Told, Result<Pass, Problem>) {
        let come = self.come_in(hosts, request).await;
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
                Who::Owner(_, kept) => Ok(kept.clone()),
                // one that is there is not lost, though a link of another site led here
                Who::Stranger if matches!(self.of_cookie(&headers).await, Ok(Who::Stranger)) => fresh(),
                _ => return response,
            };
            match secret {
                Ok(secret) => set_owner(&mut response, &headers, &secret),
                Err(problem) => return problem.into_response(),
            }
        }
        if let Some((id, link)) = opened(&path).zip(link).filter(|_| caller.linked.load(Ordering::Relaxed)) {
            let (age, at) = (link.expires.saturating_sub(seconds(caller.at)), format!("/v1/photos/{id}"));
            set_cookie(&mut response, &headers, &format!("{LINK_COOKIE}={link}"), &at, age);
        }
        response
    }

    /// Says who asks, and refuses what none of them may.
    async fn come_in(&self, hosts: &Hosts, request: &mut Request) -> Result<Caller, Problem> {
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
        let is_of_page = request.extensions().get::<MatchedPath>().is_some_and(|path| path.as_str() == "/oembed");
        let asked = asked.or_else(|| is_of_page.then(|| link_of_url(request.uri())));
        let (who, token) =
            if need == Need::Room { (Who::Stranger, None) } else { self.who(hosts, request.headers(), request.version()).await? };
        let link = asked.clone().unwrap_or_else(|| {
            let of_cookie = cookie(request.headers(), LINK_COOKIE).and_then(|text| text.parse().ok());
            of_cookie.filter(|_| check_origin(request.headers()).is_ok())
        });
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
        let at = if link.is_some() || token.is_some() { self.library.now().await? } else { 0 };
        Ok(Caller { owner: who.owner(), who, link, at, token, need, private: AtomicBool::new(false), linked: AtomicBool::new(false) })
    }

    /// Who asks, and a photo's token that they have besides. A key, secret or token that is sent counts alone; else what a browser sends by
    /// itself, where no other site's page made it do so.
    async fn who(&self, hosts: &Hosts, headers: &HeaderMap, version: Version) -> Result<(Who, Option<String>), Problem> {
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
            if text.starts_with(KEY_PREFIX) {
                let found = self.library.find_key(text).await?;
                return found.map(|key| (Who::Key(key), None)).ok_or_else(unknown);
            }
            let who = match text.strip_prefix(TICKET_PREFIX) {
                Some(rest) => {
                    let session = self.library.find_session(&format!("{SESSION_PREFIX}{rest}")).await?;
                    session.map(|session| Who::Ticket(session.owner))
                }
                None => Who::of_bearer(text),
            };
            let who = who.ok_or_else(unknown)?;
            let token = matches!(who, Who::Manager).then(|| text.to_owned());
            return Ok((who, token));
        }
        if check_origin(headers).is_err() {
            return Ok((Who::Stranger, None));
        }
        let token = manage_cookie(headers).filter(|text| manage::is_token(text)).map(str::to_owned);
        // by HTTP/1.0 come proxies that were told nothing, who name neither the client nor the host that was asked for
        if hosts.is_own(headers) && version != Version::HTTP_10 {
            return Ok((Who::Own, token));
        }
        Ok((self.of_cookie(headers).await?, token))
    }

    /// Whoever a browser keeps the secret of, or has a session of.
    async fn of_cookie(&self, headers: &HeaderMap) -> Result<Who, Problem> {
        let Some(kept) = owner_cookie(headers) else { return Ok(Who::Stranger) };
        if kept.starts_with(SESSION_PREFIX) {
            let session = self.library.find_session(kept).await?;
            return Ok(session.map_or(Who::Stranger, |session| Who::Owner(session.owner, kept.to_owned())));
        }
        Ok(if is_secret(kept) { Who::Owner(Owner::of_secret(kept), kept.to_owned()) } else { Who::Stranger })
    }

    /// Whether a browser is already known as another owner than this one.
    ///
    /// # Errors
    /// 503 where the library cannot be reached.
    pub async fn is_another(&self, headers: &HeaderMap, owner: &Owner) -> Result<bool, Problem> {
        Ok(self.of_cookie(headers).await?.owner().is_some_and(|kept| kept != *owner))
    }

    /// A ticket: whoever has it can be this owner in another browser for a while.
    ///
    /// # Errors
    /// 503 where the library cannot be reached.
    pub async fn ticket(&self, owner: &Owner) -> Result<String, Problem> {
        let session = self.library.open_session(owner, None, TICKET).await?;
        Ok(session.replacen(SESSION_PREFIX, TICKET_PREFIX, 1))
    }

    /// What a browser is to keep to be this owner: the secret that the caller came with, or a session for the ticket.
    ///
    /// # Errors
    /// 503 where the library cannot be reached.
    pub async fn to_keep(&self, owner: &Owner) -> Result<String, Problem> {
        match caller().as_deref() {
            Some(Caller { who: Who::Owner(_, kept), .. }) => Ok(kept.clone()),
            _ => Ok(self.library.open_session(owner, None, Duration::from_secs(KEPT)).await?),
        }
    }

    /// Whether the caller of this request may have a photo as the request means to.
    #[must_use]
    pub fn allows(&self, photo: &Photo) -> bool {
        // without a caller nobody was let in
        caller().is_some_and(|caller| self.lets(&caller, photo, caller.at))
    }

    fn lets(&self, caller: &Caller, photo: &Photo, at: Millis) -> bool {
        let everybodys = || Settings::of(photo).visibility == Some(Visibility::Link);
        let opens = |link: &Link| self.library.secret().allows(Grant::View, Subject::Photo(photo), link, at);
        match caller.need {
            Need::Read if everybodys() => return true,
            Need::Read | Need::List if caller.has(photo, Scope::Read) => {}
            Need::Change | Need::Own if caller.has(photo, Scope::Upload) => {}
            Need::Read | Need::Change if self.is_managed(caller, photo, at) => {}
            Need::Read if caller.link.as_ref().is_some_and(opens) => caller.linked.store(true, Ordering::Relaxed),
            _ => return false,
        }
        caller.private.store(true, Ordering::Relaxed);
        true
    }

    /// Whether the caller of this request, whatever it asks, may change a photo. An answer that depends on it is theirs alone where it is so.
    #[must_use]
    pub fn may_change(&self, photo: &Photo) -> bool {
        let caller = caller().filter(|caller| caller.has(photo, Scope::Upload) || self.is_managed(caller, photo, caller.at));
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
    pub async fn still_allows(&self, Pass(caller): &Pass, photo: &Photo) -> bool {
        // what cannot be looked up lets nobody in
        let good = match &caller.who {
            Who::Key(key) => self.library.is_still_good(key).await.unwrap_or(false),
            Who::Owner(_, kept) if kept.starts_with(SESSION_PREFIX) => {
                self.library.find_session(kept).await.is_ok_and(|found| found.is_some())
            }
            _ => true,
        };
        match self.library.now().await {
            Ok(now) => good && self.lets(caller, photo, now),
            Err(_) => false,
        }
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
        self.library.secret().photo_id(Some(owner), content)
    }

    /// The query of a link by which a photo can be read until `expires`, in seconds since 1970.
    #[must_use]
    pub fn query(&self, photo: &Photo, expires: u64) -> String {
        query_of(&self.library.secret().sign(Grant::View, Subject::Photo(photo), expires))
    }
}

impl Caller {
    fn has(&self, photo: &Photo, scope: Scope) -> bool {
        self.who.is_admin() || self.who.may(scope) && self.owner.is_some() && photo.owner == self.owner
    }
}

/// Who is to be the owner by what who asks came with.
#[must_use]
pub fn to_be() -> Option<Owner> {
    match &caller()?.who {
        Who::Owner(owner, _) | Who::Ticket(owner) => Some(owner.clone()),
        _ => None,
    }
}

/// The owner by a secret that who asks is.
#[must_use]
pub fn owner_by_secret() -> Option<Owner> {
    caller().and_then(|caller| if let Who::Owner(owner, _) = &caller.who { Some(owner.clone()) } else { None })
}

/// The photo's own token that who asks came with.
#[must_use]
pub fn token() -> Option<String> {
    caller().and_then(|caller| caller.token.clone())
}

/// The query of the link that let in the caller of this request, where nothing else did.
#[must_use]
pub fn link() -> Option<String> {
    caller().filter(|caller| caller.linked.load(Ordering::Relaxed))?.link.as_ref().map(query_of)
}

/// Takes a link off a request's address where nobody is asked who they are: it has no say there.
pub fn drop_link(request: &mut Request) {
    if let Some((uri, _)) = take_link(request.uri()) {
        *request.uri_mut() = uri;
    }
}

/// Whether two texts are equal, in a time that depends on their lengths alone.
#[must_use]
pub fn same(a: &[u8], b: &[u8]) -> bool {
    a.len() == b.len() && std::hint::black_box(a.iter().zip(b).fold(0, |all, (x, y)| all | (x ^ y))) == 0
}

const fn seconds(at: Millis) -> u64 {
    at.unsigned_abs() / 1000
}

/// The photo whose page is at a path.
fn opened(path: &str) -> Option<PhotoId> {
    path.strip_prefix("/view/").or_else(|| path.strip_prefix("/embed/"))?.parse().ok()
}
