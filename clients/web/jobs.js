// The list of jobs, with the curves of those that are selected.

import { html, useMemo, useRef, useState } from './htm-preact-3.1.1.js';
import { all, get, post, remove } from './api.js';
import { Curves } from './curves.js';
import { ago, clock, duration, number, short } from './format.js';
import { link, go, setOptions } from './route.js';
import { Action, ask, Bar, Card, Choice, Empty, ErrorBox, Field, Loading, run, State, Title, useLoad } from './ui.js';

const STATES = ['queued', 'running', 'paused', 'succeeded', 'failed', 'cancelled'];
const KINDS = ['train', 'evaluate', 'sweep', 'experiment'];

/** Whether a job only has other jobs. */
export const makesJobs = (job) => job.kind === 'sweep' || job.kind === 'experiment';
const PAGE = 100;
/** Jobs that are selected when the reader has selected none. */
const FIRST = 6;

/** Commands that a job accepts in its state: [command, name]. */
export function commands(job) {
  const stopping = job.wanted != null;
  switch (job.state) {
    case 'queued': return [['pause', 'Pause'], ['cancel', 'Cancel']];
    case 'running': return stopping ? [] : [['pause', 'Pause'], ['cancel', 'Cancel']];
    case 'paused': return [['resume', 'Resume'], ['cancel', 'Cancel']];
    case 'failed': return [['retry', 'Retry'], ['delete', 'Delete']];
    default: return [['delete', 'Delete']];
  }
}

const DONE = { pause: 'will pause', cancel: 'will be cancelled', resume: 'is in the queue again', retry: 'is in the queue again', delete: 'is deleted' };

/** Runs a command on a job, after a question if it cannot be undone. Returns whether it was run. */
export async function command(job, verb) {
  const name = job.name ?? `job ${job.id.slice(-6)}`;
  if (verb === 'cancel' && !(await ask(`Cancel ${name}?`, 'The job ends and cannot be continued. Its metrics and checkpoints stay. To continue later, pause it instead.', 'Cancel the job'))) return false;
  if (verb === 'delete' && !(await ask(`Delete ${name}?`, 'The job and its metrics, logs and checkpoints are deleted. A policy that it published stays.', 'Delete the job'))) return false;
  return run(() => (verb === 'delete' ? remove(`/v1/jobs/${job.id}`) : post(`/v1/jobs/${job.id}/${verb}`)), `${name} ${DONE[verb]}.`);
}

/** Share of a job that is done; one that succeeded is done, however early it ended. */
export const share = (job) => (job.state === 'succeeded' ? 1 : job.progress.steps ? Math.min(job.progress.step / job.progress.steps, 1) : 0);

/** Seconds until a running job has done all steps, by the speed since it was first seen here, else since it started. */
export function useTimeLeft() {
  const seen = useRef(new Map());
  return (job) => {
    if (job.state !== 'running') {
      seen.current.delete(job.id);
      return null;
    }
    const now = Date.now() / 1000;
    if (!seen.current.has(job.id)) seen.current.set(job.id, { at: now, step: job.progress.step });
    const first = seen.current.get(job.id);
    const done = job.progress.step - first.step;
    const whole = now - new Date(job.started_at) / 1000;
    const speed = now - first.at > 10 && done > 0 ? done / (now - first.at) : job.attempts === 1 ? job.progress.step / whole : 0;
    return speed > 0 ? (job.progress.steps - job.progress.step) / speed : null;
  };
}

/** Why a job does not run, or why it ended. */
export function why(job) {
  if (job.state === 'queued') return job.waiting?.reason ?? job.reason ?? '';
  if (job.unreadable) return job.unreadable.reason;
  return job.state === 'running' ? '' : (job.reason ?? '');
}

/** How jobs are sorted: [option of the address, name]. */
const ORDERS = [['', 'newest first'], ['created', 'oldest first'], ['name', 'name'], ['best:eval/mean_aoi', 'best mean AoI'], ['last:eval/mean_aoi', 'last mean AoI']];

