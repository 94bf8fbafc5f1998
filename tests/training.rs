//! Training runs: they are equal bit for bit on any number of threads, and after interruptions.

#![allow(clippy::float_cmp, reason = "runs are equal bit for bit")]

mod sample;

use std::sync::atomic::Ordering;

use qedgix::env::{BatchEnv, EnvConfig, EpisodeMetrics, Layout};
use qedgix::learner::{
    Algorithm, Event, Learner, Preset, Rollout, SnapshotError, Symmetry, TrainConfig, Trainer, Vary, evaluate, layout_list,
};
use qedgix::policy::{Advice, Gnn, Memory, ObservationKind};

/// A run of a few iterations with updates, target copies, a full replay and evaluations.
fn small_config(algorithm: Algorithm) -> TrainConfig {
    let mut config = TrainConfig::preset(algorithm, Preset::Practical);
    config.environment.slots = 10;
    // 1/7 has no finite decimal or binary representation.
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

const ALGORITHMS: [Algorithm; 6] =
    [Algorithm::Qmix, Algorithm::Vdn, Algorithm::Iql, Algorithm::Qedgix, Algorithm::Agggnn, Algorithm::Rgcn];

/// As [`small_config`], with the opposite of each option.
fn opposite_config(algorithm: Algorithm) -> TrainConfig {
    let mut config = small_config(algorithm);
    let t = &mut config.training;
    t.augment = !t.augment;
    t.target_tau = if t.target_tau > 0.0 { 0.0 } else { 0.02 };
    t.average = if t.average > 0 { 0 } else { 20 };
    t.learning_rate_decay = if t.learning_rate_decay < 1.0 { 1.0 } else { 0.1 };
    t.normalise = !t.normalise;
    t.hyper_init = 0.5;
    t.observation = ObservationKind::Flat;
    config.environment.user_speed = 0.02;
    t.memory = if algorithm.gnn() == Gnn::None { Memory::Own } else { Memory::Shared };
    t.advice = if algorithm == Algorithm::Vdn { Advice::None } else { Advice::Sweep };
    t.advice_margin = if t.advice.is_none() { 0.0 } else { 0.05 };
    t.teacher = Some("sweep-shared".into());
    config.environment.communication_range = Some(0.5);
    config
}

/// As [`opposite_config`], in environments that are drawn anew for every iteration.
fn varied_config(algorithm: Algorithm) -> TrainConfig {
    let mut config = opposite_config(algorithm);
    config.training.observation = ObservationKind::Set;
    config.training.vary = Vary {
        uavs: Some([1, 4]),
        users: Some([2, 9]),
        slots: Some([6, 12]),
        detection_range: Some([0.2, 0.4]),
        communication_range: Some([0.1, 1.5]),
        ..Vary::default()
    };
    config
}

fn collect_events(trainer: &mut Trainer) -> Vec<Event> {
    trainer.collect()
}

#[test]
fn events_are_in_order_and_end() {
    let mut trainer = Trainer::new(small_config(Algorithm::Qmix), 1).unwrap();
    let events = collect_events(&mut trainer);
    assert!(trainer.finished() && trainer.next().is_none());
    assert_eq!(events.last(), Some(&Event::Finished { env_steps: 1200 }));
    let evaluations: Vec<u64> =
        events.iter().filter_map(|e| if let Event::Evaluation(e) = e { Some(e.env_steps) } else { None }).collect();
    assert_eq!(evaluations, [0, 280, 520, 760, 1000, 1200], "after the iterations that reach 250, 500, ...");
    let iterations: Vec<_> = events.iter().filter_map(|e| if let Event::Iteration(i) = e { Some(*i) } else { None }).collect();
    assert_eq!(iterations.len(), 30);
    for (n, i) in iterations.iter().enumerate() {
        let done = n as u64 + 1;
        assert_eq!((i.env_steps, i.episodes), (40 * done, 4 * done));
        // Replay holds 16 episodes after the fourth iteration.
        let learning = done.saturating_sub(3);
        assert_eq!(i.updates, 2 * learning);
        assert_eq!(i.loss.is_some(), learning > 0);
        assert!(i.loss.is_none_or(|l| l.is_finite() && l >= 0.0) && i.mean_aoi > 0.0);
    }
    assert_eq!(iterations[0].epsilon, 1.0);
    assert_eq!(iterations[29].epsilon, 0.05);
}

#[test]
fn the_best_weights_are_kept_and_reproduce_their_evaluation() {
    let mut trainer = Trainer::new(small_config(Algorithm::Qmix), 1).unwrap();
    assert!(trainer.best().unwrap().is_none());
    let mut lowest = f64::INFINITY;
    for event in trainer.by_ref() {
        if let Event::Evaluation(e) = event {
            lowest = lowest.min(e.metrics.mean_aoi);
        }
    }
    let best = trainer.best().unwrap().unwrap();
    assert_eq!(best.metrics().unwrap().mean_aoi, lowest);
    assert_eq!(trainer.best_evaluation().unwrap().env_steps, best.env_steps());
    let seeds = layout_list("valid-v1").unwrap().seeds(6);
    let metrics = evaluate(&best.policy(), &best.config().environment, &seeds, 1).unwrap();
    assert_eq!(EpisodeMetrics::mean(&metrics), *best.metrics().unwrap());
    let last = trainer.checkpoint().unwrap();
    assert_eq!(last.env_steps(), 1200);
    assert!(last.metrics().is_some(), "evaluated at the end");
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    for config in ALGORITHMS.iter().flat_map(|&a| [small_config(a), opposite_config(a), varied_config(a)]) {
        let mut one = Trainer::new(config.clone(), 1).unwrap();
        let mut two = Trainer::new(config, 2).unwrap();
        assert_eq!(collect_events(&mut one), collect_events(&mut two));
        assert_eq!(one.checkpoint().unwrap().to_bytes(), two.checkpoint().unwrap().to_bytes());
        assert!(one.snapshot() == two.snapshot());
    }
}

#[test]
fn another_seed_gives_other_losses() {
    let mut other = small_config(Algorithm::Vdn);
    other.seed = 2;
    let (mut a, mut b) = (Trainer::new(small_config(Algorithm::Vdn), 1).unwrap(), Trainer::new(other, 1).unwrap());
    // The AoI of short episodes, in which no user is visited, can be equal; losses cannot.
    let iterations = |trainer: &mut Trainer| -> Vec<Event> {
        trainer.filter(|e| matches!(e, Event::Iteration(i) if i.loss.is_some())).collect()
    };
    assert!(iterations(&mut a).iter().zip(&iterations(&mut b)).all(|(a, b)| a != b));
}

#[test]
fn a_resumed_run_equals_a_run_without_interruption() {
    for config in ALGORITHMS.iter().flat_map(|&a| [small_config(a), opposite_config(a), varied_config(a)]) {
        let mut whole = Trainer::new(config.clone(), 2).unwrap();
        let expected = collect_events(&mut whole);
        // Interrupted several times, after every kind of event, with different numbers of threads.
        let mut events = Vec::new();
        let mut trainer = Trainer::new(config, 1).unwrap();
        for (n, count) in [1, 1, 3, 2, 1, 6, 8, 1, 12].into_iter().enumerate() {
            events.extend(trainer.by_ref().take(count));
            let saved = trainer.snapshot();
            trainer = Trainer::restore(&saved, 1 + n % 2).unwrap();
            assert!(trainer.snapshot() == saved);
        }
        events.extend(trainer.by_ref());
        assert_eq!(events, expected);
        assert!(trainer.snapshot() == whole.snapshot(), "weights, optimiser, replay and counters");
        assert_eq!(trainer.best().unwrap(), whole.best().unwrap());
    }
}

#[test]
fn transformed_episodes_equal_the_episodes_of_transformed_fleets() {
    let config = EnvConfig { hover: true, ..EnvConfig::default() };
    let mut train = small_config(Algorithm::Vdn);
    train.environment = config.clone();
    train.training.envs = Symmetry::COUNT.into();
    let learner = Learner::new(&train, 1).unwrap();
    let mut rollout = Rollout::new(&train, &train.environment, learner.agent()).unwrap();
    let episodes = rollout.collect(learner.agent(), learner.agent_parameters(), 1.0, 0).clone();
    let mut transformed = episodes.clone();
    let symmetries: Vec<_> = (0..Symmetry::COUNT).map(Symmetry::from_index).collect();
    transformed.transform(&symmetries);
    let (m, n, k) = (episodes.uavs, episodes.users, episodes.slots);
    for e in 0..episodes.len {
        let users = transformed.user_xy[e * n * 2..][..n * 2].as_chunks().0;
        let given = users.iter().map(|p: &[f32; 2]| p.map(f64::from)).collect();
        let mut env = BatchEnv::new(&EnvConfig { layout: Layout::Given(given), ..config.clone() }, 1).unwrap();
        for slot in 0..=k {
            let at = e * (k + 1) + slot;
            let expected = &transformed.uav_xy[at * m * 2..][..m * 2];
            assert!(env.uav_xy().iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-5), "symmetry {e}, slot {slot}");
            assert_eq!(env.aoi(), &transformed.aoi[at * n..][..n], "symmetry {e}, slot {slot}");
            if slot < k {
                env.step(&transformed.actions[(e * k + slot) * m..][..m]);
            }
        }
    }
    assert_eq!(transformed.uav_xy[..81 * 6], episodes.uav_xy[..81 * 6], "the first symmetry is the identity");
    assert_ne!(transformed.actions, episodes.actions);
}

