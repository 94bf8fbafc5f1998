//! Training as a whole: it repeats itself bit for bit on any number of threads, and stopping it loses nothing.

#![allow(clippy::float_cmp, reason = "runs repeat themselves bit for bit")]

use std::sync::atomic::Ordering;

use qedgix::env::EpisodeMetrics;
use qedgix::learner::{Algorithm, Event, Preset, SnapshotError, TrainConfig, Trainer, evaluate, layouts};

/// A run of a few iterations that meets everything: updates, target copies, a full ring, evaluations.
fn small(algorithm: Algorithm) -> TrainConfig {
    let mut config = TrainConfig::preset(algorithm, Preset::Practical);
    config.environment.slots = 10;
    // 1/K of 7 significant bits repeats for ever in decimals.
    config.environment.reward_scale = Some(1.0 / 7.0);
    let t = &mut config.training;
    t.steps = 1200;
    t.epsilon_anneal = 800;
    t.envs = 4;
    t.batch = 16;
    t.updates_per_iteration = 2;
    t.buffer = 60;
    t.target_every = 12;
    t.eval_every = 250;
    t.eval_episodes = 6;
    config
}

fn run(trainer: &mut Trainer) -> Vec<Event> {
    trainer.collect()
}

#[test]
fn events_come_in_order_and_end() {
    let mut trainer = Trainer::new(small(Algorithm::Qmix), 1).unwrap();
    let events = run(&mut trainer);
    assert!(trainer.finished() && trainer.next().is_none());
    assert_eq!(events.last(), Some(&Event::Finished { step: 1200 }));
    let evaluations: Vec<u64> =
        events.iter().filter_map(|e| if let Event::Evaluation { step, .. } = e { Some(*step) } else { None }).collect();
    assert_eq!(evaluations, [0, 280, 520, 760, 1000, 1200], "after the iterations that reach 250, 500, ...");
    let iterations: Vec<_> = events.iter().filter_map(|e| if let Event::Iteration(i) = e { Some(*i) } else { None }).collect();
    assert_eq!(iterations.len(), 30);
    for (n, i) in iterations.iter().enumerate() {
        let done = n as u64 + 1;
        assert_eq!((i.step, i.episodes), (40 * done, 4 * done));
        // 16 episodes are held after the fourth iteration.
        let learning = done.saturating_sub(3);
        assert_eq!(i.updates, 2 * learning);
        assert_eq!(i.loss.is_some(), learning > 0);
        assert!(i.loss.is_none_or(|l| l.is_finite() && l >= 0.0) && i.mean_aoi > 0.0);
    }
    assert_eq!(iterations[0].epsilon, 1.0);
    assert_eq!(iterations[29].epsilon, 0.05);
}

#[test]
fn the_best_weights_are_kept_and_fly_as_they_were_evaluated() {
    let mut trainer = Trainer::new(small(Algorithm::Qmix), 1).unwrap();
    assert!(trainer.best().unwrap().is_none());
    let mut lowest = f64::INFINITY;
    for event in trainer.by_ref() {
        if let Event::Evaluation { metrics, .. } = event {
            lowest = lowest.min(metrics.mean_aoi);
        }
    }
    let best = trainer.best().unwrap().unwrap();
    assert_eq!(best.metrics().unwrap().mean_aoi, lowest);
    assert_eq!(trainer.best_evaluation().unwrap().step, best.step());
    let seeds = layouts("valid-v1").unwrap().seeds(6);
    let flown = evaluate(&best.policy(), &best.config().environment, &seeds, 1).unwrap();
    assert_eq!(EpisodeMetrics::mean(&flown), *best.metrics().unwrap());
    let last = trainer.checkpoint().unwrap();
    assert_eq!(last.step(), 1200);
    assert!(last.metrics().is_some(), "evaluated at the end");
}

#[test]
fn threads_change_no_bit() {
    for algorithm in [Algorithm::Qmix, Algorithm::Qedgix, Algorithm::Iql] {
        let mut one = Trainer::new(small(algorithm), 1).unwrap();
        let mut two = Trainer::new(small(algorithm), 2).unwrap();
        assert_eq!(run(&mut one), run(&mut two));
        assert_eq!(one.checkpoint().unwrap().to_bytes(), two.checkpoint().unwrap().to_bytes());
        assert!(one.snapshot() == two.snapshot());
    }
}

