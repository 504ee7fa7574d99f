//! Checks of the settings before the server starts, and the effective settings for `tmpi config`.

use std::path::Path;

use anyhow::Context as _;
use clap::ValueEnum as _;

use super::{Access, ServeArgs};
use crate::cli::Usage;
use crate::server::{Limits, Quotas, Role, Tls, check_collector};
use tmpi_pipeline::networks::models::{self, Settings};

/// The effective value of an option.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(in crate::cli) struct Effect {
    pub option: &'static str,
    /// The effective value, if it differs from the given value or the default.
    pub value: Option<String>,
    pub note: Option<String>,
}

/// OpenTelemetry's variable for the collector's URL.
pub(super) const COLLECTOR: &str = "OTEL_EXPORTER_OTLP_ENDPOINT";

impl ServeArgs {
    /// Refuses options that exclude each other and unusable files. Starts and writes nothing.
    ///
    /// # Errors
    /// [`Usage`] with the option's name, or the file's error.
    pub(in crate::cli) fn check(&self) -> anyhow::Result<()> {
        let wrong = |text: &str| Err(Usage(text.into()).into());
        let limits = self.limits()?;
        if !self.is_private() && limits.quotas != Quotas::default() {
            return wrong("quotas are for --access private: with --access open, which is the default on loopback, photos have no owners");
        }
        if !self.is_private() && self.login_header.is_some() {
            return wrong("--login-header is for --access private: with --access open photos have no owners");
        }
        self.presets(&limits)?;
        if self.blobs.is_some() != self.database.is_some() {
            return wrong("--blobs and --database go together: nodes share both");
        }
        if let Some(collector) = self.traces()? {
            check_collector(&collector.url).map_err(|e| Usage(format!("--otlp: {e}")))?;
        }
        if let Some(pages) = self.pages.as_deref().filter(|dir| !dir.is_dir()) {
            return Err(Usage(format!("--static: {} is not a folder", pages.display())).into());
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

    /// The limits, and the options whose effective value differs from the given one or follows from others.
    ///
    /// # Errors
    /// [`Usage`] with the reason.
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
    models::external_data_files(file)?.iter().try_for_each(|(_, weights)| open(weights))
}
