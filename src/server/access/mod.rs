//! Access control for `--access private`; every request passes through here.
//!
//! The uploader owns the photo. The server knows an owner by a hash: of an API key's name, or of a secret that the owner keeps. A browser
//! keeps that secret in a cookie that scripts cannot read, so image, event-stream and worker requests carry it too. Everything else that
//! gives rights is a signed grant: links to a photo, its token, tickets and sessions. A photo that the caller may not see answers 404.

mod callers;
mod cookies;
mod link_query;
mod photo_token;
mod route_permissions;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use axum::extract::{MatchedPath, Request};
use axum::http::{HeaderMap, Method, StatusCode, Version, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use tmpi_library::{Grant, KEY_PREFIX, Key, Library, Link, Millis, Owner, Photo, PhotoId, Scope, Subject};

use super::accept_loop::Peer;
use super::base_path::BasePath;
use super::client_slots::client_address;
use super::cross_site::check_origin;
use super::hosts::Hosts;
use super::problem::Problem;
use super::proxies::Proxies;
use super::rate_limit::{RateHeaders, RateKey, RateLimiter};
use super::viewer_settings::{Settings, Visibility};
use callers::{Caller, bearer, new_secret, owner_of_secret};
use cookies::{Cookie, KEPT, LINK, MANAGE, OWNER, OWNER_BELOW, cookie, keep_private, set_cookie};
use link_query::UrlLink;
pub(super) use link_query::{link_of_url, query_of, take_link};
use photo_token::{link_of, token_of};
use route_permissions::{Permission, permission, refusal};

/// Prefix of a session, which browsers keep as a cookie.
const SESSION_PREFIX: &str = "tmpi_s_";
/// Prefix of a ticket, which can only be exchanged for a session.
const TICKET_PREFIX: &str = "tmpi_t_";
/// Lifetime of a ticket in seconds.
const TICKET: u64 = 15 * 60;

/// An admitted request: its caller, and what else gives rights.
pub struct Admission {
    caller: Caller,
    /// The link in the URL, else in the cookie.
    link: Option<UrlLink>,
    /// Keys that may have signed it.
    signers: Vec<Key>,
    /// The URL has a link, even if malformed.
    asked: bool,
    /// A photo's own token.
    token: Option<Link>,
    /// Time of the request by the database's clock; 0 without a link or token.
    at: Millis,
    permission: Permission,
    /// The answer depends on the caller's rights.
    private: AtomicBool,
    /// Only the link gave access.
    linked: AtomicBool,
}

tokio::task_local! {
    static ADMISSION: Arc<Admission>;
}

/// The admission of the current request, also for answers that go on; `None` with open access.
pub fn admission() -> Option<Arc<Admission>> {
    ADMISSION.try_with(Arc::clone).ok()
}

/// Decides who may do what.
pub struct Guard {
    library: Library,
    base: BasePath,
}

impl Guard {
    /// Checks callers against the keys and grants of `library`; cookies are for addresses at or below `base`.
    pub const fn new(library: Library, base: BasePath) -> Self {
        Self { library, base }
    }

    /// Checks a request's rights and rate, and removes the link's parameters from its URL.
    ///
    /// # Errors
    /// 401, 403, 404 or 405 if the caller has no right to the route, 429 if it sends too many requests.
    pub async fn admit(
        &self,
        (hosts, proxies): (&Hosts, &Proxies),
        rates: &RateLimiter,
        request: &mut Request,
    ) -> (RateHeaders, Result<Arc<Admission>, Problem>) {
        let come = self.authenticate(hosts, proxies, request).await;
        // refused requests count, too
        let key = come.as_ref().ok().and_then(|come| if let Caller::Key(key) = &come.caller { Some(key.name.clone()) } else { None });
        let (told, taken) = rates.count(RateKey::of(key, client_address()), request);
        (told, taken.and(come).map(Arc::new))
    }

    /// Answers a request by `next`, with its admission available to handlers.
    pub async fn answer(&self, come: Arc<Admission>, request: Request, next: Next) -> Response {
        let path = request.uri().path().to_owned();
        let headers = request.headers().clone();
        let mut response = ADMISSION.scope(Arc::clone(&come), next.run(request)).await;
        // a list depends on the caller, even if it is empty
        if come.permission == Permission::List || come.private.load(Ordering::Relaxed) {
            keep_private(&mut response);
        }
        if path == "/" && response.status() != StatusCode::NOT_MODIFIED {
            let secret = match &come.caller {
                Caller::Owner(_, kept) => Ok(kept.clone()),
                // keep an existing cookie even if a link from another site led here
                Caller::Anonymous if matches!(self.of_cookie(&headers).await, Ok(Caller::Anonymous)) => new_secret(),
                _ => return response,
            };
            match secret {
                Ok(secret) => self.set_owner(&mut response, &headers, &secret),
                Err(problem) => return problem.into_response(),
            }
        }
        if come.asked
            && come.linked.load(Ordering::Relaxed)
            && let Some((id, link)) = opened(&path).zip(come.link.as_ref())
        {
            let age = link.link.expires.saturating_sub(seconds(come.at));
            set_cookie(&mut response, &headers, LINK, &query_of(link), &self.base.at(&format!("/v1/photos/{id}")), age);
        }
        response
    }

    /// Identifies the caller, and refuses what needs no photo to decide.
    async fn authenticate(&self, hosts: &Hosts, proxies: &Proxies, request: &mut Request) -> Result<Admission, Problem> {
        let route = request.extensions().get::<MatchedPath>().cloned();
        let permission = match &route {
            // 404s and preflights need no rights
            None => Permission::Nothing,
            Some(_) if *request.method() == Method::OPTIONS => Permission::Nothing,
            Some(path) => permission(request.method().as_str(), path.as_str()).ok_or_else(|| refusal(request.method(), path.as_str()))?,
        };
        let in_url = take_link(request.uri()).map(|(uri, link)| {
            *request.uri_mut() = uri;
            link
        });
        let is_of_page = route.is_some_and(|path| path.as_str() == "/oembed");
        let in_url = in_url.or_else(|| is_of_page.then(|| link_of_url(request.uri())));
        let (caller, token) = if permission == Permission::Room {
            (Caller::Anonymous, None)
        } else {
            let peer = request.extensions().get::<Peer>();
            let user = peer.map_or(Ok(None), |peer| proxies.login(peer.0, request.headers()))?;
            self.identify(hosts, user, request.headers(), request.version()).await?
        };
        match permission {
            Permission::Upload => caller.require_scope(Scope::Upload)?,
            Permission::List => caller.require_scope(Scope::Read)?,
            Permission::Metrics if !caller.has_scope(Scope::Metrics) => return Err(not_yours("keys with the scope metrics or admin")),
            Permission::Admin if !caller.is_admin() => return Err(not_yours("keys with the scope admin")),
            _ => {}
        }
        let asked = in_url.is_some();
        let link = in_url.unwrap_or_else(|| {
            let of_cookie = cookie(request.headers(), LINK).and_then(UrlLink::of_query);
            of_cookie.filter(|_| check_origin(request.headers()).is_ok())
        });
        let signers = match link.as_ref().and_then(|link| link.key.as_deref()) {
            Some(id) => self.library.keys_of_id(id).await?,
            None => Vec::new(),
        };
        let at = if link.is_some() || token.is_some() { self.library.now().await? } else { 0 };
        let [private, linked] = [const { AtomicBool::new(false) }; 2];
        Ok(Admission { caller, link, signers, asked, token, at, permission, private, linked })
    }

    /// Reads the caller, and the photo token that it also has, from the headers. A bearer counts alone; otherwise the logged-in user, loopback
    /// and cookies count, unless another site's page made the request.
    async fn identify(
        &self,
        hosts: &Hosts,
        user: Option<Owner>,
        headers: &HeaderMap,
        version: Version,
    ) -> Result<(Caller, Option<Link>), Problem> {
        // other schemes belong to a proxy in front, which forwards its own header
        let mut given = headers.get_all(header::AUTHORIZATION).iter().filter_map(bearer);
        if let Some(text) = given.next() {
            let token = link_of(text);
            let caller = if given.next().is_some() {
                None
            } else if text.starts_with(KEY_PREFIX) {
                self.library.find_key(text).await?.map(Caller::Key)
            } else if let Some(ticket) = text.strip_prefix(TICKET_PREFIX) {
                self.library.secret().owner_of(Grant::Ticket, ticket, self.library.now().await?).map(Caller::Ticket)
            } else if token.is_some() {
                Some(Caller::Manager)
            } else {
                owner_of_secret(text).map(|owner| Caller::Owner(owner, text.to_owned()))
            };
            return caller.map(|caller| (caller, token)).ok_or_else(|| {
                let detail = "the key is unknown or no longer valid, or the secret is malformed";
                let problem = Problem::new(StatusCode::UNAUTHORIZED, "key", detail).field("Authorization");
                problem.header(header::WWW_AUTHENTICATE, "Bearer error=\"invalid_token\"")
            });
        }
        if check_origin(headers).is_err() {
            return Ok((Caller::Anonymous, None));
        }
        let token = cookie(headers, MANAGE).and_then(link_of);
        if let Some(user) = user {
            return Ok((Caller::User(user), token));
        }
        // unconfigured proxies use HTTP/1.0 and name neither the client nor the requested host
        if hosts.is_own(headers) && version != Version::HTTP_10 {
            return Ok((Caller::LocalUser, token));
        }
        Ok((self.of_cookie(headers).await?, token))
    }

    async fn of_cookie(&self, headers: &HeaderMap) -> Result<Caller, Problem> {
        let Some(kept) = cookie(headers, self.owner_cookie()) else { return Ok(Caller::Anonymous) };
        Ok(self.owner_of(kept).await?.map_or(Caller::Anonymous, |owner| Caller::Owner(owner, kept.to_owned())))
    }

    /// The owner of a secret or of a valid session.
    async fn owner_of(&self, kept: &str) -> Result<Option<Owner>, Problem> {
        let Some(session) = kept.strip_prefix(SESSION_PREFIX) else { return Ok(owner_of_secret(kept)) };
        Ok(self.library.secret().owner_of(Grant::Session, session, self.library.now().await?))
    }

    /// Whether the browser's cookie belongs to another owner.
    pub async fn is_another(&self, headers: &HeaderMap, owner: &Owner) -> Result<bool, Problem> {
        Ok(self.of_cookie(headers).await?.owner().is_some_and(|kept| kept != *owner))
    }

    /// A ticket that makes another browser this owner, and when it expires.
    pub async fn ticket(&self, owner: &Owner) -> Result<(String, u64), Problem> {
        let expires = seconds(self.library.now().await?) + TICKET;
        Ok((format!("{TICKET_PREFIX}{}", self.library.secret().sign_for(Grant::Ticket, owner, expires)), expires))
    }

    /// The owner that the caller's secret, session or ticket names, and the cookie that makes a browser this owner: the secret or session
    /// itself, or a session for the ticket.
    pub async fn named_owner(&self) -> Result<Option<(Owner, String)>, Problem> {
        Ok(match admission().as_deref().map(|come| &come.caller) {
            Some(Caller::Owner(owner, kept)) => Some((owner.clone(), kept.clone())),
            Some(Caller::Ticket(owner)) => {
                let expires = seconds(self.library.now().await?) + KEPT;
                let session = self.library.secret().sign_for(Grant::Session, owner, expires);
                Some((owner.clone(), format!("{SESSION_PREFIX}{session}")))
            }
            _ => None,
        })
    }

    /// Whether the caller has the right to a photo that this request needs.
    pub fn allows(&self, photo: &Photo) -> bool {
        // no caller, no rights
        admission().is_some_and(|come| self.lets(&come, come.permission, photo, come.at))
    }

    /// Whether the caller may change a photo, whatever this request needs. If so, the answer becomes private.
    pub fn may_change(&self, photo: &Photo) -> bool {
        admission().is_some_and(|come| self.lets(&come, Permission::Change, photo, come.at))
    }

    fn lets(&self, come: &Admission, permission: Permission, photo: &Photo, at: Millis) -> bool {
        let everybodys = || Settings::of(photo).visibility == Some(Visibility::Link);
        let secret = self.library.secret();
        match permission {
            Permission::Read if everybodys() => return true,
            Permission::Read | Permission::List if come.has(photo, Scope::Read) => {}
            Permission::Change | Permission::Own if come.has(photo, Scope::Upload) => {}
            Permission::Read | Permission::Change
                if come.token.as_ref().is_some_and(|token| secret.allows(Grant::Edit, Subject::Photo(photo), token, at)) => {}
            Permission::Read if come.link.as_ref().is_some_and(|link| link.opens(photo, secret, &come.signers, at)) => {
                come.linked.store(true, Ordering::Relaxed);
            }
            _ => return false,
        }
        come.private.store(true, Ordering::Relaxed);
        true
    }

    /// Whether the caller still has access: its key may be revoked, its link expired, or the photo made private meanwhile.
    pub async fn still_allows(&self, come: &Admission, photo: &Photo) -> bool {
        // a failed lookup denies
        let mut good = match &come.caller {
            Caller::Key(key) => self.library.is_valid(key).await.unwrap_or(false),
            Caller::Owner(_, kept) => self.owner_of(kept).await.is_ok_and(|found| found.is_some()),
            _ => true,
        };
        for key in &come.signers {
            good &= self.library.is_valid(key).await.unwrap_or(false);
        }
        match self.library.now().await {
            Ok(now) => good && self.lets(come, come.permission, photo, now),
            Err(_) => false,
        }
    }

    /// The owner of the caller's uploads; if the caller has no secret, a new one for this one photo, whose secret is not kept. True if new.
    pub fn uploader() -> Result<(Owner, bool), Problem> {
        match Self::owner() {
            Some(owner) => Ok((owner, false)),
            None => Ok((Owner::of_secret(&new_secret()?), true)),
        }
    }

    /// The caller as an owner; `None` for tickets, photo tokens and callers without credentials.
    pub fn owner() -> Option<Owner> {
        admission()?.caller.owner()
    }

    /// Whether the caller has the rights of an administrator, and thus to all photos.
    pub fn is_admin() -> bool {
        admission().is_some_and(|come| come.caller.is_admin())
    }

    /// Query of a link that can read a photo until `expires`, in seconds since 1970.
    pub fn query(&self, photo: &Photo, expires: u64) -> String {
        query_of(&self.library.secret().sign(Grant::View, Subject::Photo(photo), expires).into())
    }

    /// The photo's page with its token after the `#`; anyone with this link can see and change the photo.
    pub fn manage_link(&self, photo: &Photo) -> String {
        let link = self.library.secret().sign(Grant::Edit, Subject::Photo(photo), u64::MAX);
        self.base.at(&format!("/view/{}#manage={}", photo.id, token_of(&link)))
    }

    const fn owner_cookie(&self) -> Cookie {
        if self.base.is_empty() { OWNER } else { OWNER_BELOW }
    }

    /// Sets the cookie with an owner's secret or session.
    pub fn set_owner(&self, response: &mut Response, asked: &HeaderMap, secret: &str) {
        set_cookie(response, asked, self.owner_cookie(), secret, self.base.root(), KEPT);
    }

    /// Sets the cookie with the token that the caller sent, if any, for the addresses of its photo.
    pub fn set_manage(&self, response: &mut Response, asked: &HeaderMap, photo: PhotoId) {
        if let Some(token) = admission().as_deref().and_then(|come| come.token.as_ref()) {
            set_cookie(response, asked, MANAGE, &token_of(token), &self.base.at(&format!("/v1/photos/{photo}")), KEPT);
        }
    }
}

impl Admission {
    fn has(&self, photo: &Photo, scope: Scope) -> bool {
        self.caller.is_admin() || self.caller.may(scope) && photo.owner.is_some() && photo.owner == self.caller.owner()
    }
}

/// The owner that the caller's secret or session names.
pub fn owner_by_secret() -> Option<Owner> {
    if let Caller::Owner(owner, _) = &admission()?.caller { Some(owner.clone()) } else { None }
}

/// Query of the caller's link, if only the link gave access.
pub fn link() -> Option<String> {
    admission().filter(|come| come.linked.load(Ordering::Relaxed))?.link.as_ref().map(query_of)
}

/// Removes a link's parameters from a request's URL. With open access they have no effect.
pub fn drop_link(request: &mut Request) {
    if let Some((uri, _)) = take_link(request.uri()) {
        *request.uri_mut() = uri;
    }
}

fn not_yours(keys: &str) -> Problem {
    let detail = format!("only this machine's own user, at a loopback address, and {keys} may do this");
    Problem::new(StatusCode::FORBIDDEN, "not-yours", detail)
}

const fn seconds(at: Millis) -> u64 {
    at.unsigned_abs() / 1000
}

/// The photo whose page is at a path.
fn opened(path: &str) -> Option<PhotoId> {
    path.strip_prefix("/view/").or_else(|| path.strip_prefix("/embed/"))?.parse().ok()
}
