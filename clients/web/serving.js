// Who is served: sessions, hosted environments, and the load of the server.

import { html, useRef, useState } from './htm-preact-3.1.1.js';
import { all, get, put, remove, text } from './api.js';
import { ago, bytes, clock, number } from './format.js';
import { link } from './route.js';
import { Action, ask, Card, Empty, Loaded, run, Title, useLoad } from './ui.js';

/** The samples of the metrics: [name, labels, value]. */
function samples(source) {
  return source.split('\n').flatMap((line) => {
    const [, name, labels = '', value] = /^([a-z_0-9]+)(?:\{(.*)\})? (\S+)$/.exec(line) ?? [];
    return name ? [[name, labels, Number(value)]] : [];
  });
}

const sum = (all, name, filter = () => true) => all.filter(([n, labels]) => n === name && filter(labels)).reduce((total, [, , value]) => total + value, 0);
const isAct = (labels) => /grpc_method="(Act|ActBatch|ActStream)"|route="\/v1\/act"|grpc_method="ModelInfer"|route="\/v2\/models\/[^"]*\/infer"/.test(labels);

async function loadServing(signal, before) {
  const [metrics, budget, sessions, environments] = await Promise.all([text('/metrics'), get('/v1/server/budget', signal), all('/v1/sessions?page_size=200', 'sessions', 200, signal), all('/v1/environments?page_size=200', 'environments', 200, signal)]);
  const found = samples(metrics);
  const now = {
    at: Date.now(),
    acts: sum(found, 'grpc_server_handled_total', isAct) + sum(found, 'http_requests_total', isAct),
    requests: sum(found, 'grpc_server_handled_total') + sum(found, 'http_requests_total'),
    failed: sum(found, 'http_requests_total', (l) => /status="5/.test(l)) + sum(found, 'grpc_server_handled_total', (l) => /grpc_code="(Internal|Unknown|DataLoss)"/.test(l)),
    seconds: sum(found, 'grpc_server_handling_seconds_sum', isAct) + sum(found, 'http_request_duration_seconds_sum', isAct),
    handled: sum(found, 'grpc_server_handling_seconds_count', isAct) + sum(found, 'http_request_duration_seconds_count', isAct),
  };
  const old = before.current;
  const rate = (name) => (old ? Math.max(0, ((now[name] - old[name]) * 1000) / (now.at - old.at)) : null);
  const recent = old && now.handled > old.handled ? (now.seconds - old.seconds) / (now.handled - old.handled) : now.handled ? now.seconds / now.handled : null;
  before.current = now;
  return { found, budget, sessions, environments, now, actRate: rate('acts'), requestRate: rate('requests'), actTime: recent };
}

const Tile = ({ name, value, text: about }) => html`<div class="tile"><div class="tile-name">${name}</div><div class="tile-value">${value}</div>${about && html`<div class="faint small">${about}</div>`}</div>`;

export function ServingPage() {
  const before = useRef(null);
  const serving = useLoad((signal) => loadServing(signal, before), [], 3);
  return html`<${Title} text="Serving" />
    <${Loaded} of=${serving} what="the load">${(s) => {
      const value = (name) => sum(s.found, name);
      return html`
        <div class="tiles">
          <${Tile} name="Act per second" value=${s.actRate == null ? '…' : number(s.actRate, 3)} text=${`${number(s.now.acts)} since the start`} />
          <${Tile} name="Time per Act" value=${s.actTime == null ? '–' : `${number(1000 * s.actTime, 3)} ms`} text="mean, on the server" />
          <${Tile} name="Requests per second" value=${s.requestRate == null ? '…' : number(s.requestRate, 3)} text=${s.now.failed ? html`<span class="wrong">${number(s.now.failed)} failed</span>` : 'none failed'} />
          <${Tile} name="Sessions" value=${number(value('qedgix_sessions'))} text=${bytes(value('qedgix_session_memory_bytes'))} />
          <${Tile} name="Environments" value=${number(value('qedgix_environments'))} text="hosted" />
          <${Tile} name="Queue of the engine" value=${number(value('qedgix_engine_queue_depth'))} text="fleets that wait" />
          <${Tile} name="Training threads" value=${`${s.budget.threads_busy} of ${s.budget.threads}`} text=${html`<${Budget} threads=${s.budget.threads} reload=${serving.reload} />`} />
          <${Tile} name="Policies in memory" value=${bytes(value('qedgix_policy_memory_bytes'))} text=${`${number(value('qedgix_policy_versions'))} versions`} />
          <${Tile} name="Connections" value=${number(value('qedgix_connections'))} text=${`${bytes(value('qedgix_inflight_bytes'))} in flight`} />
        </div>
        <${Card} title="Sessions">${s.sessions.length ? html`<div class="scroll"><table class="stack"><thead><tr><th scope="col">Session</th><th scope="col">Policy</th><th scope="col" class="number">Steps</th><th scope="col">Opened</th><th scope="col">Expires</th><th scope="col"><span class="hidden">Commands</span></th></tr></thead>
          <tbody>${s.sessions.map((session) => html`<tr><td><strong>${session.session_id}</strong></td><td><a href=${link(['policies', session.policy.name])}>${session.policy.name}:${session.policy.version}</a></td><td class="number" data-name="Steps">${number(session.steps)}</td><td title=${clock(session.opened_at)}>${ago(session.opened_at)}</td><td>${Math.round(parseFloat(session.ttl))} s after its last request</td>
            <td class="row-actions"><${Action} class="small" command=${() => close('session', `/v1/sessions/${encodeURIComponent(session.session_id)}`, session.session_id).then(serving.reload)}>Close<//></td></tr>`)}</tbody></table></div>
          ${value('qedgix_sessions') > s.sessions.length && html`<p class="hint">The first ${s.sessions.length} of ${number(value('qedgix_sessions'))} sessions.</p>`}`
        : html`<${Empty} title="No open session."><p>A simulator opens one with <code>OpenSession</code> and then sends one <code>Act</code> per slot. Try <code>POST /v1/sessions</code> in the <a href=${link(['console'], { operation: 'openSession' })}>API console</a>.</p><//>`}<//>
        <${Card} title="Hosted environments">${s.environments.length ? html`<div class="scroll"><table class="stack"><thead><tr><th scope="col">Environment</th><th scope="col">Fleet</th><th scope="col" class="number">Copies</th><th scope="col" class="number">Episode</th><th scope="col" class="number">Slot</th><th scope="col">Made</th><th scope="col"><span class="hidden">Commands</span></th></tr></thead>
          <tbody>${s.environments.map((e) => html`<tr><td><strong>${e.environment_id}</strong></td><td>${e.environment.uavs} UAVs, ${e.environment.users} users</td><td class="number" data-name="Copies">${e.count}</td><td class="number" data-name="Episode">${e.episode}</td><td class="number" data-name="Slot">${e.slot} of ${e.environment.slots}</td><td>${ago(e.created_at)}</td>
            <td class="row-actions"><${Action} class="small" command=${() => close('environment', `/v1/environments/${encodeURIComponent(e.environment_id)}`, e.environment_id).then(serving.reload)}>Delete<//></td></tr>`)}</tbody></table></div>`
        : html`<${Empty} title="No hosted environment."><p>External learners make them with <code>POST /v1/environments</code>; the <a href="#/player">player</a> uses them, too.</p><//>`}<//>`;
    }}<//>`;
}

/** Changes the CPU budget of training. */
function Budget({ threads, reload }) {
  const [value, set] = useState(null);
  if (value == null) return html`CPU budget <button type="button" class="small" onClick=${() => set(String(threads))}>Change</button>`;
  const save = async (event) => {
    event.preventDefault();
    if (await run(() => put('/v1/server/budget', { threads: Number(value) }), `The CPU budget is ${value}, until the server stops.`)) set(null);
    reload();
  };
  return html`<form class="budget" onSubmit=${save}><input type="number" min="1" max="4096" required value=${value} aria-label="Threads of the CPU budget" onInput=${(e) => set(e.target.value)} /><button class="small">Set</button></form>`;
}

async function close(what, path, id) {
  const text = what === 'session' ? 'Its recurrent state is lost: the simulator that uses it must begin a new run.' : 'The learner that uses it must make a new one.';
  if (await ask(`End the ${what} ${id}?`, text, `End the ${what}`)) await run(() => remove(path), `The ${what} is gone.`);
}
