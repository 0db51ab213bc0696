//! Who may ask: pages that this program served, on this machine.
//!
//! Any page in the browser can send requests to 127.0.0.1, and a name under somebody else's control can be made to point
//! there (DNS rebinding). So a request counts only if it names this server as the host and, where the browser says where it
//! comes from, comes from one of its own pages.

/// What a request says of itself; headers it lacks are `None`.
#[derive(Clone, Copy, Debug, Default)]
pub struct Sender<'a> {
    pub host: Option<&'a str>,
    pub origin: Option<&'a str>,
    /// `Sec-Fetch-Site`.
    pub site: Option<&'a str>,
}

/// Whether a request to the server at `port` may be answered; why not, if it may not.
pub fn admit(sender: Sender, port: u16) -> Result<(), &'static str> {
    let ours =
        |host: &str| [format!("127.0.0.1:{port}"), format!("localhost:{port}")].contains(&host.to_ascii_lowercase());
    if !sender.host.is_some_and(ours) {
        return Err("this server answers to 127.0.0.1 and localhost alone");
    }
    if sender.origin.is_some_and(|origin| !origin.strip_prefix("http://").is_some_and(ours)) {
        return Err("this server answers to its own page alone");
    }
    // A person who follows a bookmark or types the address comes from `none`.
    if sender.site.is_some_and(|site| !["same-origin", "none"].contains(&site)) {
        return Err("this server answers to its own page alone: open its address yourself");
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn strangers_are_refused() {
        let host = Some("127.0.0.1:8000");
        let own = Sender { host, ..Sender::default() };
        assert!(admit(own, 8000).is_ok() && admit(Sender { host: Some("LOCALHOST:8000"), ..own }, 8000).is_ok());
        assert!(
            admit(Sender { origin: Some("http://127.0.0.1:8000"), site: Some("same-origin"), ..own }, 8000).is_ok()
        );
        for host in [
            None,
            Some(""),
            Some("evil.example"),
            Some("127.0.0.1"),
            Some("127.0.0.1:8001"),
            Some("127.0.0.1:8000.evil.example"),
        ] {
            assert!(admit(Sender { host, ..own }, 8000).is_err(), "{host:?}");
        }
        for origin in
            ["null", "http://evil.example", "https://127.0.0.1:8000", "http://127.0.0.1:9000", "127.0.0.1:8000"]
        {
            assert!(admit(Sender { origin: Some(origin), ..own }, 8000).is_err(), "{origin}");
        }
        for site in ["cross-site", "same-site", "?"] {
            assert!(admit(Sender { site: Some(site), ..own }, 8000).is_err(), "{site}");
        }
    }
}
