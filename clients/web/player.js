// The episode player: one or two policies fly the same layout, slot by slot.

import { html, useEffect, useMemo, useRef, useState } from './htm-preact-3.1.1.js';
import { all } from './api.js';
import { Chart } from './chart.js';
import { fly, trainedFor } from './flight.js';
import { number } from './format.js';
import { algorithmColour } from './palette.js';
import { setOptions } from './route.js';
import { drawScene, drawStrips, projection } from './scene.js';
import { Card, Choice, copy, Empty, ErrorBox, Field, Loaded, Title, useLoad } from './ui.js';

/** Bounds of what this page flies: every slot is two requests. */
const BOUNDS = { uavs: 64, users: 200, slots: 500 };
const SPEEDS = [2, 5, 10, 20, 40];
const SHOWN = [['ranges', 'Ranges'], ['links', 'Links'], ['trails', 'Trails'], ['q', 'Q-values']];
/** First layout of `eval-v1`, on which no policy is trained. */
const FIRST_SEED = 10_000;

const still = () => matchMedia('(prefers-reduced-motion: reduce)').matches;

export function PlayerPage({ options }) {
  const list = useLoad((signal) => all('/v1/policies?page_size=500', 'policies', 2000, signal), [], 0);
  return html`<${Title} text="Player" actions=${html`<button type="button" onClick=${() => copy(location.href)}>Copy the address</button>`} />
    <${Loaded} of=${list} what="the policies">${(policies) => html`<${Player} policies=${policies} options=${options} />`}<//>`;
}

/** Users drawn by hand, as `0.1,0.2;0.5,0.5` in the address. */
function parseUsers(text) {
  if (!text) return null;
  const users = text.split(';').map((pair) => pair.split(',').map(Number)).filter((p) => p.length === 2 && p.every((v) => v >= 0 && v <= 1));
  return users.length ? users.slice(0, BOUNDS.users) : null;
}

const formatUsers = (users) => users.map((p) => p.map((v) => Number(v.toFixed(3))).join(',')).join(';');
const whole = (text, most) => (/^\d{1,15}$/.test(text ?? '') && Number(text) >= 1 ? Math.min(Number(text), most) : null);

/** What to fly, from the address. */
function setup(options, policies) {
  const names = policies.map((p) => p.ref.name);
  const first = options.get('policy') ?? (names.includes('qedgix') ? 'qedgix' : names[0]);
  const users = parseUsers(options.get('draw'));
  return {
    policy: first, against: options.get('against') ?? '', seed: Number(options.get('seed') ?? FIRST_SEED) || 0, users,
    changes: Object.fromEntries(['uavs', 'users', 'slots'].map((name) => [name, whole(options.get(name), BOUNDS[name])]).filter(([, value]) => value != null)),
  };
}

/** Flies a policy when the setup changes; the flight grows slot by slot. */
function useFlight(policy, environment, seed) {
  const [state, set] = useState({ flight: null, error: null });
  const key = JSON.stringify([policy, environment, seed]);
  useEffect(() => {
    set({ flight: null, error: null });
    if (!policy || !environment) return undefined;
    const abort = new AbortController();
    let last = 0;
    const onSlot = (flight) => {
      const now = performance.now();
      if (abort.signal.aborted || (now - last < 60 && !flight.metrics)) return;
      last = now;
      set({ flight: { ...flight, slots: flight.slots.slice() }, error: null });
    };
    fly({ policy, environment, seed, onSlot, signal: abort.signal }).catch((error) => abort.signal.aborted || set((old) => ({ ...old, error })));
    return () => abort.abort();
  }, [key]);
  return state;
}

/** A clock of slots: plays up to `end`, where the flight is known. */
function useClock(end, length, start) {
  const time = useRef(start ?? 0);
  const [slot, setSlot] = useState(start ?? 0);
  const [playing, setPlaying] = useState(start == null && !still());
  const [speed, setSpeed] = useState(10);
  const now = useRef({});
  now.current = { end, length, playing, speed };
  useEffect(() => {
    if (!playing) return undefined;
    let frame;
    let before = null;
    const tick = (at) => {
      const { end: known, length: all, speed: rate } = now.current;
      if (before != null) time.current = Math.min(time.current + (rate * (at - before)) / 1000, known);
      before = at;
      setSlot(Math.floor(time.current));
      if (all > 0 && time.current >= all) setPlaying(false);
      else frame = requestAnimationFrame(tick);
    };
    frame = requestAnimationFrame(tick);
    return () => cancelAnimationFrame(frame);
  }, [playing]);
  const seek = (to) => {
    time.current = Math.min(Math.max(to, 0), now.current.end);
    setPlaying(false);
    setSlot(Math.floor(time.current));
    setOptions({ slot: Math.floor(time.current) || '' });
  };
  const toggle = () => {
    if (!playing && time.current >= length) time.current = 0;
    setPlaying(!playing);
    setOptions({ slot: playing ? Math.floor(time.current) || '' : '' });
  };
  const restart = () => {
    time.current = 0;
    setSlot(0);
    setPlaying(!still());
  };
  return { time, slot, playing, speed, setSpeed, seek, toggle, restart };
}

