//! Where messages may go. A server must not become the hand of its callers in networks that only the server reaches: without
//! `--webhook-allow`, only addresses of the public internet are contacted, whatever names lead to them.

use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::sync::Arc;

use reqwest::Url;
use reqwest::dns::{Addrs, Name, Resolve, Resolving};

use crate::invalid::Invalid;

/// Hosts that may have any address.
#[derive(Clone, Debug, Default)]
pub(super) struct AllowedReceivers(Arc<Vec<String>>);

impl AllowedReceivers {
    pub(super) fn new(hosts: &[String]) -> Self {
        let plain = |host: &String| host.trim_matches(['[', ']']).trim_end_matches('.').to_ascii_lowercase();
        Self(Arc::new(hosts.iter().map(plain).collect()))
    }

    fn names(&self, host: &str) -> bool {
        let host = host.trim_matches(['[', ']']).trim_end_matches('.');
        self.0.iter().any(|allowed| allowed.eq_ignore_ascii_case(host))
    }

    /// Checks the host of a URL as far as possible without asking for its addresses.
    ///
    /// # Errors
    /// [`Invalid`] with `field` for an address that is not public, and for names of this machine.
    pub(super) fn check(&self, field: &str, url: &Url) -> Result<(), Invalid> {
        let host = url.host_str().unwrap_or_default();
        let local_name = host.trim_end_matches('.').rsplit('.').next().is_some_and(|end| end.eq_ignore_ascii_case("localhost"));
        let address = host.trim_matches(['[', ']']).parse().ok();
        if self.names(host) || (!local_name && address.is_none_or(is_public)) {
            return Ok(());
        }
        Err(Invalid::new(field, host, "a host with a public address, or one of --webhook-allow of the server"))
    }
}

/// Finds the addresses of a host when a message is sent, so that a name cannot point to other addresses than were checked.
impl Resolve for AllowedReceivers {
    fn resolve(&self, name: Name) -> Resolving {
        let any = self.names(name.as_str());
        Box::pin(async move {
            let found = tokio::net::lookup_host((name.as_str(), 0)).await?;
            let allowed: Vec<SocketAddr> = found.filter(|address| any || is_public(address.ip())).collect();
            if allowed.is_empty() {
                let message = "the host has no public address (see --webhook-allow)";
                return Err(io::Error::new(io::ErrorKind::PermissionDenied, message).into());
            }
            Ok(Box::new(allowed.into_iter()) as Addrs)
        })
    }
}

/// Whether an address is one of the public internet.
fn is_public(address: IpAddr) -> bool {
    match address.to_canonical() {
        IpAddr::V4(v4) => is_public_v4(v4),
        IpAddr::V6(v6) => is_public_v6(v6),
    }
}

fn is_public_v4(address: Ipv4Addr) -> bool {
    let [a, b, c, _] = address.octets();
    let special = address.is_private()
        || address.is_loopback()
        || address.is_link_local()
        || address.is_documentation()
        || a == 0
        // Shared by the customers of a provider.
        || (a == 100 && (64..128).contains(&b))
        // Assignments of protocols, and the former relays of 6to4.
        || (a == 192 && b == 0 && c == 0)
        || (a == 192 && b == 88 && c == 99)
        // Benchmarks of networks.
        || (a == 198 && (18..20).contains(&b))
        // Multicast, reserved, broadcast.
        || a >= 224;
    !special
}

fn is_public_v6(address: Ipv6Addr) -> bool {
    let [a, b, c, d, e, f, g, h] = address.segments();
    let embedded = |high: u16, low: u16| {
        let ([a, b], [c, d]) = (high.to_be_bytes(), low.to_be_bytes());
        is_public_v4(Ipv4Addr::new(a, b, c, d))
    };
    match (a, b) {
        // NAT64 and 6to4 lead to the IPv4 address that they contain.
        (0x64, 0xff9b) => [c, d, e, f] == [0; 4] && embedded(g, h),
        (0x2002, _) => embedded(b, c),
        // Assignments of protocols (Teredo among them), and documentation.
        (0x2001, 0..0x200 | 0xdb8) | (0x3fff, 0..0x1000) => false,
        // All other addresses outside of 2000::/3 are for special purposes.
        _ => (0x2000..0x4000).contains(&a),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_public_addresses_are_public() {
        for public in ["1.1.1.1", "100.63.0.1", "172.32.0.1", "192.1.0.1", "2606:4700::1", "64:ff9b::101:101", "2002:101:101::1"]
        {
            assert!(is_public(public.parse().unwrap()), "{public}");
        }
        for special in [
            "0.0.0.0",
            "10.1.2.3",
            "100.64.0.1",
            "127.0.0.1",
            "127.1.2.3",
            "169.254.169.254",
            "172.16.0.1",
            "192.0.0.8",
            "192.0.2.1",
            "192.88.99.1",
            "192.168.1.1",
            "198.18.0.1",
            "198.51.100.1",
            "203.0.113.1",
            "224.0.0.1",
            "240.0.0.1",
            "255.255.255.255",
            "::",
            "::1",
            "::ffff:127.0.0.1",
            "::ffff:10.0.0.1",
            "::7f00:1",
            "64:ff9b::7f00:1",
            "64:ff9b:1::1",
            "100::1",
            "2001::1",
            "2001:db8::1",
            "2002:7f00:1::1",
            "3fff::1",
            "5f00::1",
            "fc00::1",
            "fe80::1",
            "fec0::1",
            "ff02::1",
        ] {
            assert!(!is_public(special.parse().unwrap()), "{special}");
        }
    }

    #[tokio::test]
    async fn hosts_are_checked_at_the_submission_and_when_a_message_is_sent() {
        let none = AllowedReceivers::default();
        let some = AllowedReceivers::new(&["Hooks.Local".into(), "[::1]".into(), "127.0.0.1".into(), "localhost".into()]);
        for (url, by_default) in [
            ("https://example.org/x", true),
            ("https://93.184.215.14", true),
            ("http://127.0.0.1:8080/", false),
            // Other forms of the same address.
            ("http://2130706433/", false),
            ("http://0x7f.1/", false),
            ("http://[::1]/", false),
            ("http://LOCALHOST./", false),
            ("http://localhost:3000", false),
        ] {
            let url: Url = url.parse().unwrap();
            let refused = none.check("webhooks[0].url", &url);
            assert_eq!(refused.is_ok(), by_default, "{url}");
            assert!(refused.is_ok() || refused.unwrap_err().field == "webhooks[0].url");
            assert!(some.check("url", &url).is_ok(), "{url}");
        }
        // Any name is accepted, but not any address.
        let found = async |receivers: &AllowedReceivers| receivers.resolve("localhost".parse().unwrap()).await.is_ok();
        assert!(!found(&none).await);
        assert!(found(&some).await);
    }
}
