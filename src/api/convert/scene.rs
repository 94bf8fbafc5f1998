//! `Scene` to [`Observation`].

use super::fleet::{check_counts, distinct, request_order};
use super::{Ids, aoi, point};
use crate::invalid::Invalid;
use crate::serving::{Fleet, Observation, Scene, SceneOrGraph};
use crate::wire::v1;

impl TryFrom<v1::Scene> for Observation {
    type Error = Invalid;

    fn try_from(scene: v1::Scene) -> Result<Self, Invalid> {
        check_counts("scene", scene.uavs.len(), scene.users.len())?;
        let mut uavs = Vec::with_capacity(scene.uavs.len());
        let mut ids = Ids::with_capacity(scene.uavs.len());
        for (i, uav) in scene.uavs.into_iter().enumerate() {
            uavs.push(point(|| format!("scene.uavs[{i}]"), uav.x, uav.y)?);
            ids.push(|| format!("scene.uavs[{i}].id"), uav.id, i)?;
        }
        let (uav_ids, uav_places) = ids.sorted();
        let mut users = Vec::with_capacity(scene.users.len());
        let mut ids = Ids::with_capacity(scene.users.len());
        for (i, user) in scene.users.into_iter().enumerate() {
            let at = point(|| format!("scene.users[{i}]"), user.x, user.y)?;
            users.push((at, aoi(|| format!("scene.users[{i}].aoi"), user.aoi)?));
            ids.push(|| format!("scene.users[{i}].id"), user.id, i)?;
        }
        let (user_ids, user_places) = ids.sorted();
        distinct((&uav_ids, &uav_places), (&user_ids, &user_places), |is_uav, place| {
            format!("scene.{}[{place}].id", if is_uav { "uavs" } else { "users" })
        })?;
        Ok(Self {
            uav_order: request_order(&uav_places),
            content: SceneOrGraph::Scene(Scene {
                uavs: uav_places.iter().map(|&place| uavs[place as usize]).collect(),
                users: user_places.iter().map(|&place| users[place as usize].0).collect(),
                aoi: user_places.iter().map(|&place| users[place as usize].1).collect(),
            }),
            fleet: Fleet { uavs: uav_ids, users: user_ids },
        })
    }
}
