//! `parallax view` from the outside: the page and its maps over HTTP, and nothing for strangers.
#![cfg(feature = "cli")]

use std::fs;
use std::io::{BufRead, BufReader, Cursor, Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use image::{ImageFormat, Rgb, RgbImage};
use parallax::formats::npy;
use parallax::monovit::Preset;
use parallax::networks::DepthNetwork;
use parallax::train::RunConfig;
use parallax::train::run::write_weights;

/// A program that serves until the test ends.
struct View {
    child: Child,
    host: String,
}

impl Drop for View {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Weights of the smallest size as they are drawn.
fn weights(folder: &Path) -> PathBuf {
    let path = folder.join("pico.safetensors");
    let config = RunConfig { height: 64, width: 96, ..RunConfig::new(Preset::Pico, 1) };
    let (_, params) = DepthNetwork::new::<f32>(config.model(), 11);
    write_weights(&path, &params, &config.setup()).expect("weights");
    path
}

fn picture() -> RgbImage {
    RgbImage::from_fn(120, 70, |x, y| Rgb([2 * x as u8, 3 * y as u8, (x * y) as u8]))
}

fn png() -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    picture().write_to(&mut bytes, ImageFormat::Png).expect("a PNG");
    bytes.into_inner()
}

impl View {
    fn start(arguments: &[&Path]) -> View {
        let mut command = Command::new(env!("CARGO_BIN_EXE_parallax"));
        command.arg("view").args(arguments).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().expect("the program runs");
        let mut line = String::new();
        BufReader::new(child.stdout.take().expect("piped")).read_line(&mut line).expect("a line");
        let host = line.split("http://").nth(1).and_then(|rest| rest.split('/').next());
        let host = host.unwrap_or_else(|| panic!("an address expected: {line:?}")).to_owned();
        View { child, host }
    }

    /// Sends a request with headers, and gives status, headers and body.
    fn send(&self, method: &str, path: &str, headers: &[(&str, &str)], body: &[u8]) -> (u16, String, Vec<u8>) {
        let mut stream = TcpStream::connect(&self.host).expect("a connection");
        let mut text = format!("{method} {path} HTTP/1.1\r\nConnection: close\r\nContent-Length: {}\r\n", body.len());
        if !headers.iter().any(|(name, _)| *name == "Host") {
            text += &format!("Host: {}\r\n", self.host);
        }
        headers.iter().for_each(|(name, value)| text += &format!("{name}: {value}\r\n"));
        stream.write_all(format!("{text}\r\n").as_bytes()).expect("sent");
        // The server may hang up before it has read everything.
        let _ = stream.write_all(body);
        let mut reply = Vec::new();
        let _ = stream.read_to_end(&mut reply);
        let end = reply.windows(4).position(|w| w == b"\r\n\r\n").expect("headers");
        let head = String::from_utf8_lossy(&reply[..end]).into_owned();
        let status = head.split(' ').nth(1).and_then(|status| status.parse().ok()).expect("a status");
        (status, head, reply[end + 4..].to_vec())
    }

    fn get(&self, path: &str) -> (u16, String, Vec<u8>) {
        self.send("GET", path, &[], b"")
    }
}

/// A JSON object and the floats behind it.
fn unpack(bytes: &[u8]) -> (serde_json::Value, Vec<f32>) {
    let length = u32::from_le_bytes(bytes[..4].try_into().expect("a length")) as usize;
    let about = serde_json::from_slice(&bytes[4..4 + length]).expect("an object");
    let numbers = bytes[4 + length..].chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().expect("four bytes")));
    (about, numbers.collect())
}

