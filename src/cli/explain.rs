//! `qedgix evaluate --explain`: what speaks for and against each heading of an episode, as a figure and as JSON.

use std::path::Path;

use serde_json::{Value, json};

use super::figures::FigureArgs;
use super::files::write_atomic;
use super::policy_file::open;
use super::world_args::World;
use crate::env::{EnvConfig, Point};
use crate::learner::{ExplainedSlot, explained_flight};
use crate::plot::{self, Pull, Trajectories};

/// Slots between two that the figure explains.
const INTERVAL: usize = 4;
/// Influences of a UAV that the figure shows in a slot.
const STRONGEST: usize = 2;

/// Writes the figure and the numbers of each policy into `directory`.
///
/// # Errors
/// A policy that does not fit the environment, files that cannot be written.
pub fn write((directory, figures): (&Path, &FigureArgs), policies: &[String], world: &World, seed: u64) -> anyhow::Result<()> {
    std::fs::create_dir_all(directory)?;
    for (i, name) in policies.iter().enumerate() {
        let opened = open(name, &world.env)?;
        let env = opened.environment(name, world)?;
        let slots = explained_flight(&*opened.policy, &env, seed)?;
        let last = name.rsplit(['/', '\\']).next().unwrap_or(name);
        let last: String = last.chars().take(40).map(|c| if c.is_ascii_alphanumeric() { c } else { '-' }).collect();
        let file = directory.join(format!("explain-{}-{last}", i + 1));
        figures.write(&file.with_extension("svg"), &figure((name, seed), &slots, &env))?;
        write_atomic(&file.with_extension("json"), format!("{:#}\n", document(name, seed, &slots)).as_bytes())?;
    }
    Ok(())
}

/// Position of a node, UAVs first.
fn at(slot: &ExplainedSlot, node: u32) -> Point {
    let node = node as usize;
    node.checked_sub(slot.uavs.len()).map_or_else(|| slot.uavs[node], |user| slot.users[user])
}

fn figure((name, seed): (&str, u64), slots: &[ExplainedSlot], env: &EnvConfig) -> String {
    let uavs = slots.first().map_or(0, |slot| slot.uavs.len());
    let shown = Trajectories {
        uavs: (0..uavs).map(|i| slots.iter().map(|slot| slot.uavs[i]).collect()).collect(),
        users: slots.first().map_or_else(Vec::new, |slot| slot.users.clone()),
        transmission_range: env.transmission_range,
        note: format!("The layout with seed {seed}."),
    };
    let largest = slots.iter().flat_map(|slot| &slot.influences).map(|of| of.change.abs()).fold(f32::MIN_POSITIVE, f32::max);
    let mut pulls = Vec::new();
    for slot in slots.iter().step_by(INTERVAL) {
        for uav in 0..uavs as u32 {
            // They are sorted, the strongest first.
            for of in slot.influences.iter().filter(|of| of.uav == uav && !of.message).take(STRONGEST) {
                let strength = f64::from(of.change / largest);
                pulls.push(Pull { from: at(slot, uav), to: at(slot, of.node), strength });
            }
        }
    }
    plot::explained(&format!("{name}: why"), &shown, &pulls)
}

fn document(name: &str, seed: u64, slots: &[ExplainedSlot]) -> Value {
    let id = |slot: &ExplainedSlot, node: u32| {
        let node = node as usize;
        node.checked_sub(slot.uavs.len()).map_or_else(|| format!("uav-{node}"), |user| format!("user-{user}"))
    };
    let slot = |(step, slot): (usize, &ExplainedSlot)| {
        let influence = |of: &crate::policy::Influence| json!({"uav_id": id(slot, of.uav), "node_id": id(slot, of.node), "message": of.message, "change": of.change});
        json!({
            "step": step,
            "headings": slot.headings,
            "influences": slot.influences.iter().map(influence).collect::<Vec<_>>(),
        })
    };
    json!({"policy": name, "seed": seed, "slots": slots.iter().enumerate().map(slot).collect::<Vec<_>>()})
}
