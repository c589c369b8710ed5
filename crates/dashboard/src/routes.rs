//! Requests and answers.

use std::sync::Arc;

use axum::extract::{Query, Request, State};
use axum::http::header::{
    CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE, X_CONTENT_TYPE_OPTIONS,
};
use axum::http::{HeaderValue, StatusCode};
use axum::middleware::{from_fn, from_fn_with_state};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use axum::{Json, Router};
use serde::Deserialize;
use tower_http::services::ServeFile;

use crate::live::{Live, Sources};
use crate::media::{Media, is_media};
use crate::runs::{Overview, Runs};
use crate::series::Series;
use crate::{Options, guard};

/// Nothing comes from elsewhere, and nothing may be framed.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; media-src 'self'; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// The page: path, type and text.
const ASSETS: &[(&str, &str, &str)] = &[
    (
        "/",
        "text/html; charset=utf-8",
        include_str!("../assets/index.html"),
    ),
    (
        "/style.css",
        "text/css; charset=utf-8",
        include_str!("../assets/style.css"),
    ),
    (
        "/app.js",
        "text/javascript; charset=utf-8",
        include_str!("../assets/app.js"),
    ),
    (
        "/chart.js",
        "text/javascript; charset=utf-8",
        include_str!("../assets/chart.js"),
    ),
    (
        "/show.js",
        "text/javascript; charset=utf-8",
        include_str!("../assets/show.js"),
    ),
    (
        "/probe.js",
        "text/javascript; charset=utf-8",
        include_str!("../assets/probe.js"),
    ),
    (
        "/live.js",
        "text/javascript; charset=utf-8",
        include_str!("../assets/live.js"),
    ),
];

struct Shared {
    runs: Runs,
    sources: Option<Sources>,
}

type Answer<T> = Result<T, (StatusCode, String)>;

pub(crate) fn router(options: Options) -> Router {
    let shared = Arc::new(Shared {
        runs: Runs::new(options.root),
        sources: options.sources,
    });
    let mut router = Router::new()
        .route("/api/runs", get(runs))
        .route("/api/series", get(series))
        .route("/api/media", get(media))
        .route("/api/file", get(file))
        .route("/api/live", get(live));
    for &(path, kind, text) in ASSETS {
        router = router.route(
            path,
            get(move || async move { ([(CONTENT_TYPE, kind)], text) }),
        );
    }
    router
        .with_state(shared)
        .layer(from_fn(headers))
        .layer(from_fn_with_state(options.guard, guard::check))
}

async fn headers(request: Request, next: axum::middleware::Next) -> Response {
    let mut response = next.run(request).await;
    let headers = response.headers_mut();
    headers.insert(CONTENT_SECURITY_POLICY, HeaderValue::from_static(POLICY));
    headers.insert(X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    headers.insert(CACHE_CONTROL, HeaderValue::from_static("no-cache"));
    response
}

async fn runs(State(shared): State<Arc<Shared>>) -> Answer<Json<Overview>> {
    let reading = shared.clone();
    Ok(Json(Overview {
        root: shared.runs.root().display().to_string(),
        live: shared.sources.is_some(),
        runs: reads(move || reading.runs.list()).await?,
    }))
}

#[derive(Deserialize)]
struct OfMetric {
    run: String,
    metric: String,
}

async fn series(
    State(shared): State<Arc<Shared>>,
    Query(wanted): Query<OfMetric>,
) -> Answer<Json<Series>> {
    let series = reads(move || {
        let folder = shared.runs.folder(&wanted.run);
        folder
            .map(|folder| shared.runs.series(&folder, &wanted.metric))
            .transpose()
    });
    series.await?.map(Json).ok_or_else(no_such_run)
}

#[derive(Deserialize)]
struct OfRun {
    run: String,
}

async fn media(
    State(shared): State<Arc<Shared>>,
    Query(wanted): Query<OfRun>,
) -> Answer<Json<Media>> {
    let media = reads(move || {
        Ok(shared
            .runs
            .folder(&wanted.run)
            .map(|folder| Media::of(&folder)))
    });
    media.await?.map(Json).ok_or_else(no_such_run)
}

#[derive(Deserialize)]
struct OfFile {
    run: String,
    name: String,
}

async fn file(
    State(shared): State<Arc<Shared>>,
    Query(wanted): Query<OfFile>,
    request: Request,
) -> Answer<Response> {
    if !is_media(&wanted.name) {
        return Err((StatusCode::NOT_FOUND, "there is no such file".to_owned()));
    }
    let folder = reads(move || Ok(shared.runs.folder(&wanted.run))).await?;
    let path = folder
        .ok_or_else(no_such_run)?
        .join("media")
        .join(wanted.name);
    match ServeFile::new(path).try_call(request).await {
        Ok(response) => Ok(response.into_response()),
        Err(error) => Err(failed(&error)),
    }
}

async fn live(State(shared): State<Arc<Shared>>) -> Json<Live> {
    Json(match &shared.sources {
        Some(sources) => sources.ask().await,
        None => Live::default(),
    })
}

/// Reads the disk where waiting for it holds nobody up.
async fn reads<T: Send + 'static>(
    read: impl FnOnce() -> std::io::Result<T> + Send + 'static,
) -> Answer<T> {
    match tokio::task::spawn_blocking(read).await {
        Ok(Ok(value)) => Ok(value),
        Ok(Err(error)) => Err(failed(&error)),
        Err(error) => Err((StatusCode::INTERNAL_SERVER_ERROR, error.to_string())),
    }
}

fn failed(error: &std::io::Error) -> (StatusCode, String) {
    let words = format!("cannot read the run: {error}");
    (StatusCode::INTERNAL_SERVER_ERROR, words)
}

fn no_such_run() -> (StatusCode, String) {
    (StatusCode::NOT_FOUND, "there is no such run".to_owned())
}
