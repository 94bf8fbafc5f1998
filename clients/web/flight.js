// Flies an episode over REST: a hosted environment for the world, and `Act` with a recurrent state that this page keeps.

import { ApiError, get, post, remove } from './api.js';

/** Longest wait that a busy server may ask for before the flight gives up, in seconds, and how often it may ask. */
const LONGEST_WAIT = 10;
const TRIES = 20;

/** Sends a request again as long as the server asks to retry later: a flight is many requests, and a key may have a rate. */
async function patient(path, body, signal) {
  for (let i = 1; ; i += 1) {
    try {
      return await post(path, body, { signal });
    } catch (error) {
      if (![429, 503].includes(error.status) || i === TRIES || (error.retryAfter ?? 1) > LONGEST_WAIT) throw error;
      await new Promise((resolve) => setTimeout(resolve, 1000 * (error.retryAfter ?? 1)));
      signal.throwIfAborted();
    }
  }
}

const slotOf = (scene) => ({ uavs: scene.uavs.map((u) => [u.x, u.y]), users: scene.users.map((u) => [u.x, u.y, u.aoi]) });

/**
 * Flies one episode of a policy. `onSlot(flight)` is called after every slot with `{environment, slots, metrics, policy}`: `slots[k]`
 * has the positions `[x, y]` of UAVs, those of users with their AoI, and, where it is not the last, headings and Q-values.
 */
export async function fly({ policy, environment, seed, onSlot, signal }) {
  const made = await patient('/v1/environments', { environment, seed, count: 1 }, signal);
  const path = `/v1/environments/${made.environment_id}`;
  const flight = { environment: made.environment, slots: [], metrics: null, policy: null };
  try {
    const reset = await patient(`${path}/reset`, { seed }, signal);
    let { scene } = reset.copies[0];
    let state;
    for (let step = 0; ; step += 1) {
      flight.slots.push(slotOf(scene));
      const act = await patient('/v1/act', { policy, scene, step, return_q_values: true, seed, ...(state ? { recurrent_state: state } : {}) }, signal);
      state = act.recurrent_state;
      flight.policy = act.policy;
      const headings = act.actions.map((action) => action.heading_index);
      Object.assign(flight.slots.at(-1), { headings, q: act.actions.map((action) => action.q_values) });
      const next = (await patient(`${path}/step`, { step, actions: [{ headings }] }, signal)).copies[0];
      scene = next.finished?.scene ?? next.scene;
      if (next.truncated) {
        flight.slots.push(slotOf(scene));
        flight.metrics = next.finished?.metrics ?? null;
        onSlot(flight);
        return flight;
      }
      onSlot(flight);
    }
  } catch (error) {
    if (error.status === 403) throw new ApiError({ code: error.code, status: 403, detail: `${error.message}. Flying needs a key with the scopes read and act.` });
    throw error;
  } finally {
    // Without this the server deletes it when it has not been used for some minutes.
    remove(path).catch(() => {});
  }
}

/** The environment that a policy was trained for; empty for baselines: the default. */
export async function trainedFor(policy) {
  const { config } = await get(`/v1/policies/${encodeURIComponent(policy)}`);
  return config?.environment ?? {};
}
