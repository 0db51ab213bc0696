//! The server: requests on loopback, each a question for the worker or a file of the page.

use std::io::Read;
use std::net::Ipv4Addr;
use std::sync::Arc;
use std::sync::mpsc::{Sender, channel};

use parallax::{Error, Result};
use tiny_http::{Method, Request, Server};

use super::gallery::Gallery;
use super::guard::{self, admit};
use super::reply::Reply;
use super::work::{Ask, Question, State};

/// The largest file that may be dropped in, in bytes.
const MOST_BYTES: u64 = 64 << 20;

/// Requests that are read at the same time: the page's files come while the worker computes.
const THREADS: usize = 4;

/// A server that answers until the program ends.
pub struct Serving {
    address: String,
}

impl Serving {
    /// What to open in a browser.
    pub fn address(&self) -> &str {
        &self.address
    }
}

/// Begins to serve.
///
/// # Errors
/// If the port is taken, or may not be used.
pub fn start(port: u16, gallery: Arc<Gallery>, state: State, ask: Sender<Question>) -> Result<Serving> {
    let server = Server::http((Ipv4Addr::LOCALHOST, port)).map_err(|e| {
        Error::setting("port", format!("{port} cannot be served on ({e}): give another one, or none for a free one"))
    })?;
    let port = server.server_addr().to_ip().map_or(port, |address| address.port());
    let shared = Arc::new(Shared { server, port, gallery, state });
    for number in 0..THREADS {
        let (shared, ask) = (shared.clone(), ask.clone());
        std::thread::Builder::new()
            .name(format!("requests {number}"))
            .spawn(move || shared.serve(&ask))
            .map_err(|e| Error::Failed(format!("no thread for requests: {e}")))?;
    }
    Ok(Serving { address: format!("http://127.0.0.1:{port}/") })
}

struct Shared {
    server: Server,
    port: u16,
    gallery: Arc<Gallery>,
    state: State,
}

impl Shared {
    fn serve(&self, ask: &Sender<Question>) {
        while let Ok(mut request) = self.server.recv() {
            let reply = self.reply(&mut request, ask);
            // A browser that has gone elsewhere is no reason to stop.
            let _ = request.respond(reply.into_response());
        }
    }

    fn reply(&self, request: &mut Request, ask: &Sender<Question>) -> Reply {
        let sender = guard::Sender {
            host: header(request, "Host"),
            origin: header(request, "Origin"),
            site: header(request, "Sec-Fetch-Site"),
        };
        if let Err(why) = admit(sender, self.port) {
            return Reply::error(403, why);
        }
        let url = request.url().to_owned();
        let (path, query) = url.split_once('?').unwrap_or((&url, ""));
        match (request.method(), path) {
            (Method::Post, "/pictures") => self.take_in(request),
            (Method::Get, "/state") => Reply::json(&self.state),
            (Method::Get, path) => match (file(path), question(path, query)) {
                (Some(reply), _) => reply,
                (None, Some(question)) => answer(question, ask),
                (None, None) => Reply::error(404, "there is nothing of that name"),
            },
            _ => Reply::error(405, "only GET, and POST of pictures"),
        }
    }

    /// A picture that was dropped in.
    fn take_in(&self, request: &mut Request) -> Reply {
        let too_large = || Reply::error(413, "a file of more than 64 MiB: make the picture smaller");
        if request.body_length().is_some_and(|length| length as u64 > MOST_BYTES) {
            return too_large();
        }
        let mut bytes = Vec::new();
        match request.as_reader().take(MOST_BYTES + 1).read_to_end(&mut bytes) {
            Err(error) => Reply::error(400, &format!("the picture did not arrive: {error}")),
            Ok(length) if length as u64 > MOST_BYTES => too_large(),
            Ok(_) => match self.gallery.add(bytes) {
                Ok(number) => Reply::json(&serde_json::json!({ "picture": number })),
                Err(error) => Reply::error(400, &parallax::printable(&error.to_string())),
            },
        }
    }
}

fn header<'a>(request: &'a Request, name: &'static str) -> Option<&'a str> {
    request.headers().iter().find(|header| header.field.equiv(name)).map(|header| header.value.as_str())
}

/// Asks the worker, and waits.
fn answer(ask: Ask, to: &Sender<Question>) -> Reply {
    let (reply, replied) = channel();
    let gone = |_| Reply::error(503, "the program is ending");
    match to.send(Question { ask, reply }) {
        Ok(()) => replied.recv().unwrap_or_else(|e| gone(e.to_string())),
        Err(error) => gone(error.to_string()),
    }
}

/// The page's own files: the only ones that are served.
fn file(path: &str) -> Option<Reply> {
    let (kind, text) = match path {
        "/" => ("text/html; charset=utf-8", include_str!("page.html")),
        "/page.css" => ("text/css; charset=utf-8", include_str!("page.css")),
        "/page.js" => ("text/javascript; charset=utf-8", include_str!("page.js")),
        "/map.js" => ("text/javascript; charset=utf-8", include_str!("map.js")),
        "/cloud.js" => ("text/javascript; charset=utf-8", include_str!("cloud.js")),
        "/favicon.ico" => return Some(Reply::new("image/x-icon", Vec::new())),
        _ => return None,
    };
    Some(Reply::new(kind, text))
}

/// The question that a path and its query ask: `/picture/3`, `/depth/3?weights=0`, `/attention/3?weights=1&x=0.5&y=0.25`.
fn question(path: &str, query: &str) -> Option<Ask> {
    let (what, number) = path.strip_prefix('/')?.split_once('/')?;
    let picture = number.parse().ok()?;
    let value = |name: &str| {
        let pairs = query.split('&').filter_map(|pair| pair.split_once('='));
        pairs.into_iter().find(|(key, _)| *key == name).map(|(_, value)| value)
    };
    let weights = || value("weights").map_or(Some(0), |n| n.parse().ok());
    let share = |name: &str| value(name)?.parse().ok().filter(|x| (0.0..1.0).contains(x));
    match what {
        "picture" => Some(Ask::Picture(picture)),
        "depth" => Some(Ask::Depth { picture, weights: weights()? }),
        "attention" => Some(Ask::Attention { picture, weights: weights()?, at: [share("x")?, share("y")?] }),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_are_questions_or_nothing() {
        assert_eq!(question("/picture/12", ""), Some(Ask::Picture(12)));
        assert_eq!(question("/depth/0", ""), Some(Ask::Depth { picture: 0, weights: 0 }));
        assert_eq!(question("/depth/3", "a=b&weights=1"), Some(Ask::Depth { picture: 3, weights: 1 }));
        let at = [0.5, 0.25];
        assert_eq!(question("/attention/3", "x=0.5&y=0.25"), Some(Ask::Attention { picture: 3, weights: 0, at }));
        for (path, query) in [
            ("/picture/-1", ""),
            ("/picture/../etc/passwd", ""),
            ("/picture/", ""),
            ("/depth/0", "weights=x"),
            ("/attention/3", ""),
            ("/attention/3", "x=1.0&y=0"),
            ("/attention/3", "x=nan&y=0"),
            ("//etc/passwd", ""),
            ("/page.html", ""),
        ] {
            assert_eq!(question(path, query), None, "{path}?{query}");
            assert!(file(path).is_none(), "{path}");
        }
    }
}