/** Which jobs the reader sees: filtered and sorted by the server, searched here. */
function useJobs(state, kind, order, pages) {
  return useLoad(async (signal) => {
    const filter = `${state && `&state=${state}`}${kind && `&kind=${kind}`}${order && `&sort=${encodeURIComponent(order)}`}&metrics=eval/mean_aoi`;
    if (pages > 1) return { jobs: await all(`/v1/jobs?page_size=1000${filter}`, 'jobs', pages * PAGE, signal), more: false };
    const page = await get(`/v1/jobs?page_size=${PAGE}${filter}`, signal);
    return { jobs: page.jobs, more: page.next_page_token !== '' };
  }, [state, kind, order, pages], 2);
}

export function JobsPage({ options }) {
  const state = STATES.includes(options.get('state')) ? options.get('state') : '';
  const kind = KINDS.includes(options.get('kind')) ? options.get('kind') : '';
  const order = ORDERS.some(([id]) => id === options.get('order')) ? options.get('order') : '';
  const search = options.get('q') ?? '';
  const [pages, setPages] = useState(1);
  const list = useJobs(state, kind, order, pages);
  const timeLeft = useTimeLeft();
  const jobs = list.value?.jobs ?? [];
  const shown = useMemo(() => jobs.filter((job) => matches(job, search)), [list.value, search]);
  const chosen = options.has('jobs') ? options.get('jobs').split(',').filter(Boolean) : null;
  const selected = chosen ? jobs.filter((job) => chosen.includes(job.id)) : shown.filter((job) => job.progress.step > 0).slice(0, FIRST);
  const ids = new Set(selected.map((job) => job.id));
  const select = (id, on) => {
    const next = on ? [...ids, id] : [...ids].filter((other) => other !== id);
    setOptions({ jobs: next.join(',') || 'none' });
  };
  const selectAll = (on) => setOptions({ jobs: on ? shown.map((job) => job.id).join(',') : 'none' });
  const actions = html`<a class="button primary" href="#/submit">New job</a>`;
  if (!list.value) {
    return html`<${Title} text="Jobs" actions=${actions} />${list.error ? html`<${ErrorBox} error=${list.error} retry=${list.reload} />` : html`<${Loading} what="the jobs" />`}`;
  }
  if (!jobs.length && !state && !kind) return html`<${Title} text="Jobs" actions=${actions} /><${ErrorBox} error=${list.error} /><${NoJobs} />`;
  return html`
    <${Title} text="Jobs" actions=${actions} />
    <${ErrorBox} error=${list.error} retry=${list.reload} />
    <${Curves} jobs=${selected} options=${options} />
    <${Card}>
      <div class="controls">
        <${Field} label="State"><${Choice} value=${state} options=${[['', 'all'], ...STATES]} onChange=${(v) => setOptions({ state: v })} /><//>
        <${Field} label="Kind"><${Choice} value=${kind} options=${[['', 'all'], ...KINDS]} onChange=${(v) => setOptions({ kind: v })} /><//>
        <${Field} label="Order"><${Choice} value=${order} options=${ORDERS} onChange=${(v) => setOptions({ order: v })} /><//>
        <${Field} label="Search"><input type="search" value=${search} placeholder="name, algorithm, label=value, seed…" onInput=${(e) => setOptions({ q: e.target.value })} /><//>
        <span class="spacer"></span>
        <button type="button" onClick=${() => selectAll(true)}>Draw all</button><button type="button" onClick=${() => selectAll(false)}>Draw none</button>
        ${chosen && html`<button type="button" onClick=${() => setOptions({ jobs: '' })}>Draw the newest</button>`}
      </div>
      ${shown.length ? html`<div class="scroll"><table class="jobs stack">
        <thead><tr><th scope="col"><span class="hidden">Draw</span></th><th scope="col">Job</th><th scope="col">State</th><th scope="col">Progress</th><th scope="col" class="number">Best mean AoI</th><th scope="col">Submitted</th><th scope="col"><span class="hidden">Commands</span></th></tr></thead>
        <tbody>${shown.map((job) => html`<${Row} key=${job.id} job=${job} left=${timeLeft(job)} selected=${ids.has(job.id)} select=${select} reload=${list.reload} />`)}</tbody></table></div>`
      : html`<${Empty} title="No job matches."><p><button type="button" onClick=${() => setOptions({ q: '', state: '', kind: '' })}>Show all jobs</button></p><//>`}
      ${list.value.more && html`<p class="more"><button type="button" onClick=${() => setPages(pages + 9)}>Show older jobs</button></p>`}
    <//>`;
}

