// Draws a slot of an episode: the square, users with their AoI, UAVs, ranges, links and what the policy prefers.

import { colour, faded, isDark } from './palette.js';

/** Share of the picture that is around the square. */
const MARGIN = 0.06;
/** Slots of the path behind a UAV that are drawn. */
const TRAIL = 24;

/** Colours from fresh to stale (cividis, readable for colour-blind people), for the light and the dark theme. */
const STALENESS = [[0, 73, 135], [85, 91, 109], [133, 126, 120], [190, 164, 101], [255, 222, 79]];
const STALENESS_DARK = [[58, 128, 205], [108, 128, 165], [150, 148, 140], [200, 176, 108], [255, 222, 79]];

/** The colour of an AoI; `stale` is the AoI at which the scale ends. */
export function aoiColour(aoi, stale) {
  const colours = isDark() ? STALENESS_DARK : STALENESS;
  const place = Math.min(Math.max(aoi / stale, 0), 1) * (colours.length - 1);
  const i = Math.min(Math.floor(place), colours.length - 2);
  const mix = colours[i].map((a, k) => Math.round(a + (place - i) * (colours[i + 1][k] - a)));
  return `rgb(${mix.join(', ')})`;
}

/** A context whose units are pixels of the page, sharp on every screen; null while the canvas is not visible. */
function prepare(canvas) {
  const { clientWidth: width, clientHeight: height } = canvas;
  if (!width || !height) return null;
  const scale = devicePixelRatio || 1;
  if (canvas.width !== Math.round(width * scale) || canvas.height !== Math.round(height * scale)) {
    canvas.width = Math.round(width * scale);
    canvas.height = Math.round(height * scale);
  }
  const context = canvas.getContext('2d');
  context.setTransform(scale, 0, 0, scale, 0, 0);
  context.clearRect(0, 0, width, height);
  return { context, width, height };
}

/** From units of the square's side to pixels, and back. The y axis points up. */
export function projection(canvas) {
  const size = Math.min(canvas.clientWidth, canvas.clientHeight);
  const side = size * (1 - 2 * MARGIN);
  const offset = size * MARGIN;
  return {
    side,
    to: ([x, y]) => [offset + x * side, offset + (1 - y) * side],
    from: (px, py) => [(px - offset) / side, 1 - (py - offset) / side],
  };
}

const near = (a, b, range) => Math.hypot(a[0] - b[0], a[1] - b[1]) <= range;
const between = (a, b, share) => [a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])];

/** Draws an episode at `time`, a number of slots that need not be whole. `show`: which of ranges, links, trails, q to draw. */
export function drawScene(canvas, flight, time, show, cursor = null) {
  const sheet = prepare(canvas);
  if (!sheet) return;
  const { context } = sheet;
  const map = projection(canvas);
  const ink = isDark() ? '#e6ebf0' : '#17202a';
  const faint = isDark() ? '#5b6875' : '#aab4be';
  const [left, top] = map.to([0, 1]);
  context.fillStyle = isDark() ? '#121920' : '#fbfcfd';
  context.fillRect(left, top, map.side, map.side);
  context.strokeStyle = faint;
  context.lineWidth = 1;
  context.strokeRect(left, top, map.side, map.side);
  const last = flight.slots.length - 1;
  const k = Math.min(Math.floor(time), last);
  const share = k < last ? time - k : 0;
  const slot = flight.slots[k];
  const next = flight.slots[Math.min(k + 1, last)];
  const uavs = slot.uavs.map((p, i) => between(p, next.uavs[i], share));
  const users = slot.users.map((u, i) => [...between(u, next.users[i], share), u[2]]);
  const world = flight.environment;
  const stale = Math.max(world.slots / 2, 10);
  if (show.ranges) drawRanges(context, map, world, uavs, users, faint);
  if (show.links) drawLinks(context, map, world, uavs, users);
  if (show.trails) drawTrails(context, map, flight, k, uavs);
  users.forEach((user, i) => drawUser(context, map, user, i, stale, ink, users.length));
  uavs.forEach((position, i) => {
    if (show.q && slot.q?.[i]?.length) drawPreferences(context, map, position, slot.q[i], slot.headings[i], colour(i));
    drawUav(context, map, position, slot.headings?.[i], i, ink, uavs.length);
  });
  if (cursor) drawCursor(context, map, cursor, ink);
}

function circle(context, [x, y], radius) {
  context.beginPath();
  context.arc(x, y, Math.max(radius, 0), 0, 2 * Math.PI);
}

function drawRanges(context, map, world, uavs, users, faint) {
  for (const user of users) {
    circle(context, map.to(user), world.transmission_range * map.side);
    context.fillStyle = faded(faint, 0.13);
    context.fill();
    context.strokeStyle = faded(faint, 0.7);
    context.stroke();
  }
  uavs.forEach((uav, i) => {
    circle(context, map.to(uav), world.detection_range * map.side);
    context.fillStyle = faded(colour(i), 0.05);
    context.fill();
    context.setLineDash([4, 5]);
    context.strokeStyle = faded(colour(i), 0.55);
    context.stroke();
    context.setLineDash([]);
  });
}

