//! Places of connections: how many there are in all, from one peer, and in the reserve.

use std::collections::HashMap;
use std::net::{IpAddr, Ipv6Addr};
use std::sync::{Arc, Mutex, PoisonError};

/// Connections beyond the others, one request each, only for probes: a supervisor must not take a server for dead because its
/// connections are in use.
pub(super) const RESERVE: usize = 64;
/// Connections of the reserve that one peer may have.
const RESERVE_PER_PEER: usize = 8;

/// The places of all listeners together.
#[derive(Debug)]
pub(super) struct Places {
    max: usize,
    max_per_peer: usize,
    taken: Mutex<Taken>,
}

#[derive(Debug, Default)]
struct Taken {
    all: usize,
    reserve: usize,
    /// Connections and connections of the reserve of each peer that has one.
    peers: HashMap<IpAddr, (usize, usize)>,
}

/// The place of one connection; dropping it gives the place back.
#[derive(Debug)]
pub(super) struct Place {
    places: Arc<Places>,
    peer: IpAddr,
    /// Whether the place is in the reserve.
    pub(super) reserved: bool,
    gauge: metrics::Gauge,
}

impl Places {
    pub(super) fn new(max: usize, max_per_peer: usize) -> Arc<Self> {
        Arc::new(Self { max, max_per_peer, taken: Mutex::default() })
    }

    /// A place for a connection from `address`, in the reserve if the others are taken; `None` if there is none.
    pub(super) fn take(self: &Arc<Self>, address: IpAddr) -> Option<Place> {
        let peer = peer(address);
        let mut taken = self.taken.lock().unwrap_or_else(PoisonError::into_inner);
        let (all, reserve) = (taken.all, taken.reserve);
        let (ordinary, in_reserve) = taken.peers.get(&peer).copied().unwrap_or_default();
        let reserved = all >= self.max || ordinary >= self.max_per_peer;
        if reserved && (reserve >= RESERVE || in_reserve >= RESERVE_PER_PEER) {
            return None;
        }
        taken.change(peer, reserved, |number| number + 1);
        drop(taken);
        let gauge = metrics::gauge!("qedgix_connections");
        gauge.increment(1.0);
        Some(Place { places: self.clone(), peer, reserved, gauge })
    }
}

impl Taken {
    fn change(&mut self, peer: IpAddr, reserved: bool, change: impl Fn(usize) -> usize) {
        let of_peer = self.peers.entry(peer).or_default();
        let (all, of_peer) = if reserved { (&mut self.reserve, &mut of_peer.1) } else { (&mut self.all, &mut of_peer.0) };
        (*all, *of_peer) = (change(*all), change(*of_peer));
        if self.peers.get(&peer) == Some(&(0, 0)) {
            self.peers.remove(&peer);
        }
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut taken = self.places.taken.lock().unwrap_or_else(PoisonError::into_inner);
        taken.change(self.peer, self.reserved, |number| number - 1);
        self.gauge.decrement(1.0);
    }
}

/// Who counts as one peer: an IPv4 address, or the 64 bits of an IPv6 address that name a network, because hosts choose the rest.
fn peer(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V6(address) => {
            let [a, b, c, d, ..] = address.segments();
            Ipv6Addr::new(a, b, c, d, 0, 0, 0, 0).into()
        }
        address @ IpAddr::V4(_) => address,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fill(places: &Arc<Places>, address: &str) -> Vec<Place> {
        std::iter::from_fn(|| places.take(address.parse().unwrap())).collect()
    }

    fn ordinary(places: &[Place]) -> usize {
        places.iter().filter(|place| !place.reserved).count()
    }

    #[test]
    fn one_peer_leaves_places_for_others() {
        let places = Places::new(100, 40);
        let greedy = fill(&places, "10.0.0.1");
        assert_eq!((greedy.len(), ordinary(&greedy)), (40 + RESERVE_PER_PEER, 40));
        let second = fill(&places, "10.0.0.2");
        assert_eq!(ordinary(&second), 40);
        drop(greedy);
        assert_eq!(ordinary(&fill(&places, "10.0.0.3")), 40);
        drop(second);
        let taken = places.taken.lock().unwrap();
        assert_eq!((taken.all, taken.reserve, taken.peers.len()), (0, 0, 0));
    }

    #[test]
    fn probes_get_in_when_all_places_are_taken() {
        let places = Places::new(2, 2);
        let greedy = fill(&places, "10.0.0.1");
        assert_eq!(ordinary(&greedy), 2);
        let probe = places.take("10.0.0.2".parse().unwrap()).unwrap();
        assert!(probe.reserved);
    }

    #[test]
    fn addresses_of_one_network_are_one_peer() {
        for (one, other, same) in [
            ("2001:db8::1", "2001:db8::ffff:1:2:3", true),
            ("2001:db8::1", "2001:db8:0:1::1", false),
            ("::ffff:10.0.0.1", "10.0.0.1", true),
            ("10.0.0.1", "10.0.0.2", false),
        ] {
            assert_eq!(peer(one.parse().unwrap()) == peer(other.parse().unwrap()), same, "{one} {other}");
        }
    }
}