function NoJobs() {
  return html`<${Card}><${Empty} title="No jobs yet.">
    <p>A job trains a policy on this server. Its curve appears here while it runs, and the result can fly in the <a href="#/player">player</a> at once.</p>
    <p><a class="button primary" href="#/submit">Submit the first job</a></p>
    <p class="hint">From the command line: <code>qedgix jobs submit --algorithm qmix --steps 200000</code></p><//><//>`;
}

function matches(job, search) {
  const words = search.toLowerCase().split(/\s+/).filter(Boolean);
  const labels = Object.entries(job.labels ?? {}).map(([k, v]) => `${k}=${v}`).join(' ');
  const text = `${job.name ?? ''} ${job.algorithm ?? ''} ${job.preset ?? ''} ${job.kind ?? ''} seed=${job.seed} ${job.id} ${job.policy ?? ''} ${labels}`.toLowerCase();
  return words.every((word) => text.includes(word));
}

function Row({ job, left, selected, select, reload }) {
  const name = job.name ?? `job ${job.id.slice(-6)}`;
  const reason = why(job);
  const about = [job.kind && job.kind !== 'train' ? job.kind : null, job.algorithm, job.preset, job.seed == null ? null : `seed ${job.seed}`].filter(Boolean).join(' · ');
  return html`<tr>
    <td class="pick"><input type="checkbox" checked=${selected} onChange=${(e) => select(job.id, e.target.checked)} aria-label=${`Draw ${name}`} /></td>
    <td data-name="Job"><a class="strong" href=${link(['jobs', job.id])}>${name}</a><div class="faint small">${about}</div>
      ${Object.entries(job.labels ?? {}).map(([k, v]) => html`<span class="label">${k}=${v}</span>`)}</td>
    <td data-name="State"><${State} state=${job.state} wanted=${job.wanted} />${reason && html`<div class="faint small reason">${reason}</div>`}</td>
    <td data-name="Progress" class="progress"><${Bar} value=${share(job)} label=${`Progress of ${name}`} />
      <div class="faint small">${job.progress.step < job.progress.steps && job.state === 'succeeded' ? short(job.progress.step) : `${Math.floor(100 * share(job))} %`} of ${short(job.progress.steps)} steps${left != null ? html`, <strong>${duration(left)} left</strong>` : ''}${job.policy ? html`, <a href=${link(['policies', job.policy.split(':')[0]])}>${job.policy}</a>` : ''}</div></td>
    <td class="number" data-name="Best mean AoI">${number(job.metrics['eval/mean_aoi']?.best)}</td>
    <td data-name="Submitted" title=${clock(job.created_at)} class="nowrap">${ago(job.created_at)}</td>
    <td class="row-actions">${commands(job).map(([verb, label]) => html`<${Action} class="small" command=${() => command(job, verb).then(reload)} aria-label=${`${label} ${name}`}>${label}<//>`)}
      ${!makesJobs(job) && html`<button type="button" class="small" onClick=${() => go(link(['submit'], { from: job.id }))} aria-label=${`Clone ${name}`}>Clone</button>`}</td>
  </tr>`;
}
