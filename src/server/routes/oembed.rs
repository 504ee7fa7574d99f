//! oEmbed 1.0 (<https://oembed.com>): how other sites embed a linked photo.

use axum::Json;
use axum::extract::{Request, State};
use axum::http::{StatusCode, Uri};
use serde::Serialize;

use super::query::{Pairs, decode};
use crate::server::app_state::App;
use crate::server::link_preview::PreviewCard;
use crate::server::problem::Problem;

/// Default longest sides of a frame in pixels.
const USUAL: u32 = 800;
/// Allowed values of `maxwidth` and `maxheight`.
const SIDES: std::ops::RangeInclusive<u32> = 1..=16_384;
/// Seconds that consumers may cache an answer: titles change.
const CACHE_AGE: u32 = 3600;

/// How to embed a photo.
#[derive(Serialize, utoipa::ToSchema)]
pub struct OEmbed {
    /// `rich`: HTML to show.
    #[serde(rename = "type")]
    kind: &'static str,
    /// `1.0`.
    version: &'static str,
    /// Title of the photo.
    title: String,
    /// `tmpi`.
    provider_name: &'static str,
    /// Address of this server.
    provider_url: String,
    /// Seconds that consumers may cache this answer.
    cache_age: u32,
    /// A frame with the photo.
    html: String,
    /// Width of the frame in pixels.
    width: u32,
    /// Height of the frame in pixels.
    height: u32,
    /// Address of a picture of it, a JPEG; missing until the photo is made.
    #[serde(skip_serializing_if = "Option::is_none")]
    thumbnail_url: Option<String>,
    /// Width of the picture in pixels.
    #[serde(skip_serializing_if = "Option::is_none")]
    thumbnail_width: Option<u32>,
    /// Height of the picture in pixels.
    #[serde(skip_serializing_if = "Option::is_none")]
    thumbnail_height: Option<u32>,
}

/// How to embed the photo at an address (oEmbed).
///
/// The route ignores unknown parameters, since sites add their own.
#[utoipa::path(
    get, path = "/oembed", tag = "photos",
    params(
        ("url" = String, Query, description = "Address of a photo's page (`/view/ID` or `/embed/ID`) on this server"),
        ("maxwidth" = Option<u32>, Query, minimum = 1, maximum = 16384, description = "Widest frame and picture in pixels; 800 if it is not given"),
        ("maxheight" = Option<u32>, Query, minimum = 1, maximum = 16384, description = "Highest frame and picture in pixels; 800 if it is not given"),
        ("format" = Option<String>, Query, description = "`json`"),
    ),
    responses(
        (status = 200, description = "A frame and a picture", body = OEmbed),
        (status = 400, description = "A parameter is wrong"),
        (status = 404, description = "There is no such photo here"),
        (status = 501, description = "The format is not JSON"),
    )
)]
pub async fn oembed(State(app): State<App>, request: Request) -> Result<Json<OEmbed>, Problem> {
    let names = ["url", "maxwidth", "maxheight", "format"];
    let mut given = decode(request.uri())?;
    given.retain(|(name, _)| names.contains(&name.as_str()));
    let pairs = Pairs::of(given, &names)?;
    if let Some(other) = pairs.get("format").filter(|f| *f != "json") {
        return Err(Problem::new(StatusCode::NOT_IMPLEMENTED, "format", format!("the answer is JSON, not {other:?}")).field("format"));
    }
    let most = (pairs.number("maxwidth", &SIDES)?.unwrap_or(USUAL), pairs.number("maxheight", &SIDES)?.unwrap_or(USUAL));
    let url = pairs.get("url").ok_or_else(|| Problem::parameter("url", "is missing"))?;
    let id = photo_of(&app, url).ok_or_else(|| Problem::not_found("the URL is not a photo page of this server").field("url"))?;
    let photo = app.photo(&id).await?;
    let base = app.address(request.headers()).ok_or_else(|| Problem::bad_request("the Host header is not a host"))?;
    let card = PreviewCard::of(&app, &photo, base.clone());
    let (html, width, height) = card.frame(most);
    let picture = card.picture(most);
    let (thumbnail_width, thumbnail_height) = picture.as_ref().map(|p| (p.width, p.height)).unzip();
    Ok(Json(OEmbed {
        kind: "rich",
        version: "1.0",
        title: card.title().to_owned(),
        provider_name: "tmpi",
        provider_url: base,
        cache_age: CACHE_AGE,
        html,
        width,
        height,
        thumbnail_url: picture.map(|p| p.url),
        thumbnail_width,
        thumbnail_height,
    }))
}

/// Id of the photo whose page is at `url`, if its host is this server.
fn photo_of(app: &App, url: &str) -> Option<String> {
    let mut url: Uri = url.parse().ok()?;
    app.base.strip(&mut url);
    let ours = matches!(url.scheme_str(), Some("http" | "https")) && app.hosts.allows(url.authority()?.host());
    let id = url.path().strip_prefix("/view/").or_else(|| url.path().strip_prefix("/embed/"))?;
    ours.then(|| id.trim_end_matches('/').to_owned())
}
