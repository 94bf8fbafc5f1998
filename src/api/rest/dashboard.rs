//! The dashboard: the page at `/` for browsers, and its files below `/ui/`. The files are in `clients/web` and built into the program.
//! A program that asks for `/` gets name, version and endpoints of the server.

use std::sync::{Arc, LazyLock};

use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use serde::Serialize;
use sha2::{Digest, Sha256};
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::extract::Path;
use super::openapi::{BadRequest, Description, NotFound};
use crate::service::{App, Error};

/// The routes.
pub(super) fn router() -> OpenApiRouter<Arc<App>> {
    OpenApiRouter::new().routes(routes!(index)).routes(routes!(file))
}

/// A file of the dashboard.
struct File {
    name: &'static str,
    bytes: &'static [u8],
    /// Changes with the bytes, so that a browser asks again but loads only what has changed.
    etag: HeaderValue,
}

impl File {
    fn new(name: &'static str, bytes: &'static [u8]) -> Self {
        let digest = hex::encode(&Sha256::digest(bytes)[..12]);
        let etag = HeaderValue::try_from(format!("\"{digest}\"")).expect("a digest in quotes is a header value");
        Self { name, bytes, etag }
    }
}

macro_rules! files {
    ($($name:literal),* $(,)?) => {
        LazyLock::new(|| vec![$(File::new($name, include_bytes!(concat!("../../../clients/web/", $name)))),*])
    };
}

static FILES: LazyLock<Vec<File>> = files![
    "index.html",
    "app.css",
    "app.js",
    "api.js",
    "chart.js",
    "compare.js",
    "console.js",
    "curves.js",
    "edit.js",
    "flight.js",
    "format.js",
    "htm-preact-3.1.1.js",
    "icon.svg",
    "job.js",
    "jobs.js",
    "palette.js",
    "player.js",
    "policies.js",
    "report.js",
    "route.js",
    "scene.js",
    "serving.js",
    "submit.js",
    "theme.js",
    "ui.js",
    "uplot-1.6.32.css",
    "uplot-1.6.32.js",
];

impl File {
    fn content_type(&self) -> &'static str {
        match self.name.rsplit_once('.').map(|(_, end)| end) {
            Some("html") => "text/html; charset=utf-8",
            Some("css") => "text/css; charset=utf-8",
            Some("svg") => "image/svg+xml",
            _ => "text/javascript; charset=utf-8",
        }
    }

    /// The file, or 304 if the browser has it already.
    fn respond(&self, request: &HeaderMap) -> Response {
        let known = request.get_all(header::IF_NONE_MATCH).iter().filter_map(|tags| tags.to_str().ok());
        let is_known = known.flat_map(|tags| tags.split(',')).any(|tag| tag.trim().trim_start_matches("W/") == self.etag);
        let cached = [(header::ETAG, self.etag.clone()), (header::CACHE_CONTROL, HeaderValue::from_static("no-cache"))];
        if is_known {
            return (StatusCode::NOT_MODIFIED, cached).into_response();
        }
        (cached, [(header::CONTENT_TYPE, self.content_type())], self.bytes).into_response()
    }
}

fn find(name: &str) -> Option<&'static File> {
    FILES.iter().find(|file| file.name == name)
}

#[derive(Serialize, ToSchema)]
#[schema(as = Server)]
struct Index {
    name: &'static str,
    version: &'static str,
    /// Methods and paths.
    #[schema(value_type = Vec<String>)]
    endpoints: Arc<[String]>,
}

/// Response header of what depends on the `accept` of the request.
const BY_ACCEPT: (HeaderName, HeaderValue) = (header::VARY, HeaderValue::from_static("accept"));

/// The dashboard for browsers; name, version and endpoints of the server for programs
///
/// The dashboard is sent if the header `accept` names `text/html`.
#[utoipa::path(
    get, path = "/", operation_id = "index", tag = "operations",
    responses((status = 200, description = "The dashboard, or name, version and endpoints.", content(
        (Index = "application/json"), (String = "text/html")
    )))
)]
async fn index(headers: HeaderMap, Extension(description): Extension<Description>) -> Response {
    let mut accepted = headers.get_all(header::ACCEPT).iter().filter_map(|kinds| kinds.to_str().ok());
    if let Some(page) = find("index.html").filter(|_| accepted.any(|kinds| kinds.contains("text/html"))) {
        ([BY_ACCEPT], page.respond(&headers)).into_response()
    } else {
        let index = Index { name: "qedgix", version: env!("CARGO_PKG_VERSION"), endpoints: description.operations };
        ([BY_ACCEPT], Json(index)).into_response()
    }
}

/// A file of the dashboard
#[utoipa::path(
    get, path = "/ui/{file}", operation_id = "dashboardFile", tag = "operations",
    params(("file" = String, Path, description = "Name of the file.", example = "app.css")),
    responses(
        (status = 200, description = "The file.", content(
            (String = "text/css"), (String = "text/javascript"), (String = "text/html"), (String = "image/svg+xml")
        )),
        (status = 304, description = "The file is the one in the header `if-none-match`."),
        BadRequest, NotFound
    )
)]
async fn file(Path(name): Path<String>, headers: HeaderMap) -> Result<Response, Error> {
    let file = find(&name).ok_or_else(|| Error::not_found("file", name))?;
    Ok(file.respond(&headers))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_file_is_built_in() {
        let directory = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("clients/web");
        let mut there: Vec<String> = std::fs::read_dir(directory)
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .filter(|name| !["README.md", "licenses"].contains(&name.as_str()))
            .collect();
        let mut listed: Vec<&str> = FILES.iter().map(|file| file.name).collect();
        there.sort_unstable();
        listed.sort_unstable();
        assert_eq!(there, listed);
    }

    #[test]
    fn a_known_file_is_not_sent_again() {
        let file = find("app.css").unwrap();
        let first = file.respond(&HeaderMap::new());
        assert_eq!(
            (first.status(), first.headers()[header::CONTENT_TYPE].as_bytes()),
            (StatusCode::OK, &b"text/css; charset=utf-8"[..])
        );
        for (tag, status) in [
            (first.headers()[header::ETAG].clone(), StatusCode::NOT_MODIFIED),
            (HeaderValue::try_from(format!("\"x\", W/{}", file.etag.to_str().unwrap())).unwrap(), StatusCode::NOT_MODIFIED),
            (HeaderValue::from_static("\"x\""), StatusCode::OK),
        ] {
            assert_eq!(file.respond(&HeaderMap::from_iter([(header::IF_NONE_MATCH, tag)])).status(), status);
        }
    }
}
