//! Access control for `--access private`; every request passes through here.
//!
//! The uploader owns the photo. The server knows an owner by a hash: of an API key's name, or of a secret that the owner keeps. A browser
//! keeps that secret in a cookie that scripts cannot read, so image, event-stream and worker requests carry it too. A photo that the caller
//! may not see answers 404.

mod callers;
mod cookies;
mod link_query;
mod photo_token;
mod route_permissions;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use axum::extract::{MatchedPath, Request};
use axum::http::{HeaderMap, Method, StatusCode, Version, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use tmpi_library::{Grant, KEY_PREFIX, Library, Link, Millis, Owner, Photo, PhotoId, SESSION_PREFIX, Scope, Subject};

use super::client_slots::client_address;
use super::cross_site::check_origin;
use super::hosts::Hosts;
use super::photo_settings::{Settings, Visibility};
use super::problem::Problem;
use super::rate_limit::{RateHeaders, RateKey, RateLimiter};
use callers::{Principal, bearer, is_secret, new_secret};
use cookies::{KEPT, LINK_COOKIE, cookie, keep_private, manage_cookie, owner_cookie, set_cookie};
pub use cookies::{set_manage, set_owner};
use link_query::LinkInUrl;
pub(super) use link_query::{link_of_url, query_of, take_link};
use route_permissions::{Permission, permission, refusal};

/// Lifetime of a ticket.
pub const TICKET: Duration = Duration::from_mins(15);
/// Prefix of a ticket: a short session that can only be exchanged for a long one.
const TICKET_PREFIX: &str = "tmpi_t_";

/// The caller of a request, with its rights.
struct Caller {
    who: Principal,
    owner: Option<Owner>,
    link: Option<Link>,
    /// Time of the request by the database's clock; 0 without a link or token.
    at: Millis,
    /// A photo's own token.
    token: Option<String>,
    permission: Permission,
    /// The answer depends on the caller's rights.
    private: AtomicBool,
    /// Only the link gave access.
    linked: AtomicBool,
}

tokio::task_local! {
    static CALLER: Arc<Caller>;
}

fn caller() -> Option<Arc<Caller>> {
    CALLER.try_with(Arc::clone).ok()
}

/// The rights with which a caller was admitted.
pub struct Admission(Arc<Caller>);

/// Decides who may do what.
pub struct Guard {
    library: Library,
}

/// The owner of an upload.
pub struct Uploader {
    /// Owner of the new photo.
    pub owner: Owner,
    /// The caller sent no secret, so this owner was made for this one photo; its secret is not kept.
    pub is_new: bool,
}

impl Guard {
    /// Checks callers against the keys, sessions and links of `library`.
    #[must_use]
    pub const fn new(library: Library) -> Self {
        Self { library }
    }

    /// Checks a request's rights and rate, and removes the link's parameters from its URL.
    ///
    /// # Errors
    /// 401, 403, 404 or 405 if the caller has no right to the route, 429 if it sends too many requests.
    pub async fn admit(&self, hosts: &Hosts, rates: &RateLimiter, request: &mut Request) -> (RateHeaders, Result<Admission, Problem>) {
        let come = self.authenticate(hosts, request).await;
        // refused requests count, too
        let key = come.as_ref().ok().and_then(|caller| if let Principal::Key(key) = &caller.who { Some(key.name.clone()) } else { None });
        let (told, taken) = rates.count(RateKey::of(key, client_address()), request);
        (told, taken.and(come).map(|caller| Admission(Arc::new(caller))))
    }

    /// Answers a request by `next`, with the caller available to handlers.
    pub async fn answer(&self, Admission(caller): Admission, request: Request, next: Next) -> Response {
        let path = request.uri().path().to_owned();
        let headers = request.headers().clone();
        let link = request.extensions().get::<LinkInUrl>().and_then(|asked| asked.0.clone());
        let mut response = CALLER.scope(Arc::clone(&caller), next.run(request)).await;
        // a list depends on the caller, even if it is empty
        if caller.permission == Permission::List || caller.private.load(Ordering::Relaxed) {
            keep_private(&mut response);
        }
        if path == "/" && response.status() != StatusCode::NOT_MODIFIED {
            let secret = match &caller.who {
                Principal::Owner(_, kept) => Ok(kept.clone()),
                // keep an existing cookie even if a link from another site led here
                Principal::Anonymous if matches!(self.of_cookie(&headers).await, Ok(Principal::Anonymous)) => new_secret(),
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

    /// Identifies the caller, and refuses what needs no photo to decide.
    async fn authenticate(&self, hosts: &Hosts, request: &mut Request) -> Result<Caller, Problem> {
        let permission = match request.extensions().get::<MatchedPath>() {
            // 404s and preflights need no rights
            None => Permission::Nothing,
            Some(_) if *request.method() == Method::OPTIONS => Permission::Nothing,
            Some(path) => permission(request.method(), path.as_str()).ok_or_else(|| refusal(request.method(), path.as_str()))?,
        };
        let asked = take_link(request.uri()).map(|(uri, link)| {
            *request.uri_mut() = uri;
            link
        });
        let is_of_page = request.extensions().get::<MatchedPath>().is_some_and(|path| path.as_str() == "/oembed");
        let asked = asked.or_else(|| is_of_page.then(|| link_of_url(request.uri())));
        let (who, token) = if permission == Permission::Room {
            (Principal::Anonymous, None)
        } else {
            self.who(hosts, request.headers(), request.version()).await?
        };
        let link = asked.clone().unwrap_or_else(|| {
            let of_cookie = cookie(request.headers(), LINK_COOKIE).and_then(|text| text.parse().ok());
            of_cookie.filter(|_| check_origin(request.headers()).is_ok())
        });
        request.extensions_mut().insert(LinkInUrl(asked.flatten()));
        match permission {
            Permission::Upload => who.require_scope(Scope::Upload, "upload")?,
            Permission::List => who.require_scope(Scope::Read, "read")?,
            Permission::Metrics if !who.has_scope(Scope::Metrics) => {
                let detail = "only this machine's own user, at a loopback address, and keys with the scope metrics or admin may do this";
                return Err(Problem::new(StatusCode::FORBIDDEN, "not-yours", detail));
            }
            Permission::Admin if !who.is_admin() => {
                let detail = "only this machine's own user, at a loopback address, and keys with the scope admin may do this";
                return Err(Problem::new(StatusCode::FORBIDDEN, "not-yours", detail));
            }
            _ => {}
        }
        let at = if link.is_some() || token.is_some() { self.library.now().await? } else { 0 };
        Ok(Caller { owner: who.owner(), who, link, at, token, permission, private: AtomicBool::new(false), linked: AtomicBool::new(false) })
    }

    /// Identifies the caller, with the photo token that it also has. A bearer counts alone; otherwise cookies and loopback count, unless
    /// another site's page made the request.
    async fn who(&self, hosts: &Hosts, headers: &HeaderMap, version: Version) -> Result<(Principal, Option<String>), Problem> {
        let unknown = || {
            let detail = "the key is unknown or no longer valid, or the secret is malformed";
            let problem = Problem::new(StatusCode::UNAUTHORIZED, "key", detail).field("Authorization");
            problem.header(header::WWW_AUTHENTICATE, "Bearer error=\"invalid_token\"")
        };
        // other schemes belong to a proxy in front, which forwards its own header
        let mut given = headers.get_all(header::AUTHORIZATION).iter().filter_map(bearer);
        if let Some(text) = given.next() {
            if given.next().is_some() {
                return Err(unknown());
            }
            if text.starts_with(KEY_PREFIX) {
                let found = self.library.find_key(text).await?;
                return found.map(|key| (Principal::Key(key), None)).ok_or_else(unknown);
            }
            let who = match text.strip_prefix(TICKET_PREFIX) {
                Some(rest) => self.library.session_owner(&format!("{SESSION_PREFIX}{rest}")).await?.map(Principal::Ticket),
                None => Principal::of_bearer(text),
            };
            let who = who.ok_or_else(unknown)?;
            let token = matches!(who, Principal::Manager).then(|| text.to_owned());
            return Ok((who, token));
        }
        if check_origin(headers).is_err() {
            return Ok((Principal::Anonymous, None));
        }
        let token = manage_cookie(headers).filter(|text| photo_token::is_token(text)).map(str::to_owned);
        // unconfigured proxies use HTTP/1.0 and name neither the client nor the requested host
        if hosts.is_own(headers) && version != Version::HTTP_10 {
            return Ok((Principal::LocalUser, token));
        }
        Ok((self.of_cookie(headers).await?, token))
    }

    /// The caller by its owner cookie: a secret or a session.
    async fn of_cookie(&self, headers: &HeaderMap) -> Result<Principal, Problem> {
        let Some(kept) = owner_cookie(headers) else { return Ok(Principal::Anonymous) };
        if kept.starts_with(SESSION_PREFIX) {
            let owner = self.library.session_owner(kept).await?;
            return Ok(owner.map_or(Principal::Anonymous, |owner| Principal::Owner(owner, kept.to_owned())));
        }
        Ok(if is_secret(kept) { Principal::Owner(Owner::of_secret(kept), kept.to_owned()) } else { Principal::Anonymous })
    }

    /// Whether the browser's cookie belongs to another owner.
    ///
    /// # Errors
    /// 503 where the library cannot be reached.
    pub async fn is_another(&self, headers: &HeaderMap, owner: &Owner) -> Result<bool, Problem> {
        Ok(self.of_cookie(headers).await?.owner().is_some_and(|kept| kept != *owner))
    }

    /// Issues a ticket that makes another browser this owner; see [`TICKET`] for its lifetime.
    ///
    /// # Errors
    /// 503 where the library cannot be reached.
    pub async fn ticket(&self, owner: &Owner) -> Result<String, Problem> {
        let session = self.library.open_session(owner, TICKET).await?;
        Ok(session.replacen(SESSION_PREFIX, TICKET_PREFIX, 1))
    }

    /// The cookie value that makes a browser this owner: the caller's secret, or a session in exchange for its ticket.
    ///
    /// # Errors
    /// 503 where the library cannot be reached.
    pub async fn session_cookie(&self, owner: &Owner) -> Result<String, Problem> {
        match caller().as_deref() {
            Some(Caller { who: Principal::Owner(_, kept), .. }) => Ok(kept.clone()),
            _ => Ok(self.library.open_session(owner, Duration::from_secs(KEPT)).await?),
        }
    }

    /// Whether the caller has the right to a photo that this request needs.
    #[must_use]
    pub fn allows(&self, photo: &Photo) -> bool {
        // no caller, no rights
        caller().is_some_and(|caller| self.lets(&caller, photo, caller.at))
    }

    fn lets(&self, caller: &Caller, photo: &Photo, at: Millis) -> bool {
        let everybodys = || Settings::of(photo).visibility == Some(Visibility::Link);
        let opens = |link: &Link| self.library.secret().allows(Grant::View, Subject::Photo(photo), link, at);
        match caller.permission {
            Permission::Read if everybodys() => return true,
            Permission::Read | Permission::List if caller.has(photo, Scope::Read) => {}
            Permission::Change | Permission::Own if caller.has(photo, Scope::Upload) => {}
            Permission::Read | Permission::Change if self.is_managed(caller, photo, at) => {}
            Permission::Read if caller.link.as_ref().is_some_and(opens) => caller.linked.store(true, Ordering::Relaxed),
            _ => return false,
        }
        caller.private.store(true, Ordering::Relaxed);
        true
    }

    /// Whether the caller may change a photo, whatever this request needs. If so, the answer becomes private.
    #[must_use]
    pub fn may_change(&self, photo: &Photo) -> bool {
        let caller = caller().filter(|caller| caller.has(photo, Scope::Upload) || self.is_managed(caller, photo, caller.at));
        if let Some(caller) = &caller {
            caller.private.store(true, Ordering::Relaxed);
        }
        caller.is_some()
    }

    /// The caller's rights, for answers that go on; `None` without a caller.
    #[must_use]
    pub fn admission() -> Option<Admission> {
        caller().map(Admission)
    }

    /// Whether the caller still has access: its key may be revoked, its link expired, or the photo made private meanwhile.
    pub async fn still_allows(&self, Admission(caller): &Admission, photo: &Photo) -> bool {
        // a failed lookup denies
        let good = match &caller.who {
            Principal::Key(key) => self.library.is_valid(key).await.unwrap_or(false),
            Principal::Owner(_, kept) if kept.starts_with(SESSION_PREFIX) => {
                self.library.session_owner(kept).await.is_ok_and(|found| found.is_some())
            }
            _ => true,
        };
        match self.library.now().await {
            Ok(now) => good && self.lets(caller, photo, now),
            Err(_) => false,
        }
    }

    /// The owner of the caller's uploads; a new one if the caller has no secret.
    ///
    /// # Errors
    /// 500 if the system has no random bytes.
    pub fn uploader() -> Result<Uploader, Problem> {
        if let Some(owner) = caller().and_then(|caller| caller.owner.clone()) {
            return Ok(Uploader { owner, is_new: false });
        }
        Ok(Uploader { owner: Owner::of_secret(&new_secret()?), is_new: true })
    }

    /// The caller as an owner; `None` for tickets, photo tokens and callers without credentials.
    #[must_use]
    pub fn owner() -> Option<Owner> {
        caller().and_then(|caller| caller.owner.clone())
    }

    /// Whether the caller has the rights of an administrator, and thus to all photos.
    #[must_use]
    pub fn is_admin() -> bool {
        caller().is_some_and(|caller| caller.who.is_admin())
    }

    /// Id of an owner's photo whose content hashes to `content`.
    #[must_use]
    pub fn id(&self, owner: &Owner, content: PhotoId) -> PhotoId {
        self.library.secret().photo_id(Some(owner), content)
    }

    /// Query of a link that can read a photo until `expires`, in seconds since 1970.
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

/// The owner that the caller's secret or ticket names.
#[must_use]
pub fn named_owner() -> Option<Owner> {
    match &caller()?.who {
        Principal::Owner(owner, _) | Principal::Ticket(owner) => Some(owner.clone()),
        _ => None,
    }
}

/// The owner that the caller's secret or session names.
#[must_use]
pub fn owner_by_secret() -> Option<Owner> {
    caller().and_then(|caller| if let Principal::Owner(owner, _) = &caller.who { Some(owner.clone()) } else { None })
}

/// The photo token that the caller sent.
#[must_use]
pub fn token() -> Option<String> {
    caller().and_then(|caller| caller.token.clone())
}

/// Query of the caller's link, if only the link gave access.
#[must_use]
pub fn link() -> Option<String> {
    caller().filter(|caller| caller.linked.load(Ordering::Relaxed))?.link.as_ref().map(query_of)
}

/// Removes a link's parameters from a request's URL. With open access they have no effect.
pub fn drop_link(request: &mut Request) {
    if let Some((uri, _)) = take_link(request.uri()) {
        *request.uri_mut() = uri;
    }
}

/// Whether two texts are equal, in a time that depends only on their lengths.
#[must_use]
pub fn constant_time_eq(a: &[u8], b: &[u8]) -> bool {
    a.len() == b.len() && std::hint::black_box(a.iter().zip(b).fold(0, |all, (x, y)| all | (x ^ y))) == 0
}

const fn seconds(at: Millis) -> u64 {
    at.unsigned_abs() / 1000
}

/// The photo whose page is at a path.
fn opened(path: &str) -> Option<PhotoId> {
    path.strip_prefix("/view/").or_else(|| path.strip_prefix("/embed/"))?.parse().ok()
}