#[test]
fn a_picture_that_is_dropped_in_has_the_depth_that_predict_writes() {
    let folder = tempfile::tempdir().expect("a folder");
    let (weights, file) = (weights(folder.path()), folder.path().join("a.png"));
    fs::write(&file, png()).expect("written");
    let view = View::start(&[&file, "--weights".as_ref(), &weights, "--fov".as_ref(), "90".as_ref()]);

    let (status, head, body) = view.get("/");
    assert!(status == 200 && String::from_utf8_lossy(&body).contains("<title>"), "{head}");
    assert!(head.contains("default-src 'none'") && head.contains("nosniff"), "{head}");
    let state: serde_json::Value = serde_json::from_slice(&view.get("/state").2).expect("an object");
    assert!(state["pictures"][0] == "a" && state["weights"][0]["unit"] == "relative", "{state}");
    for name in ["/page.css", "/page.js", "/map.js", "/cloud.js"] {
        assert_eq!(view.get(name).0, 200, "{name}");
    }

    let (status, _, body) = view.send("POST", "/pictures", &[], &png());
    assert_eq!((status, &body[..]), (200, &br#"{"picture":1}"#[..]));
    let mut command = Command::new(env!("CARGO_BIN_EXE_parallax"));
    command.arg("predict").arg(&file).arg("--weights").arg(&weights).args(["--npy", "--out"]).arg(folder.path());
    assert!(command.output().expect("the program runs").status.success());
    let expected = npy::read(&folder.path().join("a.npy")).expect("an array").to_f32().expect("floats");
    for path in ["/depth/0", "/depth/1"] {
        let (about, found) = unpack(&view.get(path).2);
        assert_eq!((about["width"].as_u64(), about["height"].as_u64()), (Some(120), Some(70)));
        assert!((about["fx"].as_f64().expect("a number") - 60.0).abs() < 1e-9 && about["view_by"] == "flag", "{about}");
        assert_eq!(found, expected, "{path}");
    }
    let (_, head, jpeg) = view.get("/picture/1");
    assert!(head.contains("image/jpeg"));
    assert_eq!(image::load_from_memory(&jpeg).expect("a picture").to_rgb8().dimensions(), (120, 70));

    let (about, numbers) = unpack(&view.get("/attention/1?x=0.5&y=0.5").2);
    let layers = about["layers"].as_array().expect("layers");
    let sizes =
        layers.iter().map(|l| (l["width"].as_u64().expect("a size") * l["height"].as_u64().expect("a size")) as usize);
    assert!(!layers.is_empty() && sizes.sum::<usize>() == numbers.len() && numbers.iter().any(|x| *x != 0.0));
}

#[test]
fn what_is_no_picture_or_no_path_is_refused_in_words_and_the_rest_goes_on() {
    let folder = tempfile::tempdir().expect("a folder");
    let view = View::start(&["--weights".as_ref(), &weights(folder.path())]);
    let (status, _, body) = view.send("POST", "/pictures", &[], b"GIF89a, or so");
    assert!(status == 400 && String::from_utf8_lossy(&body).contains("PNG, JPEG or WebP"), "{status}");
    for path in ["/../Cargo.toml", "/picture/..%2f..%2fetc%2fpasswd", "/etc/passwd", "/page.html", "//", "/depth/x"] {
        assert_eq!(view.get(path).0, 404, "{path}");
    }
    for path in ["/depth/0", "/picture/7", "/depth/0?weights=3", "/attention/99999999999999999?x=0&y=0"] {
        let (status, _, body) = view.get(path);
        assert!(status == 400 && String::from_utf8_lossy(&body).contains("there "), "{path}: {status}");
    }
    assert_eq!(view.send("DELETE", "/pictures", &[], b"").0, 405);
    // A length that is claimed is believed before 64 MiB are read.
    let mut stream = TcpStream::connect(&view.host).expect("a connection");
    let head = format!("POST /pictures HTTP/1.1\r\nHost: {}\r\nContent-Length: 100000000\r\n\r\n", view.host);
    stream.write_all(head.as_bytes()).expect("sent");
    let mut reply = [0; 12];
    stream.read_exact(&mut reply).expect("a reply");
    assert_eq!(&reply, b"HTTP/1.1 413");
    drop(stream);
    assert_eq!(view.get("/state").0, 200);
}

#[test]
fn other_pages_and_other_names_are_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let view = View::start(&["--weights".as_ref(), &weights(folder.path())]);
    let own = format!("http://{}", view.host);
    assert_eq!(view.send("POST", "/pictures", &[("Origin", &own)], &png()).0, 200);
    for headers in [
        [("Host", "evil.example")],
        [("Host", "127.0.0.1:1")],
        [("Origin", "http://evil.example")],
        [("Origin", "null")],
        [("Sec-Fetch-Site", "cross-site")],
    ] {
        for (method, path) in [("GET", "/"), ("GET", "/picture/0"), ("POST", "/pictures")] {
            assert_eq!(view.send(method, path, &headers, b"").0, 403, "{headers:?} {path}");
        }
    }
}

#[test]
fn a_port_that_is_taken_and_weights_that_are_none_are_said() {
    let taken = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
    let port = taken.local_addr().expect("an address").port().to_string();
    let folder = tempfile::tempdir().expect("a folder");
    let weights = weights(folder.path());
    let fails = |arguments: &[&str], words: &[&str]| {
        let output =
            Command::new(env!("CARGO_BIN_EXE_parallax")).arg("view").args(arguments).output().expect("it runs");
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(!output.status.success() && words.iter().all(|word| said.contains(word)), "{said}");
    };
    let weights = weights.to_str().expect("a name");
    fails(&["--weights", weights, "--port", &port], &["--port", &port, "free"]);
    fails(&["--weights", "nowhere"], &["nowhere"]);
    fails(&["--weights", weights, "--against", "nowhere"], &["nowhere"]);
    let empty = tempfile::tempdir().expect("a folder");
    fails(&["--weights", weights, empty.path().to_str().expect("a name")], &["no PNG, JPEG or WebP"]);
}