function Player({ policies, options }) {
  const plan = setup(options, policies);
  const [drawing, setDrawing] = useState(false);
  const trained = useLoad(() => trainedFor(plan.policy).catch(() => ({})), [plan.policy], 0);
  const base = trained.loading ? null : trained.value ?? {};
  const environment = useMemo(() => {
    if (!base) return null;
    const of = { ...base, start: 'center', layout: 'random', weights: null, ...plan.changes };
    if (plan.users) Object.assign(of, { users: plan.users.length, layout: { given: plan.users } });
    return of;
  }, [base, JSON.stringify([plan.changes, plan.users])]);
  const first = useFlight(drawing ? null : plan.policy, environment, plan.seed);
  const second = useFlight(drawing || !plan.against ? null : plan.against, environment, plan.seed);
  const flights = [first, ...(plan.against ? [second] : [])];
  const known = flights.map((f) => (f.flight ? f.flight.slots.length - 1 : 0));
  const length = environment?.slots ?? first.flight?.environment.slots ?? 80;
  const start = options.has('slot') ? Number(options.get('slot')) || 0 : null;
  const clock = useClock(Math.min(...known), length, start);
  const shown = new Set((options.get('show') ?? 'ranges,links,trails').split(','));
  const show = Object.fromEntries(SHOWN.map(([id]) => [id, shown.has(id)]));
  const toggle = (id) => {
    if (!shown.delete(id)) shown.add(id);
    setOptions({ show: [...shown].join(',') || 'none' });
  };
  const change = (values) => {
    setOptions({ ...values, slot: '' });
    clock.restart();
  };
  const keys = (e) => {
    if (['INPUT', 'SELECT', 'BUTTON', 'TEXTAREA'].includes(e.target.tagName) || drawing) return;
    const act = { ' ': clock.toggle, ArrowLeft: () => clock.seek(clock.slot - 1), ArrowRight: () => clock.seek(clock.slot + 1), Home: () => clock.seek(0), End: () => clock.seek(length) }[e.key];
    if (act) {
      e.preventDefault();
      act();
    }
  };
  return html`<div onKeyDown=${keys}>
    <${Settings} plan=${plan} policies=${policies} base=${base} change=${change} drawing=${drawing} setDrawing=${setDrawing} current=${first.flight} />
    ${drawing ? html`<${Draw} start=${plan.users ?? first.flight?.slots[0].users.map((u) => u.slice(0, 2)) ?? []} environment=${environment} done=${(users) => { setDrawing(false); if (users) change({ draw: formatUsers(users), users: '' }); }} />`
    : html`<div class="flights ${plan.against ? 'two' : ''}">
        ${flights.map((f, i) => html`<${Flight} key=${i} name=${i ? plan.against : plan.policy} state=${f} clock=${clock} show=${show} />`)}
        <${Controls} clock=${clock} length=${length} known=${Math.min(...known)} show=${show} toggle=${toggle} />
        <${Comparison} names=${[plan.policy, plan.against]} flights=${flights.map((f) => f.flight)} slot=${clock.slot} />
      </div>`}
  </div>`;
}

