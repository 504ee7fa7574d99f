//! Tracing of requests and jobs: exports spans to a collector by OTLP over HTTP.
//!
//! Each request is a span; making its photo is a child of it, on any node, and each stage is a child of that. Work of a request that waits
//! for a slot (views, smaller levels, files) is a child of the request, too.
//!
//! A [`Context`] has at most one span, which ends with the last clone. Without a collector contexts are empty, and calls do nothing.

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use axum::http::{HeaderMap, Uri};
use opentelemetry::propagation::{Extractor, TextMapPropagator as _};
use opentelemetry::trace::{SpanBuilder, SpanKind, Status, TraceContextExt as _, Tracer as _, TracerProvider as _};
use opentelemetry::{Context, KeyValue};
use opentelemetry_http::HeaderExtractor;
use opentelemetry_otlp::{Protocol, SpanExporter, WithExportConfig as _, WithHttpConfig as _};
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::propagation::TraceContextPropagator;
use opentelemetry_sdk::trace::{BatchConfigBuilder, BatchSpanProcessor, Sampler, SdkTracer, SdkTracerProvider};
use reqwest::redirect::Policy;
use tmpi_library::PhotoId;

/// Longest wait of a span before it is sent.
const DELAY: Duration = Duration::from_secs(1);
/// Timeout of the collector.
const PATIENCE: Duration = Duration::from_secs(5);
/// Time for the last spans when the server stops.
const FLUSH: Duration = Duration::from_secs(5);
/// Monitoring routes, which are not traced.
const HEALTH: [&str; 3] = ["/healthz", "/readyz", "/metrics"];
/// Header with a span as a parent (W3C Trace Context).
const PARENT: &str = "traceparent";

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

/// Checks the address of a collector.
///
/// # Errors
/// What is wrong with it.
pub fn check_collector(url: &str) -> Result<(), String> {
    let address: Uri = url.parse().map_err(|e| format!("{e}"))?;
    let is_one = matches!(address.scheme_str(), Some("http" | "https")) && address.authority().is_some();
    if is_one { Ok(()) } else { Err("must be an address such as http://127.0.0.1:4318".into()) }
}

/// Sends spans in batches, on its own thread. Of those that wait, it keeps a bounded number.
fn processor(url: &str) -> Result<BatchSpanProcessor, String> {
    check_collector(url)?;
    // keeps a provider that is installed already
    let _ = rustls::crypto::ring::default_provider().install_default();
    let client = reqwest::blocking::Client::builder().timeout(PATIENCE).redirect(Policy::none());
    // its constructor may not run in an asynchronous context
    let client = std::thread::spawn(|| client.build()).join().map_err(|_| "the HTTP client panicked")?;
    let exporter = SpanExporter::builder()
        .with_http()
        .with_http_client(client.map_err(|e| e.to_string())?)
        .with_protocol(Protocol::HttpBinary)
        .with_timeout(PATIENCE)
        .with_endpoint(format!("{}/v1/traces", url.trim_end_matches('/')))
        .build()
        .map_err(|e| e.to_string())?;
    let config = BatchConfigBuilder::default().with_scheduled_delay(DELAY).build();
    Ok(BatchSpanProcessor::builder(exporter).with_batch_config(config).build())
}

/// Creates and exports spans.
pub struct Traces {
    provider: SdkTracerProvider,
    tracer: SdkTracer,
}