#[test]
fn averaged_weights_are_averages_from_the_first_update() {
    let mut config = small_config(Algorithm::Vdn);
    config.training.average = 4;
    let mut learner = Learner::new(&config, 1).unwrap();
    let batch = sample::episodes(&config.dims(), 4, 1);
    let mut online: Vec<Vec<f32>> = Vec::new();
    for update in 1..=6_usize {
        learner.update(std::slice::from_ref(&batch), 1e-3);
        online.push(learner.parameters().to_vec());
        // For the first four updates it is their mean; afterwards older updates have less weight.
        if update <= 4 {
            let mean = |i: usize| online.iter().map(|w| w[i]).sum::<f32>() / update as f32;
            let close = learner.published_parameters().iter().enumerate().all(|(i, a)| (a - mean(i)).abs() < 1e-6);
            assert!(close, "after {update} updates");
        }
    }
    assert_ne!(learner.published_parameters(), learner.parameters());
}

#[test]
fn a_stopped_run_continues_when_the_flag_is_cleared() {
    let mut whole = Trainer::new(small_config(Algorithm::Vdn), 1).unwrap();
    let expected = collect_events(&mut whole);
    let mut trainer = Trainer::new(small_config(Algorithm::Vdn), 1).unwrap();
    let stop = trainer.stop_flag();
    let mut events = Vec::new();
    for event in trainer.by_ref() {
        events.push(event);
        stop.store(events.len() == 7, Ordering::Relaxed);
    }
    assert_eq!(events.len(), 7);
    assert!(!trainer.finished());
    stop.store(false, Ordering::Relaxed);
    events.extend(trainer);
    assert_eq!(events, expected);
}