function Settings({ plan, policies, base, change, drawing, setDrawing, current }) {
  const names = policies.map((p) => p.ref.name);
  const withOwn = (name) => (name && !names.includes(name) ? [name, ...names] : names);
  const field = (name, label) => html`<${Field} label=${label}><input type="number" min="1" max=${BOUNDS[name]} value=${plan.changes[name] ?? ''} placeholder=${String((name === 'users' && plan.users?.length) || base?.[name] || current?.environment[name] || '')} disabled=${name === 'users' && plan.users} onChange=${(e) => change({ [name]: e.target.value })} /><//>`;
  return html`<${Card}><div class="controls player-settings">
      <${Field} label="Policy"><${Choice} value=${plan.policy} options=${withOwn(plan.policy)} onChange=${(v) => change({ policy: v })} /><//>
      <${Field} label="Beside it"><${Choice} value=${plan.against} options=${[['', 'nothing'], ...withOwn(plan.against)]} onChange=${(v) => change({ against: v })} /><//>
      ${field('uavs', 'UAVs')} ${field('users', 'Users')} ${field('slots', 'Slots')}
      <${Field} label="Layout (seed)"><input type="number" min="0" value=${plan.seed} disabled=${!!plan.users} onChange=${(e) => change({ seed: e.target.value })} /><//>
      <button type="button" disabled=${!!plan.users} onClick=${() => change({ seed: plan.seed + 1 })}>Next layout</button>
      ${!drawing && html`<button type="button" onClick=${() => setDrawing(true)}>${plan.users ? 'Edit the layout' : 'Draw a layout'}</button>`}
      ${plan.users && !drawing && html`<button type="button" onClick=${() => change({ draw: '' })}>Back to seeds</button>`}
    </div><//>`;
}

function Flight({ name, state, clock, show }) {
  const canvas = useRef(null);
  const strips = useRef(null);
  const { flight, error } = state;
  const draw = useRef(() => {});
  draw.current = () => {
    if (!flight || !canvas.current) return;
    const time = still() ? Math.floor(clock.time.current) : clock.time.current;
    drawScene(canvas.current, flight, time, show);
    if (strips.current) drawStrips(strips.current, flight, time);
  };
  // Drawn after every change, and while it plays with every picture of the screen.
  useEffect(() => draw.current());
  useEffect(() => {
    let frame;
    const tick = () => {
      draw.current();
      frame = requestAnimationFrame(tick);
    };
    if (clock.playing) frame = requestAnimationFrame(tick);
    const observer = new ResizeObserver(() => draw.current());
    if (canvas.current) observer.observe(canvas.current);
    return () => {
      cancelAnimationFrame(frame);
      observer.disconnect();
    };
  }, [clock.playing, !!flight]);
  const slot = flight?.slots[Math.min(clock.slot, flight.slots.length - 1)];
  const now = slot ? average(slot) : null;
  const text = flight && slot ? `Slot ${clock.slot}. Mean AoI ${number(now, 3)}. ${slot.users.map((u, i) => `User ${i}: AoI ${Math.round(u[2])}`).slice(0, 12).join(', ')}` : 'No flight yet';
  return html`<section class="card flight" aria-label=${`Flight of ${name}`}>
    <div class="card-title"><h2><span class="swatch" style=${{ background: algorithmColour(name.split(/[:@]/)[0]) }}></span> ${name}${flight?.policy && !/[:@]/.test(name) ? html`<span class="faint small"> version ${flight.policy.version}</span>` : ''}</h2>
      <span class="aoi-now" title="Mean AoI of all users in this slot">AoI <strong>${now == null ? '–' : now.toFixed(1)}</strong></span></div>
    <${ErrorBox} error=${error} />
    ${flight ? html`<canvas class="scene" ref=${canvas} role="img" aria-label=${text}></canvas>
      <canvas class="strips" ref=${strips} role="img" aria-label="AoI of every user over the episode" style=${{ height: `${Math.min(Math.max(flight.slots[0].users.length * 12, 36), 160)}px` }}></canvas>
      <p class="hint">One row per user, one column per slot: <span class="scale" aria-hidden="true"></span> fresh to stale.</p>`
    : !error && html`<div class="scene placeholder" role="status">Flying…</div>`}
  </section>`;
}

const average = (slot) => slot.users.reduce((sum, user) => sum + user[2], 0) / Math.max(slot.users.length, 1);

function Controls({ clock, length, known, show, toggle }) {
  return html`<section class="card player-controls" aria-label="Playback">
    <button type="button" class="primary play" onClick=${clock.toggle} disabled=${!known}>${clock.playing ? 'Pause' : 'Play'}</button>
    <button type="button" onClick=${() => clock.seek(clock.slot - 1)} aria-label="−1 slot">−1</button>
    <button type="button" onClick=${() => clock.seek(clock.slot + 1)} aria-label="+1 slot">+1</button>
    <input type="range" class="scrub" min="0" max=${length} value=${clock.slot} aria-label="Slot" aria-valuetext=${`slot ${clock.slot} of ${length}`} onInput=${(e) => clock.seek(Number(e.target.value))} />
    <output class="slot-number">slot ${clock.slot} of ${length}${known < length ? html` <span class="faint">(${known} flown)</span>` : ''}</output>
    <${Choice} value=${String(clock.speed)} options=${SPEEDS.map((s) => [String(s), `${s} slots/s`])} onChange=${(v) => clock.setSpeed(Number(v))} aria-label="Speed" />
    <span class="toggles">${SHOWN.map(([id, name]) => html`<button type="button" class="small" aria-pressed=${String(show[id])} onClick=${() => toggle(id)}>${name}</button>`)}</span>
  </section>`;
}

