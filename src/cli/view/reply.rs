//! Replies: a status, a kind of content, bytes; and the headers that every reply has.

use std::io::Cursor;

use serde::Serialize;
use tiny_http::{Header, Response};

/// What the page may load and do: its own files and requests to this server, nothing else.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; \
                      base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// A reply to a request.
#[derive(Clone, Debug)]
pub struct Reply {
    pub status: u16,
    kind: &'static str,
    bytes: Vec<u8>,
}

impl Reply {
    pub fn new(kind: &'static str, bytes: impl Into<Vec<u8>>) -> Reply {
        Reply { status: 200, kind, bytes: bytes.into() }
    }

    /// A value as JSON.
    pub fn json(value: &impl Serialize) -> Reply {
        match serde_json::to_vec(value) {
            Ok(bytes) => Reply::new("application/json", bytes),
            Err(error) => Reply::error(500, &error.to_string()),
        }
    }

    /// A JSON object in front of 32-bit floats (little-endian): its length in bytes as a 32-bit number, the object filled
    /// up with spaces to a multiple of four, the numbers.
    pub fn numbers(about: &impl Serialize, numbers: &[f32]) -> Reply {
        let mut text = match serde_json::to_vec(about) {
            Ok(text) => text,
            Err(error) => return Reply::error(500, &error.to_string()),
        };
        text.resize(text.len().next_multiple_of(4), b' ');
        let mut bytes = (text.len() as u32).to_le_bytes().to_vec();
        bytes.extend(text);
        bytes.extend(numbers.iter().flat_map(|x| x.to_le_bytes()));
        Reply::new("application/octet-stream", bytes)
    }

    /// A word on what went wrong, which the page shows.
    pub fn error(status: u16, message: &str) -> Reply {
        let bytes = serde_json::json!({ "error": message }).to_string().into_bytes();
        Reply { status, kind: "application/json", bytes }
    }

    /// For the server.
    pub fn into_response(self) -> Response<Cursor<Vec<u8>>> {
        let whole = Response::from_data(self.bytes).with_status_code(self.status);
        // With its length in front: it is all there.
        let mut response = whole.with_chunked_threshold(usize::MAX);
        let headers = [
            ("Content-Type", self.kind),
            ("Content-Security-Policy", POLICY),
            ("X-Content-Type-Options", "nosniff"),
            ("Referrer-Policy", "no-referrer"),
            ("Cross-Origin-Resource-Policy", "same-origin"),
            ("Cache-Control", "no-store"),
        ];
        for (name, value) in headers {
            if let Ok(header) = Header::from_bytes(name, value) {
                response.add_header(header);
            }
        }
        response
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_stand_at_a_multiple_of_four_behind_what_they_are() {
        for word in ["", "a", "ab", "abc"] {
            let Reply { bytes, .. } = Reply::numbers(&word, &[1.5, -2.0]);
            let length = u32::from_le_bytes(bytes[..4].try_into().unwrap()) as usize;
            assert!(length.is_multiple_of(4));
            assert_eq!(serde_json::from_slice::<String>(&bytes[4..4 + length]).unwrap(), word);
            assert_eq!(bytes[4 + length..], [1.5f32.to_le_bytes(), (-2f32).to_le_bytes()].concat());
        }
    }
}
