//! Exporter to the collector: a bounded queue, a thread that empties it, and counters. Nothing waits for it.

use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Duration;

use axum::http::{Request, Response};
use bytes::Bytes;
use opentelemetry::Context;
use opentelemetry_http::{HttpClient, HttpError};
use opentelemetry_otlp::{Protocol, SpanExporter, WithExportConfig as _, WithHttpConfig as _};
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::error::OTelSdkResult;
use opentelemetry_sdk::trace::{BatchConfigBuilder, BatchSpanProcessor, Span, SpanData, SpanProcessor};
use tokio::runtime::Handle;

use super::{Counts, QUEUE};
use crate::server::metrics::Outcome;

/// Spans per batch, and the longest wait of one.
const BATCH: usize = 512;
const DELAY: Duration = Duration::from_secs(1);
/// Timeout of the collector.
const PATIENCE: Duration = Duration::from_secs(5);
/// Most bytes of its answer.
const MOST: usize = 64 << 10;

/// Checks the address of a collector.
///
/// # Errors
/// What is wrong with it.
pub fn check(url: &str) -> Result<(), String> {
    let address: axum::http::Uri = url.parse().map_err(|e| format!("{e}"))?;
    let is_one = matches!(address.scheme_str(), Some("http" | "https")) && address.authority().is_some();
    if is_one { Ok(()) } else { Err("must be an address such as http://127.0.0.1:4318".into()) }
}

/// The span processor for the collector at `url`.
pub fn processor(url: &str, counts: Counts) -> Result<impl SpanProcessor + use<>, String> {
    check(url)?;
    // keeps a provider that is installed already
    let _ = rustls::crypto::ring::default_provider().install_default();
    let client = reqwest::Client::builder().timeout(PATIENCE).redirect(reqwest::redirect::Policy::none()).build();
    let client = Client { client: client.map_err(|e| e.to_string())?, runtime: Handle::current() };
    let exporter = SpanExporter::builder()
        .with_http()
        .with_http_client(client)
        .with_protocol(Protocol::HttpBinary)
        .with_timeout(PATIENCE)
        .with_endpoint(format!("{}/v1/traces", url.trim_end_matches('/')))
        .build()
        .map_err(|e| e.to_string())?;
    for outcome in ["sent", "refused", "dropped"] {
        // so that metrics show them from the start
        drop(counts.get_or_create(&Outcome { outcome }));
    }
    let waiting = Arc::new(AtomicUsize::new(0));
    let exporter = Counted { exporter, waiting: Arc::clone(&waiting), counts: counts.clone(), fails: AtomicBool::new(false) };
    let config =
        BatchConfigBuilder::default().with_max_queue_size(QUEUE).with_max_export_batch_size(BATCH).with_scheduled_delay(DELAY).build();
    Ok(Bounded { queue: BatchSpanProcessor::builder(exporter).with_batch_config(config).build(), waiting, counts })
}

/// An HTTP client that uses the server's runtime, for a thread without one.
#[derive(Debug)]
struct Client {
    client: reqwest::Client,
    runtime: Handle,
}

impl Client {
    async fn ask(client: reqwest::Client, request: Request<Bytes>) -> Result<Response<Bytes>, HttpError> {
        let mut answer = client.execute(request.try_into()?).await?;
        let mut response = Response::builder().status(answer.status());
        if let Some(headers) = response.headers_mut() {
            *headers = std::mem::take(answer.headers_mut());
        }
        let mut body = Vec::new();
        while let Some(chunk) = answer.chunk().await? {
            if body.len() + chunk.len() > MOST {
                return Err("the collector's answer is too long".into());
            }
            body.extend_from_slice(&chunk);
        }
        Ok(response.body(body.into())?)
    }
}

impl HttpClient for Client {
    fn send_bytes<'me, 'out>(
        &'me self,
        request: Request<Bytes>,
    ) -> Pin<Box<dyn Future<Output = Result<Response<Bytes>, HttpError>> + Send + 'out>>
    where
        'me: 'out,
        Self: 'out,
    {
        let asked = self.runtime.spawn(Self::ask(self.client.clone(), request));
        Box::pin(async move { asked.await? })
    }
}

/// Limits the queue, and counts dropped spans.
#[derive(Debug)]
struct Bounded {
    queue: BatchSpanProcessor,
    /// Spans in the queue and in flight.
    waiting: Arc<AtomicUsize>,
    counts: Counts,
}

impl SpanProcessor for Bounded {
    fn on_start(&self, span: &mut Span, context: &Context) {
        self.queue.on_start(span, context);
    }

    fn on_end(&self, span: SpanData) {
        if !span.span_context.is_sampled() {
            return;
        }
        let fits = |n| (n < QUEUE).then_some(n + 1);
        if self.waiting.fetch_update(Ordering::AcqRel, Ordering::Acquire, fits).is_ok() {
            self.queue.on_end(span);
        } else {
            self.counts.get_or_create(&Outcome { outcome: "dropped" }).inc();
        }
    }

    fn force_flush(&self) -> OTelSdkResult {
        self.queue.force_flush()
    }

    fn shutdown_with_timeout(&self, timeout: Duration) -> OTelSdkResult {
        self.queue.shutdown_with_timeout(timeout)
    }

    fn set_resource(&mut self, resource: &Resource) {
        self.queue.set_resource(resource);
    }
}

/// Counts what the collector accepted.
#[derive(Debug)]
struct Counted {
    exporter: SpanExporter,
    waiting: Arc<AtomicUsize>,
    counts: Counts,
    fails: AtomicBool,
}

impl opentelemetry_sdk::trace::SpanExporter for Counted {
    async fn export(&self, batch: Vec<SpanData>) -> OTelSdkResult {
        let spans = batch.len();
        let taken = self.exporter.export(batch).await;
        self.waiting.fetch_sub(spans, Ordering::AcqRel);
        let outcome = if taken.is_ok() { "sent" } else { "refused" };
        self.counts.get_or_create(&Outcome { outcome }).inc_by(spans as u64);
        // log only the first failure and the recovery
        match (&taken, self.fails.swap(taken.is_err(), Ordering::AcqRel)) {
            (Err(error), false) => tracing::warn!(%error, spans, "the collector does not accept traces"),
            (Ok(()), true) => tracing::info!("the collector accepts traces again"),
            _ => {}
        }
        taken
    }

    fn shutdown_with_timeout(&self, timeout: Duration) -> OTelSdkResult {
        self.exporter.shutdown_with_timeout(timeout)
    }

    fn set_resource(&mut self, resource: &Resource) {
        self.exporter.set_resource(resource);
    }
}
