//! Tracing of requests and jobs: exports spans to a collector by OTLP over HTTP.
//!
//! Each request is a span; making its photo is a child of it, on any node, and each stage is a child of that. Work of a request that waits
//! for a slot (views, smaller levels, files) is a child of the request, too. Without a collector there are no spans.

mod exporter;
mod span;

use std::net::IpAddr;
use std::time::Duration;

use axum::http::HeaderMap;
use opentelemetry::propagation::TextMapPropagator as _;
use opentelemetry::trace::{SpanBuilder, SpanKind, Tracer as _, TracerProvider as _};
use opentelemetry::{Context, KeyValue};
use opentelemetry_http::HeaderExtractor;
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::propagation::TraceContextPropagator;
use opentelemetry_sdk::trace::{Sampler, SdkTracer, SdkTracerProvider};
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;

use super::metrics::Outcome;
pub use exporter::check as check_collector;
pub use span::{ActiveSpan, JobSpan, Parent, TRACE, WorkSpan, current, parent};
use tmpi_library::PhotoId;

/// Most spans that wait for the collector, about 1 KB each; further ones are dropped and counted.
pub(super) const QUEUE: usize = 4096;
/// Time for the last spans when the server stops.
const FLUSH: Duration = Duration::from_secs(5);
/// Monitoring routes, which are not traced.
const HEALTH: [&str; 3] = ["/healthz", "/readyz", "/metrics"];

/// A collector of traces.
#[derive(Clone, Debug, PartialEq)]
pub struct Collector {
    /// Its address, as `http://127.0.0.1:4318`; spans go to `v1/traces` below it.
    pub url: String,
    /// Fraction of the traces that begin here to send, 0 to 1. Those with a `traceparent` follow its sampling flag.
    pub ratio: f64,
}

/// The collector is not usable.
#[derive(Debug, thiserror::Error)]
#[error("collector of traces {url}: {why}")]
pub struct CollectorError {
    url: String,
    why: String,
}

/// Spans that were `sent`, `refused` (or not taken in time), and `dropped` because too many waited.
pub(super) type Counts = Family<Outcome, Counter>;

/// Creates and exports spans.
pub struct Traces {
    provider: SdkTracerProvider,
    tracer: SdkTracer,
}

impl Traces {
    /// Exports spans to a collector, in the caller's runtime.
    ///
    /// # Errors
    /// If the address is not valid.
    pub(super) fn open(to: &Collector, counts: Counts) -> Result<Self, CollectorError> {
        let processor = exporter::processor(&to.url, counts).map_err(|why| CollectorError { url: to.url.clone(), why })?;
        let mut resource = Resource::builder().with_attribute(KeyValue::new("service.version", env!("CARGO_PKG_VERSION")));
        // the SDK reads the standard variable if it is set
        if std::env::var_os("OTEL_SERVICE_NAME").is_none() {
            resource = resource.with_service_name("tmpi");
        }
        let sampler = Sampler::ParentBased(Box::new(Sampler::TraceIdRatioBased(to.ratio)));
        let provider =
            SdkTracerProvider::builder().with_resource(resource.build()).with_sampler(sampler).with_span_processor(processor).build();
        Ok(Self { tracer: provider.tracer("tmpi"), provider })
    }

    /// Starts the span of a request, within its `traceparent`; `None` for monitoring routes.
    #[must_use]
    pub fn request(&self, method: &'static str, route: &str, headers: &HeaderMap, peer: Option<IpAddr>) -> Option<ActiveSpan> {
        if HEALTH.contains(&route) {
            return None;
        }
        let mut attributes = vec![KeyValue::new("http.request.method", method), KeyValue::new("http.route", route.to_owned())];
        attributes.extend(peer.map(|peer| KeyValue::new("tmpi.peer", class(peer))));
        let builder = SpanBuilder::from_name(format!("{method} {route}")).with_kind(SpanKind::Server).with_attributes(attributes);
        let outer = TraceContextPropagator::new().extract_with_context(&Context::new(), &HeaderExtractor(headers));
        Some(ActiveSpan::new(self.tracer.clone(), self.tracer.build_with_context(builder, &outer)))
    }

    /// Starts the span of making a photo, within the request if it is known.
    #[must_use]
    pub fn job(&self, parent: Option<&Parent>, id: PhotoId, attempt: u32) -> ActiveSpan {
        let attributes = vec![
            KeyValue::new("tmpi.photo", id.to_string()),
            KeyValue::new("tmpi.job.class", "photo"),
            KeyValue::new("tmpi.job.attempt", i64::from(attempt)),
        ];
        let builder = SpanBuilder::from_name("job").with_kind(SpanKind::Consumer).with_attributes(attributes);
        let outer = parent.map_or_else(Context::new, Parent::context);
        ActiveSpan::new(self.tracer.clone(), self.tracer.build_with_context(builder, &outer))
    }

    /// Sends the remaining spans and stops; blocks for some seconds at most.
    pub fn end(&self) {
        if let Err(error) = self.provider.shutdown_with_timeout(FLUSH) {
            tracing::warn!(%error, "could not send all traces");
        }
    }
}

/// The class of a client's address; spans contain nothing else of it.
fn class(peer: IpAddr) -> &'static str {
    match peer.to_canonical() {
        ip if ip.is_loopback() => "loopback",
        IpAddr::V4(ip) if ip.is_private() || ip.is_link_local() => "private",
        IpAddr::V6(ip) if ip.is_unique_local() || ip.is_unicast_link_local() => "private",
        _ => "public",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spans_contain_only_the_class_of_an_address() {
        for (address, told) in [
            ("127.0.0.1", "loopback"),
            ("::1", "loopback"),
            ("::ffff:127.0.0.1", "loopback"),
            ("10.1.2.3", "private"),
            ("169.254.0.1", "private"),
            ("fd00::1", "private"),
            ("fe80::1", "private"),
            ("192.0.2.1", "public"),
            ("2001:db8::1", "public"),
        ] {
            assert_eq!(class(address.parse().unwrap()), told, "{address}");
        }
    }
}
