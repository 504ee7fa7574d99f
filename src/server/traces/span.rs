//! Spans of requests, their jobs and stages.

use std::collections::HashMap;
use std::fmt;
use std::sync::{Mutex, MutexGuard, PoisonError};

use opentelemetry::propagation::TextMapPropagator as _;
use opentelemetry::trace::{SpanBuilder, Status, TraceContextExt as _, Tracer as _};
use opentelemetry::{Context, KeyValue};
use opentelemetry_sdk::propagation::TraceContextPropagator;
use opentelemetry_sdk::trace::{SdkTracer, Span};

/// Name of the header and of its value in a carrier.
const PARENT: &str = "traceparent";

tokio::task_local! {
    /// The span of this task's request.
    pub static TRACE: Option<ActiveSpan>;
}

/// The span of this task's request; `None` if it is not traced.
#[must_use]
pub fn current() -> Option<ActiveSpan> {
    TRACE.try_with(Clone::clone).ok().flatten()
}

/// The parent of a job that this request starts.
#[must_use]
pub fn parent() -> Option<Parent> {
    current().and_then(|current| current.parent())
}

/// A span as a parent: `traceparent` of W3C Trace Context.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Parent(String);

impl Parent {
    /// As text, for the job.
    #[must_use]
    pub fn into_text(self) -> String {
        self.0
    }

    /// From the job's text.
    #[must_use]
    pub fn read(text: &str) -> Self {
        Self(text.to_owned())
    }

    /// The context for child spans; an invalid text starts a new trace.
    pub(super) fn context(&self) -> Context {
        let carrier = HashMap::from([(PARENT.to_owned(), self.0.clone())]);
        TraceContextPropagator::new().extract_with_context(&Context::new(), &carrier)
    }
}

/// A running span; ends when the last clone is dropped.
#[derive(Clone)]
pub struct ActiveSpan {
    tracer: SdkTracer,
    context: Context,
}

impl fmt::Debug for ActiveSpan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("ActiveSpan").field(&self.trace()).finish()
    }
}

impl ActiveSpan {
    pub(super) fn new(tracer: SdkTracer, span: Span) -> Self {
        Self { tracer, context: Context::new().with_span(span) }
    }

    /// Id of the trace, 32 hex digits.
    #[must_use]
    pub fn trace(&self) -> String {
        self.context.span().span_context().trace_id().to_string()
    }

    /// As a parent of further spans.
    #[must_use]
    pub fn parent(&self) -> Option<Parent> {
        let mut carrier = HashMap::new();
        TraceContextPropagator::new().inject_context(&self.context, &mut carrier);
        carrier.remove(PARENT).map(Parent)
    }

    /// Ends the span of an answered request.
    pub fn answered(self, status: u16) {
        let span = self.context.span();
        span.set_attribute(KeyValue::new("http.response.status_code", i64::from(status)));
        if status >= 500 {
            span.set_status(Status::error(""));
        }
        span.end();
    }

    fn child(&self, name: &'static str, attributes: Vec<KeyValue>) -> Self {
        let span = self.tracer.build_with_context(SpanBuilder::from_name(name).with_attributes(attributes), &self.context);
        Self::new(self.tracer.clone(), span)
    }

    /// Starts the span of work of a class within the request.
    #[must_use]
    pub fn work(&self, class: &'static str) -> WorkSpan {
        WorkSpan { _span: self.child("work", vec![KeyValue::new("tmpi.job.class", class)]) }
    }
}

/// The span of work within a request; ends when it is dropped.
#[derive(Debug)]
pub struct WorkSpan {
    _span: ActiveSpan,
}

/// The trace of a photo being made, if any.
#[derive(Debug, Default)]
pub struct JobSpan(Option<Traced>);

#[derive(Debug)]
struct Traced {
    job: ActiveSpan,
    /// The current stage.
    stage: Mutex<Option<(&'static str, ActiveSpan)>>,
}

impl Traced {
    fn stage(&self) -> MutexGuard<'_, Option<(&'static str, ActiveSpan)>> {
        self.stage.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl JobSpan {
    /// With a started span.
    #[must_use]
    pub fn new(job: ActiveSpan) -> Self {
        Self(Some(Traced { job, stage: Mutex::default() }))
    }

    /// Ends the last stage and starts the next.
    pub fn stage(&self, name: &'static str) {
        let Some(traced) = &self.0 else { return };
        let mut stage = traced.stage();
        if stage.as_ref().is_none_or(|(at, _)| *at != name) {
            // end the last one first
            *stage = None;
            *stage = Some((name, traced.job.child(name, Vec::new())));
        }
    }

    /// Ends the last stage; the server then stores the results.
    pub fn made(&self) {
        if let Some(traced) = &self.0 {
            *traced.stage() = None;
        }
    }

    /// Ends the span.
    pub fn end(self, outcome: &'static str) {
        self.made();
        let Some(Traced { job, .. }) = self.0 else { return };
        let span = job.context.span();
        span.set_attribute(KeyValue::new("tmpi.job.outcome", outcome));
        if !matches!(outcome, "done" | "second" | "deleted" | "cancelled") {
            span.set_status(Status::error(outcome));
        }
        span.end();
    }
}
