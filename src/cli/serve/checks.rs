//! What is looked at before anything is begun, and what the settings come to, for `tmpi config`.

use std::path::Path;

use anyhow::Context as _;
use clap::ValueEnum as _;

use super::{Access, ServeArgs};
use crate::cli::Usage;
use crate::server::{Limits, Quotas, Role, Tls, check_collector};
use tmpi_pipeline::networks::models::{self, Settings};

/// What an option comes to.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(in crate::cli) struct Effect {
    /// Its long name.
    pub option: &'static str,
    /// Its value; none where that is what was said, or the default.
    pub value: Option<String>,
    /// What there is to say of it.
    pub note: Option<String>,
}

/// The variable that names a collector of traces for all programs.
pub(super) const COLLECTOR: &str = "OTEL_EXPORTER_OTLP_ENDPOINT";

impl ServeArgs {
    /// Refuses what does not go together and files that cannot be used, without starting or writing anything.
    ///
    /// # Errors
    /// [`Usage`] that names the option, or what is wrong with the file.
    pub(in crate::cli) fn check(&self) -> anyhow::Result<()> {
        let wrong = |text: &str| Err(Usage(text.into()).into());
        let limits = self.limits()?;
        if !self.is_private() && limits.quotas != Quotas::default() {
            return wrong("quotas are for --access private: with --access open, which is the default on loopback, photos have no owners");
        }
        if self.blobs.is_some() != self.database.is_some() {
            return wrong("--blobs and --database go together: what nodes share is in both");
        }
        if let Some(collector) = self.traces()? {
            check_collector(&collector.url).map_err(|e| Usage(format!("--otlp: {e}")))?;
        }
        if let Some(pages) = self.pages.as_deref().filter(|dir| !dir.is_dir()) {
            return Err(Usage(format!("--static: {} is no folder", pages.display())).into());
        }
        if let Some((cert, key)) = self.tls_cert.clone().zip(self.tls_key.clone()) {
            Tls::open(cert, key).context("TLS")?;
        }
        readable(&self.models.settings()).context("--depth-model")?;
        if limits.live.rooms > 0 {
            self.room_key()?;
            let rooms = self.models.for_rooms(&self.live_depth_model);
            rooms.as_ref().map_or(Ok(()), readable).context("--live-depth-model")?;
        }
        Ok(())
    }

    /// The limits, and what flags come to of which the value is another than what was said, or follows from others.
    ///
    /// # Errors
    /// [`Usage`] that names what is wrong.
    pub(in crate::cli) fn effects(&self) -> anyhow::Result<(Limits, Vec<Effect>)> {
        let says = |option, value: String| Effect { option, value: Some(value), note: None };
        let notes = |option, note: String| Effect { option, value: None, note: Some(note) };
        let network = |settings: &Settings| match &settings.depth_file {
            Some(file) => format!("{}={}", settings.name(), file.display()),
            None => settings.name().to_owned(),
        };
        let photos = self.models.settings();
        let access = self.access.unwrap_or(if self.is_private() { Access::Private } else { Access::Open });
        let mut all = vec![
            says("addr", self.addr.to_string()),
            says("access", access.to_possible_value().map(|value| value.get_name().to_owned()).unwrap_or_default()),
            notes("depth-model", network(&photos)),
            notes("live-depth-model", network(&self.models.for_rooms(&self.live_depth_model).unwrap_or(photos))),
        ];
        all.extend(self.admin.map(|addr| says("admin", addr.to_string())));
        if self.role == Role::Serve {
            all.push(notes("workers", "none with --role serve".into()));
        }
        if self.otlp.is_none()
            && let Some(collector) = self.traces()?
        {
            all.push(Effect { option: "otlp", value: Some(collector.url), note: Some(COLLECTOR.into()) });
        }
        Ok((self.limits()?, all))
    }
}

/// Whether the files of a network can be read.
fn readable(settings: &Settings) -> anyhow::Result<()> {
    let Some(file) = &settings.depth_file else { return Ok(()) };
    let open = |file: &Path| std::fs::File::open(file).map(drop).with_context(|| file.display().to_string());
    open(file)?;
    models::beside(file)?.iter().try_for_each(|(_, beside)| open(beside))
}
