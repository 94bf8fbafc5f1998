// One job: its state, curves while it runs, configuration, events, logs and checkpoints.

import { html, useEffect, useRef, useState } from './htm-preact-3.1.1.js';
import { download, followJob, get, post } from './api.js';
import { Chart, smooth } from './chart.js';
import { ago, bytes, clock, duration, flatten, isShare, METRICS, metricName, number, setting, short } from './format.js';
import { algorithmColour, colour } from './palette.js';
import { go, link, setOptions } from './route.js';
import { Action, Bar, Card, copy, Empty, ErrorBox, Field, Loaded, Loading, run, State, Tabs, Title, useLoad } from './ui.js';
import { Evaluation, SweepJobs } from './report.js';
import { Edit } from './edit.js';
import { command, commands, makesJobs, share, useTimeLeft, why } from './jobs.js';

/** The views of a job of each kind; the first one is shown if the address names none. */
const VIEWS = {
  train: [['curves', 'Curves'], ['configuration', 'Configuration'], ['events', 'Events'], ['logs', 'Logs'], ['checkpoints', 'Checkpoints']],
  evaluate: [['report', 'Report'], ['configuration', 'Configuration'], ['events', 'Events'], ['logs', 'Logs']],
  sweep: [['jobs', 'Jobs'], ['configuration', 'Configuration'], ['events', 'Events']],
  experiment: [['jobs', 'Jobs'], ['configuration', 'Configuration'], ['events', 'Events']],
};

/** Milliseconds between two drawings of a stream of events. */
const REDRAW = 250;

/** All events of a job as they happen: curves by metric, and changes of state. */
function useEvents(id) {
  const store = useRef({ curves: new Map(), states: [], trouble: null, ended: false });
  const [, redraw] = useState(0);
  useEffect(() => {
    const abort = new AbortController();
    const now = (store.current = { curves: new Map(), states: [], trouble: null, ended: false });
    let timer = null;
    const soon = () => {
      timer ??= setTimeout(() => {
        timer = null;
        redraw((n) => n + 1);
      }, REDRAW);
    };
    const onEvent = (name, data) => {
      if (name === 'state') now.states.push(data);
      for (const { name: metric, step, value } of data.metrics ?? []) add(now.curves, metric, step, value);
      soon();
    };
    const onTrouble = (error) => {
      now.trouble = error;
      soon();
    };
    followJob(id, { onEvent, onTrouble, signal: abort.signal }).then(() => {
      now.ended = true;
      soon();
    });
    return () => {
      abort.abort();
      clearTimeout(timer);
    };
  }, [id]);
  return store.current;
}

function add(curves, metric, step, value) {
  if (!curves.has(metric)) curves.set(metric, { x: [], y: [] });
  const curve = curves.get(metric);
  // A job that was continued from a snapshot records the steps after it again: the new values replace the old ones.
  while (curve.x.length && curve.x.at(-1) >= step) {
    curve.x.pop();
    curve.y.pop();
  }
  curve.x.push(step);
  curve.y.push(value);
}

export function JobPage({ id, options }) {
  const events = useEvents(id);
  const job = useLoad((signal) => get(`/v1/jobs/${encodeURIComponent(id)}`, signal), [id, events.states.length, events.ended], events.ended ? 0 : 2);
  const timeLeft = useTimeLeft();
  const [editing, setEditing] = useState(false);
  if (!job.value) return html`<${Title} text="Job" />${job.error ? html`<${ErrorBox} error=${job.error} retry=${job.reload} /><p><a href="#/jobs">All jobs</a></p>` : html`<${Loading} what="the job" />`}`;
  const now = job.value;
  const views = VIEWS[now.kind] ?? VIEWS.train;
  const view = views.some(([tab]) => tab === options.get('tab')) ? options.get('tab') : views[0][0];
  const name = now.name ?? `job ${id.slice(-6)}`;
  const act = async (verb) => {
    if (!(await command(now, verb))) return;
    if (verb === 'delete') go('#/jobs');
    else job.reload();
  };
  const actions = html`${commands(now).map(([verb, label]) => html`<${Action} command=${() => act(verb)}>${label}<//>`)}<button type="button" onClick=${() => setEditing(true)}>Edit</button>${!makesJobs(now) && html`<a class="button" href=${link(['submit'], { from: id })}>Clone</a>`}`;
  return html`
    <p class="crumbs"><a href="#/jobs">Jobs</a></p>
    <${Title} text=${name} actions=${actions}>${name} <${State} state=${now.state} wanted=${now.wanted} /><//>
    <${ErrorBox} error=${job.error} />
    ${editing && html`<${Edit} job=${now} close=${() => { setEditing(false); job.reload(); }} />`}
    <${Summary} job=${now} left=${timeLeft(now)} />
    <${Tabs} parts=${['jobs', id]} views=${views} current=${view} />
    ${view === 'report' && html`<${Evaluation} job=${now} />`}
    ${view === 'jobs' && html`<${SweepJobs} id=${id} options=${options} ended=${now.ended_at != null} />`}
    ${view === 'curves' && html`<${AllCurves} job=${now} events=${events} options=${options} />`}
    ${view === 'configuration' && html`<${Configuration} job=${now} />`}
    ${view === 'events' && html`<${Events} events=${events} />`}
    ${view === 'logs' && html`<${Logs} id=${id} state=${now.state} />`}
    ${view === 'checkpoints' && html`<${Checkpoints} job=${now} />`}`;
}