function drawLinks(context, map, world, uavs, users) {
  const talk = world.communication_range ?? world.detection_range;
  const line = (a, b, style, width, dash = []) => {
    context.beginPath();
    context.moveTo(...map.to(a));
    context.lineTo(...map.to(b));
    context.setLineDash(dash);
    context.strokeStyle = style;
    context.lineWidth = width;
    context.stroke();
    context.setLineDash([]);
    context.lineWidth = 1;
  };
  uavs.forEach((uav, i) => {
    for (const user of users) {
      if (near(uav, user, world.transmission_range)) line(uav, user, colour(i), 3);
      else if (near(uav, user, world.detection_range)) line(uav, user, faded(colour(i), 0.6), 1.2);
    }
    for (let j = i + 1; j < uavs.length; j += 1) {
      if (near(uav, uavs[j], talk)) line(uav, uavs[j], isDark() ? '#a3b0bd' : '#566270', 1.4, [2, 4]);
    }
  });
}

function drawTrails(context, map, flight, k, uavs) {
  uavs.forEach((now, i) => {
    for (let j = Math.max(0, k - TRAIL); j <= k; j += 1) {
      context.beginPath();
      context.moveTo(...map.to(flight.slots[j].uavs[i]));
      context.lineTo(...map.to(j === k ? now : flight.slots[j + 1].uavs[i]));
      context.strokeStyle = faded(colour(i), 0.12 + 0.6 * (1 - (k - j) / (TRAIL + 1)));
      context.lineWidth = 2.5;
      context.stroke();
      context.lineWidth = 1;
    }
  });
}

function drawUser(context, map, [x, y, aoi], i, stale, ink, count) {
  const at = map.to([x, y]);
  const radius = count > 30 ? 7 : 12;
  circle(context, at, radius);
  context.fillStyle = aoiColour(aoi, stale);
  context.fill();
  context.strokeStyle = ink;
  context.lineWidth = 1.2;
  context.stroke();
  context.lineWidth = 1;
  if (count > 30) return;
  context.fillStyle = aoi / stale > 0.45 ? '#10151b' : '#fff';
  context.font = '600 11px system-ui, sans-serif';
  context.textAlign = 'center';
  context.textBaseline = 'middle';
  context.fillText(String(Math.round(aoi)), at[0], at[1] + 0.5);
}

/** A UAV as an arrow in the direction of its heading; a diamond if it hovers or its heading is not known. */
function drawUav(context, map, position, heading, i, ink, count) {
  const [x, y] = map.to(position);
  const size = count > 20 ? 7 : 11;
  const moves = heading != null && heading < 8;
  context.save();
  context.translate(x, y);
  context.rotate(moves ? (-heading * Math.PI) / 4 : 0);
  context.beginPath();
  const points = moves ? [[1.25, 0], [-0.9, 0.85], [-0.45, 0], [-0.9, -0.85]] : [[1, 0], [0, 1], [-1, 0], [0, -1]];
  points.forEach(([px, py], n) => context[n ? 'lineTo' : 'moveTo'](px * size, py * size));
  context.closePath();
  context.fillStyle = colour(i);
  context.fill();
  context.lineWidth = 1.5;
  context.strokeStyle = isDark() ? '#10151b' : '#fff';
  context.stroke();
  context.restore();
  if (count > 12) return;
  context.fillStyle = ink;
  context.font = '600 11px system-ui, sans-serif';
  context.textAlign = 'left';
  context.textBaseline = 'alphabetic';
  context.fillText(String(i), x + size + 1, y - size + 1);
}

/** How much the policy prefers each heading: petals whose length grows with the Q-value, from the worst to the best heading. */
function drawPreferences(context, map, position, q, chosen, style) {
  const [x, y] = map.to(position);
  const [low, high] = [Math.min(...q), Math.max(...q)];
  q.slice(0, 8).forEach((value, heading) => {
    const length = 16 + 34 * (high > low ? (value - low) / (high - low) : 0);
    const angle = (-heading * Math.PI) / 4;
    context.beginPath();
    context.moveTo(x, y);
    context.arc(x, y, length, angle - 0.28, angle + 0.28);
    context.closePath();
    context.fillStyle = faded(style, heading === chosen ? 0.65 : 0.22);
    context.fill();
  });
}

function drawCursor(context, map, at, ink) {
  const [x, y] = map.to(at);
  context.strokeStyle = ink;
  context.lineWidth = 1.5;
  context.beginPath();
  context.moveTo(x - 9, y);
  context.lineTo(x + 9, y);
  context.moveTo(x, y - 9);
  context.lineTo(x, y + 9);
  context.stroke();
}

/** The AoI of every user (row) in every slot (column), with a line at `time`. */
export function drawStrips(canvas, flight, time) {
  const sheet = prepare(canvas);
  if (!sheet) return;
  const { context, width, height } = sheet;
  const columns = flight.environment.slots + 1;
  const rows = flight.slots[0].users.length;
  const stale = Math.max(flight.environment.slots / 2, 10);
  const [w, h] = [width / columns, height / rows];
  flight.slots.forEach((slot, k) => slot.users.forEach((user, i) => {
    context.fillStyle = aoiColour(user[2], stale);
    context.fillRect(k * w, i * h, w + 0.6, h - (rows > 30 ? 0 : 1));
  }));
  context.fillStyle = isDark() ? '#fff' : '#000';
  context.fillRect(Math.min((time + 0.5) * w, width - 2) - 1, 0, 2, height);
}