/// A run whose evaluations have several parts.
fn many_layouts() -> TrainConfig {
    let mut config = small_config(Algorithm::Vdn);
    config.training.steps = 300;
    config.training.eval_episodes = 150;
    config
}

#[test]
fn a_run_resumes_within_an_evaluation() {
    let mut whole = Trainer::new(many_layouts(), 2).unwrap();
    whole.add_reports();
    let expected = collect_events(&mut whole);
    let layouts: Vec<_> = expected
        .iter()
        .filter_map(|e| if let Event::Evaluating { env_steps, layouts } = e { Some((*env_steps, *layouts)) } else { None })
        .collect();
    let parts = |steps| [(steps, 64), (steps, 128)];
    assert_eq!(layouts, [parts(0), parts(0), parts(280), parts(320), parts(320)].concat(), "with a report at both ends");
    // Interrupted after every event.
    let mut trainer = Trainer::new(many_layouts(), 1).unwrap();
    trainer.add_reports();
    let mut events = Vec::new();
    while let Some(event) = trainer.next() {
        events.push(event);
        let saved = trainer.snapshot();
        trainer = Trainer::restore(&saved, 1 + events.len() % 2).unwrap();
        trainer.add_reports();
        assert!(trainer.snapshot() == saved);
    }
    assert_eq!(events, expected);
    assert!(trainer.snapshot() == whole.snapshot());
}