const ROWS = [['mean_aoi', 'Mean AoI'], ['p95_aoi', '95th percentile'], ['peak_aoi', 'Peak AoI'], ['coverage', 'Coverage'], ['fairness', 'Fairness']];

function Comparison({ names, flights, slot }) {
  const known = flights.map((flight, i) => ({ flight, name: names[i] })).filter(({ flight }) => flight);
  if (!known.length) return null;
  const curves = known.map(({ flight, name }, i) => ({
    label: name, x: flight.slots.map((_, k) => k), y: flight.slots.map(average), colour: algorithmColour(name.split(/[:@]/)[0]), dash: i ? [6, 4] : [],
  }));
  const done = known.filter(({ flight }) => flight.metrics);
  const text = (name, value) => (name === 'coverage' ? `${(100 * value).toFixed(0)} %` : number(value, 3));
  return html`<${Card} title="Mean AoI over the episode" class="comparison"><div class="comparison-parts">
      <${Chart} curves=${curves} label="mean AoI (slots)" x="slot" height=${220} playhead=${slot} />
      ${done.length ? html`<table class="figures"><thead><tr><th scope="col">Episode</th>${done.map(({ name }) => html`<th scope="col" class="number">${name}</th>`)}</tr></thead>
        <tbody>${ROWS.map(([id, label]) => html`<tr><th scope="row">${label}</th>${done.map(({ flight }) => html`<td class="number">${text(id, flight.metrics[id])}</td>`)}</tr>`)}</tbody></table>` : html`<p class="faint" role="status">The figures of the episode appear when it is flown.</p>`}
    </div><//>`;
}

/** Users placed by hand: click or touch to add one, click on one to remove it; or arrows and Enter. */
function Draw({ start, environment, done }) {
  const [users, set] = useState(start);
  const [cursor, setCursor] = useState(null);
  const canvas = useRef(null);
  const picture = { environment: { slots: 80, transmission_range: 0.12, detection_range: 0.28, ...environment }, slots: [{ uavs: [], users: users.map((u) => [...u, 0]) }] };
  useEffect(() => drawScene(canvas.current, picture, 0, { ranges: true }, cursor));
  const put = ([x, y]) => {
    if (x < 0 || x > 1 || y < 0 || y > 1) return;
    const hit = users.findIndex((u) => Math.hypot(u[0] - x, u[1] - y) < 0.03);
    if (hit >= 0) set(users.filter((_, i) => i !== hit));
    else if (users.length < BOUNDS.users) set([...users, [x, y]]);
  };
  const click = (e) => {
    const box = canvas.current.getBoundingClientRect();
    put(projection(canvas.current).from(e.clientX - box.left, e.clientY - box.top));
  };
  const key = (e) => {
    const at = cursor ?? [0.5, 0.5];
    const move = { ArrowLeft: [-0.02, 0], ArrowRight: [0.02, 0], ArrowUp: [0, 0.02], ArrowDown: [0, -0.02] }[e.key];
    if (move) setCursor(at.map((v, i) => Math.min(Math.max(v + move[i], 0), 1)));
    else if (e.key === 'Enter' || e.key === ' ') put(at);
    else return;
    e.preventDefault();
  };
  return html`<${Card} title="Draw a layout" actions=${html`<button type="button" onClick=${() => set([])}>Remove all</button><button type="button" onClick=${() => done(null)}>Discard</button>
      <button type="button" class="primary" disabled=${!users.length} onClick=${() => done(users)}>Fly over ${users.length} ${users.length === 1 ? 'user' : 'users'}</button>`}>
    <p class="hint">Click in the square to place a user, click on a user to remove it. With the keyboard: arrows move the cross, Enter places or removes.</p>
    <div class="draw"><canvas class="scene" ref=${canvas} tabindex="0" role="application" aria-label=${`Layout with ${users.length} users. Arrows move, Enter places or removes a user.`} onClick=${click} onKeyDown=${key}></canvas></div>
    ${!users.length && html`<${Empty} title="No user yet." />`}<//>`;
}
