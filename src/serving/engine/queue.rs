//! The order in which the engine computes what waits: fair by work, not by arrival.
//!
//! Every task has an estimated cost. Tasks of one owner and of about one cost form a flow. A task starts, in virtual time, when the
//! tasks of its flow before it have received their share; the task with the earliest start is next (start-time fair queueing). So
//! flows advance at the same speed in units of work: many large fleets delay small ones, of the same or of other callers, by no
//! more than the task that is being computed, and within a flow the order is that of arrival.
//!
//! Light tasks wait apart from heavy ones, which have threads of their own.

use std::collections::{HashMap, HashSet, VecDeque};
use std::time::Duration;

use super::batch::Queued;
use crate::serving::{Error, Owner};

/// Cost from which a task is heavy: about 6 ms.
const HEAVY: usize = 1 << 16;
/// Number of flows up to which those without tasks are kept.
const MAX_IDLE_FLOWS: usize = 256;
/// Estimated time of a unit of work until tasks have been measured.
const NANOSECONDS_PER_UNIT: f64 = 100.0;
/// Weight of a new measurement of that time.
const MEASUREMENT_WEIGHT: f64 = 0.1;
/// Bounds of that time, so that a few odd measurements cannot make the engine refuse everything.
const UNIT_BOUNDS: (f64, f64) = (10.0, 1000.0);

/// Tasks of one owner and of about one cost: up to four times the lowest.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
struct Flow {
    owner: Owner,
    magnitude: u32,
}

impl Flow {
    fn of(task: &Queued) -> Self {
        Self { owner: task.owner.clone(), magnitude: task.work.max(1).ilog2() / 2 }
    }
}

/// The tasks that wait.
pub(super) struct Queue {
    capacity: usize,
    /// In order of start; of equal starts, in order of arrival.
    light: VecDeque<Queued>,
    heavy: VecDeque<Queued>,
    /// When each flow has used up its share, in virtual time.
    flows: HashMap<Flow, u64>,
    /// The latest start of a task that left the queue to be computed.
    virtual_time: u64,
    nanoseconds_per_unit: f64,
}

/// Tasks that are taken from one place.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Lane {
    Light,
    Heavy,
}

impl Lane {
    /// The lane of tasks that cost `work`.
    pub(super) fn of(work: usize) -> Self {
        if work < HEAVY { Self::Light } else { Self::Heavy }
    }
}

impl Queue {
    pub(super) fn new(capacity: usize) -> Self {
        Self {
            capacity,
            light: VecDeque::new(),
            heavy: VecDeque::new(),
            flows: HashMap::new(),
            virtual_time: 0,
            nanoseconds_per_unit: NANOSECONDS_PER_UNIT,
        }
    }

    /// Number of tasks.
    pub(super) fn len(&self) -> usize {
        self.light.len() + self.heavy.len()
    }

    pub(super) fn lane(&self, lane: Lane) -> &VecDeque<Queued> {
        match lane {
            Lane::Light => &self.light,
            Lane::Heavy => &self.heavy,
        }
    }

    fn lane_mut(&mut self, lane: Lane) -> &mut VecDeque<Queued> {
        match lane {
            Lane::Light => &mut self.light,
            Lane::Heavy => &mut self.heavy,
        }
    }

