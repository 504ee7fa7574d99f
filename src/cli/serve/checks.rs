//! What is looked at before anything is begun, and what the settings come to, for `tmpi config`.

use std::path::Path;
use std::time::Duration;

use anyhow::Context as _;

use super::ServeArgs;
use crate::cli::Usage;
use crate::server::{Reserve, Role, Tls, check_collector};
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
        let private = self.is_private();
        if private && self.public_list {
            return wrong(
                "--public-list is for --access open: with --access private, which is the default beyond loopback and with --host, \
                 everybody is shown a list of their own photos",
            );
        }
        if !private && self.clients.has_quota() {
            return wrong(
                "--quota-photos and --quota-mib are for --access private: with --access open, which is the default on loopback, \
                 photos are nobody's",
            );
        }
        if self.blobs.is_some() != self.database.is_some() {
            return wrong("--blobs and --database go together: what nodes share is in both");
        }
        if let Some(collector) = self.traces() {
            check_collector(&collector.url).map_err(|e| Usage(format!("--otlp: {e}")))?;
        }
        if let Some(pages) = self.pages.as_deref().filter(|dir| !dir.is_dir()) {
            return Err(Usage(format!("--static: {} is no folder", pages.display())).into());
        }
        if let Some((cert, key)) = self.tls_cert.clone().zip(self.tls_key.clone()) {
            Tls::open(cert, key).context("TLS")?;
        }
        readable(&self.models.settings()).context("--depth-model")?;
        if !self.no_live {
            self.room_key()?;
            let rooms = self.models.for_rooms(&self.live_depth_model);
            rooms.as_ref().map_or(Ok(()), readable).context("--live-depth-model")?;
        }
        Ok(())
    }

    /// What options come to of which the value is another than what was said, or follows from others.
    pub(in crate::cli) fn effects(&self) -> Vec<Effect> {
        let limits = self.limits();
        let says = |option, value: String| Effect { option, value: Some(value), note: None };
        let notes = |option, note: String| Effect { option, value: None, note: Some(note) };
        let seconds = |time: Duration| time.as_secs().to_string();
        let network = |settings: &Settings| match &settings.depth_file {
            Some(file) => format!("{}={}", settings.name(), file.display()),
            None => settings.name().to_owned(),
        };
        let (photos, private) = (self.models.settings(), self.is_private());
        let mut all = vec![
            says("addr", self.addr.to_string()),
            says("access", if private { "private" } else { "open" }.to_owned()),
            says("lame-duck", seconds(limits.lame_duck)),
            says("rate-requests", limits.rate_requests.to_string()),
            says("rate-uploads", limits.rate_uploads.to_string()),
            says("rate-views", limits.rate_views.to_string()),
            mib("scene-cache", limits.scene_cache as u64),
            mib("file-cache", limits.file_cache as u64),
            mib("view-cache", limits.view_cache as u64),
            mib("work-memory", limits.work_memory as u64),
            mib("job-memory", limits.job_memory),
            notes("depth-model", network(&photos)),
        ];
        if !self.no_live {
            all.push(notes("live-depth-model", network(&self.models.for_rooms(&self.live_depth_model).unwrap_or(photos))));
        }
        all.extend(self.admin.map(|addr| says("admin", addr.to_string())));
        let Reserve { bytes, files } = limits.reserve;
        for (option, said, usual, share) in [
            ("least-free", bytes.map(|b| b >> 20), Reserve::BYTES >> 20, "or a twentieth of a smaller disk"),
            ("least-free-files", files, Reserve::FILES, "or a hundredth of a smaller disk's"),
        ] {
            let note = said.is_none().then(|| share.to_owned());
            all.push(Effect { option, value: Some(said.unwrap_or(usual).to_string()), note });
        }
        if self.role == Role::Serve {
            all.push(notes("workers", "none with --role serve".into()));
        }
        if self.otlp.is_none()
            && let Some(collector) = self.traces()
        {
            all.push(Effect { option: "otlp", value: Some(collector.url), note: Some(COLLECTOR.into()) });
        }
        if self.tls_cert.is_none() || limits.hsts.is_zero() {
            all.push(notes("hsts", "not told: without --tls-cert, or with 0".into()));
        }
        all
    }
}

/// Bytes as MiB, and as they are where that is not all.
fn mib(option: &'static str, bytes: u64) -> Effect {
    let note = (!bytes.is_multiple_of(1 << 20)).then(|| format!("{bytes} bytes"));
    Effect { option, value: Some((bytes >> 20).to_string()), note }
}

/// Whether the files of a network can be read.
fn readable(settings: &Settings) -> anyhow::Result<()> {
    let Some(file) = &settings.depth_file else { return Ok(()) };
    let open = |file: &Path| std::fs::File::open(file).map(drop).with_context(|| file.display().to_string());
    open(file)?;
    models::beside(file)?.iter().try_for_each(|(_, beside)| open(beside))
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;
    use crate::server::Limits;

    #[derive(Parser)]
    struct Cli {
        #[command(flatten)]
        serve: ServeArgs,
    }

    fn effects(args: &[&str]) -> Vec<Effect> {
        Cli::try_parse_from([&["serve"], args].concat()).unwrap().serve.effects()
    }

    fn value(args: &[&str], option: &str) -> Option<String> {
        effects(args).into_iter().find(|effect| effect.option == option)?.value
    }

    #[test]
    fn what_follows_from_others_is_told() {
        let of = |args: &[&str], option: &str| value(args, option).unwrap_or_default();
        assert_eq!((of(&[], "access"), of(&[], "lame-duck"), of(&[], "rate-views")), ("open".into(), "0".into(), "0".into()));
        let open = ["--addr", "0.0.0.0:80"];
        assert_eq!((of(&open, "access"), of(&open, "lame-duck")), ("private".into(), "5".into()));
        assert_eq!(of(&open, "rate-views"), Limits::RATE_VIEWS.to_string());
        assert_eq!((of(&["--memory", "256"], "scene-cache"), of(&["--memory", "256"], "job-memory")), ("8".into(), "240".into()));
        assert_eq!(of(&["--memory", "256", "--scene-cache", "9"], "scene-cache"), "9");
        assert_eq!(of(&["--addr", "8081"], "addr"), "127.0.0.1:8081");
        let uneven = effects(&["--memory", "200"]).into_iter().find(|effect| effect.option == "scene-cache");
        assert_eq!(uneven.and_then(|effect| effect.note), Some("6553600 bytes".into()));
    }
}