function Summary({ job, left }) {
  const { step, steps } = job.progress;
  const reason = why(job);
  return html`<${Card}>
    <${Bar} value=${share(job)} label="Progress" />
    <dl class="facts wide">
      <div><dt>Progress</dt><dd>${number(step)} of ${number(steps)} steps${left != null ? html`, <strong>${duration(left)} left</strong>` : ''}</dd></div>
      <div><dt>Algorithm</dt><dd><span class="swatch" style=${{ background: algorithmColour(job.algorithm) }}></span> ${[job.kind && job.kind !== 'train' ? job.kind : null, job.algorithm, job.preset && `preset ${job.preset}`, job.seed != null && `seed ${job.seed}`].filter(Boolean).join(', ')}</dd></div>
      <div><dt>Submitted</dt><dd title=${clock(job.created_at)}>${ago(job.created_at)}</dd></div>
      <div><dt>${job.ended_at ? 'Took' : 'Started'}</dt><dd>${job.ended_at && job.started_at ? duration((new Date(job.ended_at) - new Date(job.started_at)) / 1000) : ago(job.started_at)}</dd></div>
      <div><dt>Attempts</dt><dd>${job.attempts}${job.failures ? `, ${job.failures} failed` : ''}</dd></div>
      <div><dt>Threads</dt><dd>${job.threads}${job.priority ? `, priority ${job.priority}` : ''}</dd></div>
      ${job.policy && html`<div><dt>Policy</dt><dd><a href=${link(['policies', job.policy.split(':')[0]])}>${job.policy}</a> · <a href=${link(['player'], { policy: job.policy })}>fly it</a></dd></div>`}
      ${job.metrics?.['eval/mean_aoi']?.best != null && html`<div><dt>Best mean AoI</dt><dd><strong>${number(job.metrics['eval/mean_aoi'].best)}</strong> at ${short(job.metrics['eval/mean_aoi'].best_step)} steps</dd></div>`}
      ${job.parent && html`<div><dt>Made by</dt><dd><a href=${link(['jobs', job.parent])}>another job</a></dd></div>`}
      ${Object.keys(job.labels ?? {}).length > 0 && html`<div><dt>Labels</dt><dd>${Object.entries(job.labels).map(([k, v]) => html`<span class="label">${k}=${v}</span>`)}</dd></div>`}
    </dl>
    ${job.notes && html`<p class="notes">${job.notes}</p>`}
    ${reason && html`<p class=${job.state === 'failed' ? 'wrong' : 'faint'}><strong>${job.state === 'queued' ? 'Waiting' : 'Reason'}:</strong> ${reason}</p>`}
  <//>`;
}

/** Metrics that are drawn first, and large. */
const MAIN = ['eval/mean_aoi', 'train/mean_aoi'];