    /// Adds a task, to be computed by one of `threads` threads. Returns the tasks that left to make room for it.
    ///
    /// # Errors
    /// [`Error::Busy`] if the queue is full and no owner has more tasks in it than this one, or if the deadline of the task would pass
    /// before its turn.
    pub(super) fn push(&mut self, mut task: Queued, threads: usize) -> Result<Vec<Queued>, Error> {
        let work = task.work;
        let flow = Flow::of(&task);
        let start = self.flows.get(&flow).copied().unwrap_or(0).max(self.virtual_time);
        if let Some(deadline) = task.deadline {
            let wait = self.wait_until(start, Lane::of(work), threads);
            if task.since + wait > deadline {
                let seconds = wait.as_secs_f64();
                let message =
                    format!("the queue of the engine takes about {seconds:.1} s, and the deadline of the request is earlier");
                return Err(Error::Busy(message));
            }
        }
        let mut removed = Vec::new();
        if self.len() >= self.capacity {
            let full = Error::Busy(format!("the engine's queue is full ({} fleets)", self.capacity));
            removed = self.make_room(&task.owner).ok_or(full)?;
        }
        if self.flows.len() >= MAX_IDLE_FLOWS.max(2 * self.len()) {
            self.forget_idle_flows();
        }
        self.flows.insert(flow, start + work.max(1) as u64);
        task.start = start;
        let lane = self.lane_mut(Lane::of(work));
        let place = lane.partition_point(|other| other.start <= start);
        lane.insert(place, task);
        Ok(removed)
    }

    /// Forgets the flows without tasks.
    fn forget_idle_flows(&mut self) {
        let active: HashSet<Flow> = self.light.iter().chain(&self.heavy).map(Flow::of).collect();
        self.flows.retain(|flow, _| active.contains(flow));
    }

    /// Removes tasks whose callers stopped waiting, or else the last task of the owner with most tasks, if that is more than those of
    /// `owner`: nobody can keep others out of the queue. Returns what was removed.
    fn make_room(&mut self, owner: &Owner) -> Option<Vec<Queued>> {
        let mut removed = Vec::new();
        for lane in [&mut self.light, &mut self.heavy] {
            let mut i = 0;
            while i < lane.len() {
                if lane[i].job.is_abandoned() {
                    removed.extend(lane.remove(i));
                } else {
                    i += 1;
                }
            }
        }
        if !removed.is_empty() {
            return Some(removed);
        }
        let mut counts: HashMap<&Owner, usize> = HashMap::new();
        for task in self.light.iter().chain(&self.heavy) {
            *counts.entry(&task.owner).or_default() += 1;
        }
        let own = counts.get(owner).copied().unwrap_or(0);
        let (most, count) = counts.into_iter().max_by(|a, b| a.1.cmp(&b.1).then_with(|| a.0.cmp(b.0)))?;
        if count <= own + 1 {
            return None;
        }
        let most = most.clone();
        let last = |lane: &VecDeque<Queued>| lane.iter().rposition(|task| task.owner == most);
        let lane = if last(&self.heavy).is_some() { &mut self.heavy } else { &mut self.light };
        let place = last(lane)?;
        lane.remove(place).map(|task| vec![task])
    }

    /// Estimated time until a task with this start begins, from the tasks that begin before it.
    fn wait_until(&self, start: u64, lane: Lane, threads: usize) -> Duration {
        let before = |tasks: &VecDeque<Queued>| -> usize {
            tasks.iter().take_while(|task| task.start <= start).map(|task| task.work).sum()
        };
        // Light tasks do not wait for heavy ones.
        let units = before(&self.light) + if lane == Lane::Heavy { before(&self.heavy) } else { 0 };
        Duration::from_nanos((units as f64 * self.nanoseconds_per_unit) as u64) / threads.max(1) as u32
    }

    /// Takes a measured time of `work` units into account.
    pub(super) fn measure(&mut self, work: usize, time: Duration) {
        if work > 0 {
            let measured = (time.as_nanos() as f64 / work as f64).clamp(UNIT_BOUNDS.0, UNIT_BOUNDS.1);
            self.nanoseconds_per_unit += MEASUREMENT_WEIGHT * (measured - self.nanoseconds_per_unit);
        }
    }