impl Traces {
    /// Exports spans to a collector.
    ///
    /// # Errors
    /// If the address is not valid.
    pub(super) fn open(to: &Collector) -> Result<Self, CollectorError> {
        let processor = processor(&to.url).map_err(|why| CollectorError { url: to.url.clone(), why })?;
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

    /// Starts the span of a request, within its `traceparent`; none for monitoring routes.
    pub fn request(&self, method: &'static str, route: &str, headers: &HeaderMap, peer: Option<IpAddr>) -> Context {
        if HEALTH.contains(&route) {
            return Context::new();
        }
        let mut attributes = vec![KeyValue::new("http.request.method", method), KeyValue::new("http.route", route.to_owned())];
        attributes.extend(peer.map(|peer| KeyValue::new("tmpi.peer", class(peer))));
        let builder = SpanBuilder::from_name(format!("{method} {route}")).with_kind(SpanKind::Server).with_attributes(attributes);
        self.start(builder, &HeaderExtractor(headers))
    }

    /// Starts the span of making a photo, within the span that [`parent`] told, if any.
    pub fn job(&self, parent: Option<&str>, id: PhotoId, attempt: u32) -> JobSpan {
        let attributes = [
            KeyValue::new("tmpi.photo", id.to_string()),
            KeyValue::new("tmpi.job.class", "photo"),
            KeyValue::new("tmpi.job.attempt", i64::from(attempt)),
        ];
        let builder = SpanBuilder::from_name("job").with_kind(SpanKind::Consumer).with_attributes(attributes);
        let carrier: HashMap<_, _> = parent.map(|parent| (PARENT.to_owned(), parent.to_owned())).into_iter().collect();
        JobSpan { span: self.start(builder, &carrier), stage: Mutex::default() }
    }

    /// Starts a span within the `traceparent` of a carrier; without a valid one it begins a new trace.
    fn start(&self, builder: SpanBuilder, carrier: &dyn Extractor) -> Context {
        let outer = TraceContextPropagator::new().extract_with_context(&Context::new(), carrier);
        // children use its tracer
        Context::new().with_value(self.tracer.clone()).with_span(self.tracer.build_with_context(builder, &outer))
    }

    /// Sends the remaining spans and stops; blocks for some seconds at most.
    pub fn end(&self) {
        if let Err(error) = self.provider.shutdown_with_timeout(FLUSH) {
            tracing::warn!(%error, "could not send all traces");
        }
    }
}

/// Starts a span within that of `outer`, if any.
fn child(outer: &Context, name: &'static str, attributes: Option<KeyValue>) -> Context {
    outer.get::<SdkTracer>().map_or_else(Context::new, |tracer| {
        let builder = SpanBuilder::from_name(name).with_attributes(attributes);
        outer.with_span(tracer.build_with_context(builder, outer))
    })
}

/// Starts the span of work of a class within this task's request.
pub fn work(class: &'static str) -> Context {
    child(&Context::current(), "work", Some(KeyValue::new("tmpi.job.class", class)))
}

/// This task's request as the parent of a job: its `traceparent`.
pub fn parent() -> Option<String> {
    let mut carrier = HashMap::new();
    TraceContextPropagator::new().inject_context(&Context::current(), &mut carrier);
    carrier.remove(PARENT)
}

/// Id of the trace, 32 hex digits.
pub fn trace_id(context: &Context) -> Option<String> {
    context.has_active_span().then(|| context.span().span_context().trace_id().to_string())
}

/// Ends the span of an answered request.
pub fn answered(request: &Context, status: u16) {
    let span = request.span();
    span.set_attribute(KeyValue::new("http.response.status_code", i64::from(status)));
    if status >= 500 {
        span.set_status(Status::error(""));
    }
    span.end();
}

/// The span of a photo being made; ends when it is dropped.
#[derive(Debug, Default)]
pub struct JobSpan {
    span: Context,
    stage: Mutex<(&'static str, Context)>,
}

impl JobSpan {
    /// Ends the last stage and starts the next.
    pub fn stage(&self, name: &'static str) {
        let mut stage = self.stage.lock().unwrap_or_else(PoisonError::into_inner);
        if stage.0 != name {
            // end the last one first
            stage.1 = Context::new();
            *stage = (name, child(&self.span, name, None));
        }
    }

    /// Ends the last stage; the server then stores the results.
    pub fn made(&self) {
        *self.stage.lock().unwrap_or_else(PoisonError::into_inner) = ("", Context::new());
    }

    /// Records the outcome; the span ends when it is dropped.
    pub fn end(&self, outcome: &'static str) {
        self.made();
        let span = self.span.span();
        span.set_attribute(KeyValue::new("tmpi.job.outcome", outcome));
        if !matches!(outcome, "done" | "second" | "deleted" | "cancelled") {
            span.set_status(Status::error(outcome));
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