function AllCurves({ job, events, options }) {
  const weight = Math.min(Math.max(Number(options.get('smooth') ?? 0) || 0, 0), 0.99);
  const of = (name, place, label) => {
    const { x, y } = events.curves.get(name) ?? { x: [], y: [] };
    return { label: label ?? metricName(name), x: x.slice(), y: smooth(y, weight).slice(), colour: place, dash: name === 'train/mean_aoi' ? [5, 3] : [] };
  };
  const own = algorithmColour(job.algorithm);
  const main = MAIN.filter((name) => events.curves.has(name)).map((name) => of(name, name === 'train/mean_aoi' ? colour(7) : own, name === 'train/mean_aoi' ? 'while training (explores)' : 'in evaluations'));
  const known = Object.keys(METRICS);
  const order = (name) => (known.includes(name) ? known.indexOf(name) : known.length);
  const rest = [...events.curves.keys()].filter((name) => !MAIN.includes(name) && events.curves.get(name).x.length > 1).sort((a, b) => order(a) - order(b));
  return html`
    ${events.trouble && html`<${ErrorBox} error=${events.trouble} />`}
    <${Card} title="Mean AoI" actions=${html`<${Field} label=${`Smoothing ${weight || 'off'}`}><input type="range" min="0" max="0.98" step="0.02" value=${weight} onInput=${(e) => setOptions({ smooth: Number(e.target.value) || '' })} /><//>
      <button type="button" onClick=${() => run(() => download(`/v1/jobs/${job.id}/metrics?format=csv`, `${job.name ?? job.id}.csv`))}>Save as CSV</button>`}>
      ${main.length ? html`<${Chart} curves=${main} label="Mean AoI (slots)" height=${320} />` : html`<${Empty} title="No metrics yet."><p>The first evaluation appears here soon after the job has started.</p><//>`}
    <//>
    <div class="grid">${rest.map((name) => html`<${Card} key=${name} title=${metricName(name)}><${Chart} curves=${[of(name, own, name)]} label=${name} share=${isShare(name)} height=${210} /><//>`)}</div>`;
}

function Configuration({ job }) {
  const parts = [['Environment', job.environment], ['Training', job.training], ['Evaluation', job.evaluation], ['Sweep', job.sweep], ['Experiment', job.experiment]].filter(([, values]) => values);
  const request = { name: job.name, algorithm: job.algorithm, preset: job.preset, seed: job.seed, threads: job.threads, environment: job.environment, training: job.training };
  if (job.unreadable) return html`<${Card} title="Unreadable specification"><p>${job.unreadable.reason}</p><pre tabindex="0">${job.unreadable.document}</pre><//>`;
  return html`<p class="right"><button type="button" onClick=${() => copy(JSON.stringify(request, null, 2))}>Copy as JSON</button></p>
    <div class="grid">${parts.map(([name, values]) => html`<${Card} title=${name}><table class="settings"><tbody>${flatten(values ?? {}).map(([path, value]) => html`<tr><th scope="row">${path}</th><td class="number"><code>${setting(value)}</code></td></tr>`)}</tbody></table><//>`)}</div>`;
}

function Events({ events }) {
  if (!events.states.length) return html`<${Loading} what="the events" />`;
  return html`<${Card}><table><thead><tr><th scope="col">Time</th><th scope="col">State</th><th scope="col">Attempt</th><th scope="col">Reason</th></tr></thead>
    <tbody>${[...events.states].reverse().map((e) => html`<tr><td>${clock(e.at)}</td><td><${State} state=${e.state} /></td><td>${e.attempt || '–'}</td><td>${e.reason ?? ''}</td></tr>`)}</tbody></table><//>`;
}

function Logs({ id, state }) {
  const logs = useLoad((signal) => get(`/v1/jobs/${id}/logs`, signal), [id, state], state === 'running' ? 3 : 0);
  return html`<${Loaded} of=${logs} what="the logs">${({ attempts }) => (attempts.length ? [...attempts].reverse().map((a) => html`<${Card} title=${`Attempt ${a.attempt}`} actions=${html`<span class="faint">${clock(a.started_at)}${a.outcome ? ` · ${a.outcome}` : ' · running'}</span>`}>
      ${a.reason && html`<p>${a.reason}</p>`}<pre tabindex="0" aria-label=${`Output of attempt ${a.attempt}`}>${a.log || 'The worker has written nothing.'}</pre><//>`)
    : html`<${Empty} title="The job has not started yet."><p>The output of its worker appears here.</p><//>`)}<//>`;
}

function Checkpoints({ job }) {
  const list = useLoad((signal) => get(`/v1/jobs/${job.id}/checkpoints`, signal), [job.id, job.state], job.state === 'running' ? 5 : 0);
  const publish = (checkpoint) => run(() => post(`/v1/policies/${job.name ?? `job-${job.id.slice(-6)}`}/versions`, { checkpoint_id: checkpoint.id }), 'The checkpoint is a version of the policy now.');
  return html`<${Loaded} of=${list} what="the checkpoints">${({ checkpoints }) => (checkpoints.length ? html`<${Card}><div class="scroll"><table class="stack"><thead><tr><th scope="col">Kind</th><th scope="col" class="number">Step</th><th scope="col" class="number">Mean AoI</th><th scope="col" class="number">Size</th><th scope="col">Taken</th><th scope="col"><span class="hidden">Commands</span></th></tr></thead>
      <tbody>${checkpoints.map((c) => html`<tr><td><strong>${c.kind}</strong></td><td class="number" data-name="Step">${short(c.step)}</td><td class="number" data-name="Mean AoI">${number(c.metrics['eval/mean_aoi'] ?? c.metrics.mean_aoi)}</td><td class="number" data-name="Size">${bytes(c.size)}</td><td>${ago(c.created_at)}</td>
        <td class="row-actions"><${Action} class="small" command=${() => run(() => download(`/v1/checkpoints/${c.id}`, `${job.name ?? job.id}-${c.kind}.safetensors`))}>Save<//><${Action} class="small" command=${() => publish(c)}>Publish as a policy<//></td></tr>`)}</tbody></table></div><//>`
    : html`<${Empty} title="No checkpoint yet."><p>The first one is taken at the first evaluation.</p><//>`)}<//>`;
}