    /// Moves the next task of `lane`, and following tasks of its policy version, to `tasks`: at most `max_tasks`, which cost at most
    /// `max_work` if they are several.
    pub(super) fn take(&mut self, lane: Lane, max_tasks: usize, max_work: usize, tasks: &mut Vec<Queued>) {
        let Some(next) = self.lane_mut(lane).pop_front() else { return };
        self.virtual_time = self.virtual_time.max(next.start);
        let mut work = next.work;
        tasks.push(next);
        let waiting = self.lane_mut(lane);
        let mut i = 0;
        while i < waiting.len() && tasks.len() < max_tasks {
            let next = &waiting[i];
            if next.job.shares_batch_with(&tasks[0].job) && work + next.work <= max_work {
                work += next.work;
                tasks.extend(waiting.remove(i));
            } else {
                i += 1;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::time::Instant;

    use jiff::Timestamp;
    use tokio::sync::oneshot;

    use super::super::batch::Job;
    use super::*;
    use crate::policy::baselines::by_name;
    use crate::policy::{EnvParams, FleetGraph};
    use crate::serving::{FleetMemory, LoadedPolicy, OutputBuffers, PolicyRef, Task};

    struct Waiting {
        queue: Queue,
        policy: Arc<LoadedPolicy>,
        /// Callers that wait.
        callers: Vec<oneshot::Receiver<Result<super::super::TaskOutput, Error>>>,
        now: Instant,
    }

    /// Work per UAV.
    const UNIT: usize = 32;

    impl Waiting {
        fn new(capacity: usize) -> Self {
            let policy = by_name("persistent", EnvParams::default()).unwrap();
            let reference = PolicyRef { name: "p".into(), version: 1, digest: [0; 32] };
            let policy = Arc::new(LoadedPolicy::baseline(reference, "", policy, Timestamp::UNIX_EPOCH));
            Self { queue: Queue::new(capacity), policy, callers: Vec::new(), now: Instant::now() }
        }

        /// Adds a task of `uavs` UAVs, identified by `step`.
        fn push(&mut self, owner: &str, uavs: usize, step: u64, deadline: Option<Duration>) -> Result<usize, Error> {
            // Far from each other, so that a large fleet has no detections.
            let places: Vec<_> = (0..uavs).map(|i| [i as f64, 0.0]).collect();
            let graph = FleetGraph::from_scene(&places, &[[0.0, 9.0]], &[0.0], 0.5);
            let task = Task::new(self.policy.clone(), graph.into(), step, FleetMemory::default(), OutputBuffers::default());
            let (reply, caller) = oneshot::channel();
            self.callers.push(caller);
            let deadline = deadline.map(|after| self.now + after);
            let mut queued = Queued::new(Job::Fleet { task, reply }, uavs * UNIT, &Owner::new(owner), deadline);
            queued.since = self.now;
            self.queue.push(queued, 2).map(|removed| removed.len())
        }

        /// The lane of the task with the earliest start.
        fn first(&self) -> Option<Lane> {
            let lanes = [Lane::Light, Lane::Heavy].into_iter();
            lanes
                .filter_map(|lane| Some((self.queue.lane(lane).front()?.start, lane)))
                .min_by_key(|first| first.0)
                .map(|first| first.1)
        }

        /// The step and the number of UAVs of each task, in the order in which one thread computes them.
        fn order(&mut self) -> Vec<(u64, usize)> {
            let mut order = Vec::new();
            while let Some(lane) = self.first() {
                let mut tasks = Vec::new();
                self.queue.take(lane, 1, usize::MAX, &mut tasks);
                order.extend(tasks.iter_mut().map(|queued| {
                    let Job::Fleet { task, .. } = &mut queued.job else { panic!("only fleets are queued") };
                    let step = task.as_fleet_step();
                    (step.step, step.headings.len())
                }));
            }
            order
        }
    }

    #[test]
    fn small_fleets_do_not_wait_behind_large_ones_of_the_same_caller() {
        let mut waiting = Waiting::new(100);
        for i in 0..16 {
            waiting.push("a", 4096, i, None).unwrap();
        }
        for i in 16..20 {
            waiting.push("a", 3, i, None).unwrap();
        }
        let order = waiting.order();
        // The first large one starts at the same virtual time as the small ones.
        let small: Vec<usize> = (0..order.len()).filter(|&place| order[place].1 == 3).collect();
        assert!(small.iter().all(|&place| place < 5), "{order:?}");
        assert!(order.is_sorted_by_key(|&(step, uavs)| (uavs == 3, step)) || small[3] < 5);
    }

    #[test]
    fn callers_get_equal_shares_of_work() {
        let mut waiting = Waiting::new(100);
        for i in 0..30 {
            waiting.push("greedy", 100, i, None).unwrap();
        }
        for i in 30..35 {
            waiting.push("modest", 100, i, None).unwrap();
        }
        let order = waiting.order();
        let last = order.iter().rposition(|&(step, _)| step >= 30).unwrap();
        assert!(last <= 10, "five of the other's turns pass before five of the caller's: {order:?}");
    }

    #[test]
    fn idle_callers_do_not_save_up_shares() {
        let mut waiting = Waiting::new(100);
        for i in 0..50 {
            waiting.push("a", 100, i, None).unwrap();
        }
        let mut tasks = Vec::new();
        for _ in 0..40 {
            waiting.queue.take(Lane::Light, 1, usize::MAX, &mut tasks);
        }
        for i in 50..60 {
            waiting.push("b", 100, i, None).unwrap();
        }
        let order = waiting.order();
        let first_ten = order[..10].iter().filter(|&&(step, _)| step >= 50).count();
        assert!((4..=6).contains(&first_ten), "{order:?}");
    }

    #[test]
    fn tasks_that_cannot_begin_before_their_deadline_are_refused() {
        let mut waiting = Waiting::new(100);
        let heavy = 8 * HEAVY / UNIT;
        let second = Some(Duration::from_secs(1));
        waiting.push("a", heavy, 0, Some(Duration::from_millis(1))).unwrap();
        for i in 1..60 {
            waiting.push("a", heavy, i, None).unwrap();
        }
        assert!(matches!(waiting.push("a", heavy, 60, second), Err(Error::Busy(_))));
        assert_eq!(waiting.push("a", heavy, 60, Some(Duration::from_secs(60))).unwrap(), 0);
        // Light tasks and other callers do not wait for them.
        assert!(waiting.push("a", 3, 61, second).is_ok());
        assert!(waiting.push("b", heavy, 62, second).is_ok());
        waiting.queue.measure(1000, Duration::from_secs(10));
        assert!(waiting.queue.nanoseconds_per_unit <= NANOSECONDS_PER_UNIT + MEASUREMENT_WEIGHT * UNIT_BOUNDS.1);
    }

    #[test]
    fn full_queue_takes_from_the_caller_with_most_tasks() {
        let mut waiting = Waiting::new(10);
        for i in 0..10 {
            waiting.push("greedy", 3, i, None).unwrap();
        }
        assert!(matches!(waiting.push("greedy", 3, 10, None), Err(Error::Busy(_))));
        for i in 11..16 {
            assert_eq!(waiting.push("modest", 3, i, None).unwrap(), 1);
        }
        assert!(matches!(waiting.push("modest", 3, 16, None), Err(Error::Busy(_))), "five each");
        assert_eq!(waiting.queue.len(), 10);
        // Callers that stopped waiting make room first.
        waiting.callers.drain(..3);
        assert_eq!(waiting.push("greedy", 3, 17, None).unwrap(), 3);
    }

    #[test]
    fn flows_without_tasks_are_forgotten() {
        let mut waiting = Waiting::new(10);
        for i in 0..10_000 {
            waiting.push(&format!("caller-{i}"), 3, i, None).unwrap();
            waiting.order();
        }
        assert!(waiting.queue.flows.len() <= MAX_IDLE_FLOWS + 1, "{}", waiting.queue.flows.len());
    }
}
