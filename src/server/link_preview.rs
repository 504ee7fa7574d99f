//! The preview card of a photo in other sites and apps: title and picture for Open Graph, Twitter and oEmbed.

use std::fmt::Write as _;

use super::app_state::AppState;
use super::finished_photo::FinishedPhoto;
use super::viewer_settings::Settings;
use super::{access, photo_options};
use crate::export::escaped;
use tmpi_library::Photo;

/// Title of a photo without one.
const UNTITLED: &str = "3D photo";
const DESCRIPTION: &str = "A 3D photo: it moves as you look around.";
/// Longest side of the picture in pixels: what sites with large previews ask for.
pub const PICTURE: u32 = 1200;

#[derive(Debug, PartialEq, Eq)]
pub struct Picture {
    /// Absolute address.
    pub url: String,
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
}

#[derive(Debug)]
pub struct PreviewCard {
    /// Address of the server, as in the request, without a slash at its end.
    base: String,
    id: String,
    title: String,
    /// Query of the link with its question mark, if readers of the card need it to see the photo; else empty.
    link: String,
    /// Address of views and the photo's size, once done.
    view: Option<(String, (u32, u32))>,
}

impl PreviewCard {
    /// The card for this request's caller, who knows the server as `base`. If a link gave the caller access, all addresses contain it.
    pub fn of(app: &AppState, photo: &Photo, base: String) -> Self {
        let (settings, link) = (Settings::of(photo), access::link());
        let view = FinishedPhoto::of(photo).map(|done| {
            let pose = settings.poster_pose(&photo_options::view_box_of(&photo.options)).unwrap_or_default();
            let link = link.as_ref().map(|link| format!("&{link}")).unwrap_or_default();
            let address = format!("{base}/v1/photos/{}/view?{pose}format=jpeg&v={}{link}", photo.id, app.version(&done));
            (address, (done.width, done.height))
        });
        let title = settings.title.unwrap_or_else(|| UNTITLED.into());
        let link = link.map(|link| format!("?{link}")).unwrap_or_default();
        Self { base, id: photo.id.to_string(), title, link, view }
    }

    pub fn title(&self) -> &str {
        &self.title
    }

    /// The photo's preview view as a JPEG of the same aspect ratio, within `most` and not enlarged; `None` until the photo is made.
    pub fn picture(&self, most: (u32, u32)) -> Option<Picture> {
        let (address, size) = self.view.as_ref()?;
        let (width, height) = within(*size, most);
        Some(Picture { url: format!("{address}&w={width}&h={height}"), width, height })
    }

    /// HTML of a frame with the photo within `most`, and its size.
    pub fn frame(&self, most: (u32, u32)) -> (String, u32, u32) {
        let (width, height) = within(self.view.as_ref().map_or(most, |(_, size)| *size), most);
        let html = format!(
            "<iframe src=\"{}/embed/{}{}\" width=\"{width}\" height=\"{height}\" title=\"{}\" loading=\"lazy\" style=\"border:0\" \
             allow=\"fullscreen; accelerometer; gyroscope; xr-spatial-tracking\"></iframe>",
            escaped(&self.base),
            self.id,
            escaped(&self.link),
            escaped(&self.title)
        );
        (html, width, height)
    }

    /// The viewer's page with the photo's title and the card's tags in its head.
    pub fn insert_tags(&self, page: &str) -> String {
        let title = escaped(&self.title);
        let titled = match (page.find("<title>"), page.find("</title>")) {
            (Some(from), Some(to)) if from < to => format!("{}<title>{title} – tmpi{}", &page[..from], &page[to..]),
            _ => page.to_owned(),
        };
        titled.replacen("</head>", &(self.tags() + "  </head>"), 1)
    }

    fn tags(&self) -> String {
        let url = format!("{}/view/{}{}", self.base, self.id, self.link);
        let picture = self.picture((PICTURE, PICTURE));
        let mut tags = Vec::from([
            ("property", "og:type", "website".to_owned()),
            ("property", "og:site_name", "tmpi".into()),
            ("property", "og:title", self.title.clone()),
            ("property", "og:description", DESCRIPTION.into()),
            ("property", "og:url", url.clone()),
            ("name", "twitter:card", if picture.is_some() { "summary_large_image" } else { "summary" }.into()),
        ]);
        if let Some(picture) = picture {
            tags.extend([
                ("property", "og:image", picture.url),
                ("property", "og:image:type", "image/jpeg".into()),
                ("property", "og:image:width", picture.width.to_string()),
                ("property", "og:image:height", picture.height.to_string()),
                ("property", "og:image:alt", self.title.clone()),
            ]);
        }
        let mut html = String::new();
        for (kind, name, content) in tags {
            // writing to a String cannot fail
            let _ = writeln!(html, "    <meta {kind}=\"{name}\" content=\"{}\" />", escaped(&content));
        }
        let query = form_urlencoded::Serializer::new(String::new()).append_pair("url", &url).append_pair("format", "json").finish();
        let address = escaped(&format!("{}/oembed?{query}", self.base));
        let title = escaped(&self.title);
        let _ = writeln!(html, "    <link rel=\"alternate\" type=\"application/json+oembed\" href=\"{address}\" title=\"{title}\" />");
        let _ = writeln!(html, "    <link rel=\"canonical\" href=\"{}\" />", escaped(&url));
        html
    }
}

/// `size` reduced to fit within `most`, at the same aspect ratio.
fn within((width, height): (u32, u32), most: (u32, u32)) -> (u32, u32) {
    let scale = (f64::from(most.0) / f64::from(width)).min(f64::from(most.1) / f64::from(height)).min(1.0);
    let side = |v: u32, most: u32| ((f64::from(v) * scale).round() as u32).clamp(1, most.max(1));
    (side(width, most.0), side(height, most.1))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn card(title: &str) -> PreviewCard {
        let view = Some(("https://h:1/x?a=1".into(), (4000, 3000)));
        PreviewCard { base: "https://h:1".into(), id: "0".repeat(32), title: title.into(), link: String::new(), view }
    }

    #[test]
    fn pictures_keep_their_shape_and_are_not_enlarged() {
        assert_eq!(within((4000, 3000), (1200, 1200)), (1200, 900));
        assert_eq!(within((100, 50), (1200, 1200)), (100, 50));
        assert_eq!(within((6000, 8), (1200, 1200)), (1200, 2));
        assert_eq!(within((60_000, 8), (10, 10)), (10, 1));
        assert_eq!(
            card("").picture((1200, 1200)).unwrap(),
            Picture { url: "https://h:1/x?a=1&w=1200&h=900".into(), width: 1200, height: 900 }
        );
    }

    proptest! {
        #[test]
        fn no_title_escapes_its_html_element(title in any::<String>(), quote in prop::sample::select(vec!['"', '\'', '<', '>', '&'])) {
            let plain = card("T");
            let hostile = card(&format!("{title}{quote}{title}"));
            // as many tags and quotes as with a harmless title: none opened or closed
            let count = |html: &str| ['<', '>', '"'].map(|c| html.matches(c).count());
            let page = "<head><title>x</title></head>";
            prop_assert_eq!(count(&hostile.insert_tags(page)), count(&plain.insert_tags(page)));
            prop_assert_eq!(count(&hostile.frame((800, 800)).0), count(&plain.frame((800, 800)).0));
        }
    }
}