#[test]
fn seeds_change_everything() {
    let mut other = small(Algorithm::Vdn);
    other.seed = 2;
    let (mut a, mut b) = (Trainer::new(small(Algorithm::Vdn), 1).unwrap(), Trainer::new(other, 1).unwrap());
    // Ages of episodes too short to reach anybody may agree; losses may not.
    let told = |trainer: &mut Trainer| -> Vec<Event> {
        trainer.filter(|e| matches!(e, Event::Iteration(i) if i.loss.is_some())).collect()
    };
    assert!(told(&mut a).iter().zip(&told(&mut b)).all(|(a, b)| a != b));
}

#[test]
fn resuming_is_never_having_stopped() {
    for algorithm in [Algorithm::Qmix, Algorithm::Qedgix] {
        for moving in [false, true] {
            let mut config = small(algorithm);
            config.environment.user_speed = if moving { 0.02 } else { 0.0 };
            let mut whole = Trainer::new(config.clone(), 2).unwrap();
            let expected = run(&mut whole);
            // Interrupted again and again, after every kind of event, on changing numbers of threads.
            let mut told = Vec::new();
            let mut trainer = Trainer::new(config, 1).unwrap();
            for (n, events) in [1, 1, 3, 2, 1, 6, 8, 1, 12].into_iter().enumerate() {
                told.extend(trainer.by_ref().take(events));
                let saved = trainer.snapshot();
                trainer = Trainer::restore(&saved, 1 + n % 2).unwrap();
                assert!(trainer.snapshot() == saved);
            }
            told.extend(trainer.by_ref());
            assert_eq!(told, expected);
            assert!(trainer.snapshot() == whole.snapshot(), "weights, optimiser, replay and counters");
            assert_eq!(trainer.best().unwrap(), whole.best().unwrap());
        }
    }
}

#[test]
fn a_stopped_run_goes_on_when_asked() {
    let mut whole = Trainer::new(small(Algorithm::Vdn), 1).unwrap();
    let expected = run(&mut whole);
    let mut trainer = Trainer::new(small(Algorithm::Vdn), 1).unwrap();
    let stop = trainer.stop_flag();
    let mut told = Vec::new();
    for event in trainer.by_ref() {
        told.push(event);
        stop.store(told.len() == 7, Ordering::Relaxed);
    }
    assert_eq!(told.len(), 7);
    assert!(!trainer.finished());
    stop.store(false, Ordering::Relaxed);
    told.extend(trainer);
    assert_eq!(told, expected);
}

#[test]
fn a_damaged_snapshot_is_an_error() {
    let mut trainer = Trainer::new(small(Algorithm::Vdn), 1).unwrap();
    trainer.by_ref().take(6).for_each(drop);
    let saved = trainer.snapshot();
    let restore = |bytes: &[u8]| Trainer::restore(bytes, 1).err();
    assert_eq!(restore(b""), Some(SnapshotError::Foreign));
    assert_eq!(restore(b"safetensors, perhaps, but certainly nothing that training wrote"), Some(SnapshotError::Foreign));
    for len in [12, 44, 50, 1000, saved.len() / 2, saved.len() - 1] {
        assert!(restore(&saved[..len]).is_some(), "cut to {len}");
    }
    for at in [8, 20, 300, saved.len() / 2, saved.len() - 1] {
        let mut damaged = saved.clone();
        damaged[at] ^= 4;
        assert_eq!(restore(&damaged), Some(SnapshotError::Checksum), "at {at}");
    }
    // A checksum that fits does not make sense of nonsense.
    for at in (0..saved.len() - 32).step_by(saved.len() / 200) {
        let mut forged = saved[..saved.len() - 32].to_vec();
        forged[at] ^= 0x40;
        let checksum = <sha2::Sha256 as sha2::Digest>::digest(&forged);
        forged.extend(checksum);
        if let Ok(mut trainer) = Trainer::restore(&forged, 1) {
            trainer.next();
        }
    }
}

#[test]
fn invalid_configurations_do_not_start() {
    let mut config = small(Algorithm::Qmix);
    config.training.batch = 0;
    let error = Trainer::new(config, 1).err().unwrap();
    assert_eq!(error.field, "training.batch");
}