#[test]
fn reports_evaluate_the_initial_and_the_best_weights_and_change_nothing_else() {
    let mut plain = Trainer::new(many_layouts(), 1).unwrap();
    let initial = plain.checkpoint().unwrap();
    let without = collect_events(&mut plain);
    let mut trainer = Trainer::new(many_layouts(), 1).unwrap();
    trainer.add_reports();
    let with = collect_events(&mut trainer);
    assert_eq!(trainer.checkpoint().unwrap().to_bytes(), plain.checkpoint().unwrap().to_bytes());
    let best = trainer.best().unwrap().unwrap();
    assert_eq!(Some(&best), plain.best().unwrap().as_ref());
    let evaluated = |events: &[Event]| -> Vec<Event> {
        events.iter().filter(|e| !matches!(e, Event::Evaluating { .. } | Event::Report(_))).cloned().collect()
    };
    assert_eq!(evaluated(&with), evaluated(&without));
    let seeds = layout_list("eval-v1").unwrap().seeds(150);
    let reports: Vec<_> =
        with.iter().filter_map(|e| if let Event::Report(e) = e { Some((e.env_steps, e.metrics)) } else { None }).collect();
    let expected = [(0, &initial), (320, &best)].map(|(step, checkpoint)| {
        let metrics = evaluate(&checkpoint.policy(), &checkpoint.config().environment, &seeds, 1).unwrap();
        (step, EpisodeMetrics::mean(&metrics))
    });
    assert_eq!(reports, expected);
}

#[test]
fn a_stop_within_an_evaluation_repeats_only_its_part() {
    let expected = collect_events(&mut Trainer::new(many_layouts(), 1).unwrap());
    let mut trainer = Trainer::new(many_layouts(), 1).unwrap();
    let stop = trainer.stop_flag();
    assert_eq!(trainer.next(), Some(expected[0].clone()));
    // A thread that may set the flag before, within or after the next part: the events are the same in any case.
    let mut events = vec![expected[0].clone()];
    let setter = std::thread::spawn(move || stop.store(true, Ordering::Release));
    events.extend(trainer.by_ref());
    setter.join().unwrap();
    let saved = trainer.snapshot();
    events.extend(Trainer::restore(&saved, 1).unwrap());
    assert_eq!(events, expected);
}

#[test]
fn snapshots_of_format_version_2_are_read() {
    let mut trainer = Trainer::new(small_config(Algorithm::Vdn), 1).unwrap();
    trainer.by_ref().take(6).for_each(drop);
    let new = trainer.snapshot();
    // The same snapshot as version 2 wrote it: its first section has no fields of evaluations in progress and of reports.
    let len = u64::from_le_bytes(new[12..20].try_into().unwrap()) as usize;
    let head = std::str::from_utf8(&new[20..20 + len]).unwrap();
    let old_head = head.replace(r#""layouts":[],"reports":false,"#, "");
    assert!(old_head.len() < head.len(), "{head}");
    let mut old = [&new[..8], &2_u32.to_le_bytes(), &(old_head.len() as u64).to_le_bytes(), old_head.as_bytes()].concat();
    old.extend(&new[20 + len..new.len() - 32]);
    let checksum = <sha2::Sha256 as sha2::Digest>::digest(&old);
    old.extend(checksum);
    let restored = Trainer::restore(&old, 1).unwrap();
    assert!(restored.snapshot() == new);
    assert_eq!(restored.collect::<Vec<_>>(), trainer.collect::<Vec<_>>());
}

#[test]
fn a_damaged_snapshot_is_an_error() {
    let mut trainer = Trainer::new(small_config(Algorithm::Vdn), 1).unwrap();
    trainer.by_ref().take(6).for_each(drop);
    let saved = trainer.snapshot();
    let restore = |bytes: &[u8]| Trainer::restore(bytes, 1).err();
    assert_eq!(restore(b""), Some(SnapshotError::Foreign));
    assert_eq!(restore(b"bytes that are not a snapshot, long enough for a checksum"), Some(SnapshotError::Foreign));
    for len in [12, 44, 50, 1000, saved.len() / 2, saved.len() - 1] {
        assert!(restore(&saved[..len]).is_some(), "cut to {len}");
    }
    for at in [8, 20, 300, saved.len() / 2, saved.len() - 1] {
        let mut damaged = saved.clone();
        damaged[at] ^= 4;
        assert_eq!(restore(&damaged), Some(SnapshotError::Checksum), "at {at}");
    }
    // Changed bytes with a valid checksum do not cause a panic.
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
fn an_invalid_configuration_is_an_error() {
    let mut config = small_config(Algorithm::Qmix);
    config.training.batch = 0;
    let error = Trainer::new(config, 1).err().unwrap();
    assert_eq!(error.field, "training.batch");
}
