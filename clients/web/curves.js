// Curves of several jobs: loading them while the jobs run, smoothing, and grouping by a field of the configuration.

import { html, useEffect, useMemo, useRef, useState } from './htm-preact-3.1.1.js';
import { get } from './api.js';
import { Chart, mean, smooth } from './chart.js';
import { Parallel, results, Table } from './compare.js';
import { flatten, isShare, METRICS, metricName, setting } from './format.js';
import { styles } from './palette.js';
import { setOptions } from './route.js';
import { Card, Choice, Empty, ErrorBox, Field } from './ui.js';

/** Most curves at once: more cannot be told apart, and each costs a request per refresh. */
export const MOST = 24;
/** Seconds between two requests for new rows of a running job. */
const REFRESH = 2;

const VIEWS = [['curves', 'Curves'], ['table', 'Table'], ['parallel', 'Parallel coordinates']];

const configurations = new Map();

/** The job with its configuration, which never changes. */
export async function configuration(id) {
  if (!configurations.has(id)) configurations.set(id, await get(`/v1/jobs/${id}`));
  return configurations.get(id);
}

/** The rows of one metric per job, by id: `{x, y}`. Running jobs are asked again for the rows after the last one. */
function useRows(jobs, metric) {
  const cache = useRef(new Map());
  const [, redraw] = useState(0);
  const [error, setError] = useState(null);
  const ids = jobs.map((job) => `${job.id}:${job.state}`).join();
  useEffect(() => {
    const abort = new AbortController();
    let timer;
    const load = async () => {
      let changed = false;
      let failed = null;
      await Promise.all(jobs.map(async (job) => {
        const key = `${job.id} ${metric}`;
        const rows = cache.current.get(key) ?? { x: [], y: [], token: '' };
        try {
          changed = (await more(job.id, metric, rows, abort.signal)) || changed;
          cache.current.set(key, rows);
        } catch (e) {
          if (!abort.signal.aborted) failed = e;
        }
      }));
      if (abort.signal.aborted) return;
      setError(failed);
      if (changed) redraw((n) => n + 1);
      if (jobs.some((job) => job.state === 'running' || job.state === 'queued')) timer = setTimeout(load, REFRESH * 1000);
    };
    load();
    return () => {
      abort.abort();
      clearTimeout(timer);
    };
  }, [ids, metric]);
  return { rows: (id) => cache.current.get(`${id} ${metric}`) ?? { x: [], y: [] }, error };
}

/** Loads the rows after those in `rows`. Returns whether there were any. */
async function more(id, metric, rows, signal) {
  let found = false;
  for (;;) {
    const page = await get(`/v1/jobs/${id}/metrics?name=${encodeURIComponent(metric)}&page_size=20000&page_token=${encodeURIComponent(rows.token)}`, signal);
    for (const row of page.metrics) {
      // A job that was continued from a snapshot records the steps after it again, with the same values.
      if (rows.x.length && row.step <= rows.x.at(-1)) continue;
      rows.x.push(row.step);
      rows.y.push(row.value);
      found = true;
    }
    if (rows.x.length) rows.token = `${metric}@${rows.x.at(-1)}`;
    if (!page.next_page_token) return found;
  }
}

/** Fields of jobs by which curves can be grouped: those that differ among the jobs. */
function useFields(jobs) {
  const [details, set] = useState([]);
  const ids = jobs.map((job) => job.id).join();
  useEffect(() => {
    let current = true;
    Promise.all(jobs.map((job) => configuration(job.id).catch(() => job))).then((all) => current && set(all));
    return () => {
      current = false;
    };
  }, [ids]);
  return useMemo(() => {
    const fieldsOf = (job) => new Map(flatten({
      name: job.name, algorithm: job.algorithm, preset: job.preset, seed: job.seed, labels: job.labels,
      environment: job.environment, training: job.training,
    }).map(([path, value]) => [path, setting(value)]));
    const byJob = new Map(details.map((job) => [job.id, fieldsOf(job)]));
    const names = [...new Set([...byJob.values()].flatMap((fields) => [...fields.keys()]))];
    const differing = names.filter((name) => new Set([...byJob.values()].map((fields) => fields.get(name))).size > 1);
    return { byJob, differing };
  }, [details]);
}

/** What a curve of several jobs shares: the value of a field, or of all differing fields but the seed. */
function groups(jobs, by, fields) {
  if (!by) return jobs.map((job) => ({ label: jobLabel(job, jobs, fields), jobs: [job] }));
  const names = by === 'all' ? fields.differing.filter((name) => name !== 'seed') : [by];
  const grouped = new Map();
  for (const job of jobs) {
    const values = names.map((name) => {
      const value = fields.byJob.get(job.id)?.get(name) ?? '–';
      return ['name', 'algorithm'].includes(name) ? value : `${name.split('.').at(-1)} ${value}`;
    });
    const label = values.join(', ') || 'all jobs';
    if (!grouped.has(label)) grouped.set(label, { label, jobs: [] });
    grouped.get(label).jobs.push(job);
  }
  return [...grouped.values()].map((g) => ({ ...g, label: g.jobs.length > 1 ? `${g.label} (${g.jobs.length} jobs)` : g.label }));
}

/** Most fields in the name of a curve. */
const NAMED = 3;

/** A name for the curve of a job that no other job in the plot has: with what differs among the jobs of the same name. */
function jobLabel(job, jobs, fields) {
  const name = job.name ?? job.algorithm ?? 'job';
  const same = jobs.filter((other) => (other.name ?? other.algorithm ?? 'job') === name);
  if (same.length === 1) return name;
  const value = (of, field) => fields.byJob.get(of.id)?.get(field);
  const differing = fields.differing.filter((field) => field !== 'name' && new Set(same.map((other) => value(other, field))).size > 1).slice(0, NAMED);
  const text = (of) => differing.map((field) => `${field.split('.').at(-1)} ${value(of, field)}`).join(', ');
  return same.some((other) => other !== job && text(other) === text(job)) ? `${name}, ${job.id.slice(-6)}` : `${name}, ${text(job)}`;
}

/** Several jobs compared. `first`: the view that is shown if the address names none. */
export function Curves({ jobs, options, first = 'curves' }) {
  const metric = options.get('metric') ?? 'eval/mean_aoi';
  const by = options.get('group') ?? '';
  const weight = Math.min(Math.max(Number(options.get('smooth') ?? 0) || 0, 0), 0.99);
  const shown = jobs.slice(0, MOST);
  const { rows, error } = useRows(shown, metric);
  const fields = useFields(shown);
  const all = groups(shown, by, fields);
  const looks = styles(all.map((group) => group.jobs[0].algorithm));
  const curves = all.map((group, i) => {
    const single = group.jobs.map((job) => {
      const { x, y } = rows(job.id);
      return { x, y: smooth(y, weight) };
    });
    return { label: group.label, ...looks[i], ...(single.length === 1 ? { x: single[0].x.slice(), y: single[0].y.slice() } : mean(single)) };
  });
  const drawn = curves.filter((curve) => curve.x.length);
  const banded = drawn.some((curve) => curve.low);
  const view = VIEWS.some(([id]) => id === options.get('view')) ? options.get('view') : first;
  const compared = view === 'curves' ? [] : results(shown, fields, rows, metric);
  const names = METRICS[metric] ? Object.keys(METRICS) : [metric, ...Object.keys(METRICS)];
  const views = html`<span class="toggles">${VIEWS.map(([id, name]) => html`<button type="button" class="small" aria-pressed=${String(view === id)} onClick=${() => setOptions({ view: id === first ? '' : id })}>${name}</button>`)}</span>`;
  return html`<${Card} title="Comparison" class="curves" actions=${views}>
    <div class="controls">
      <${Field} label="Metric"><${Choice} value=${metric} options=${names.map((n) => [n, metricName(n)])} onChange=${(v) => setOptions({ metric: v === 'eval/mean_aoi' ? '' : v })} /><//>
      ${view === 'curves' && html`<${Field} label="Group by"><${Choice} value=${by} onChange=${(v) => setOptions({ group: v })}
        options=${[['', 'nothing: a curve per job'], ['all', 'all that differs but the seed'], ...withCurrent(fields.differing, by).map((n) => [n, n])]} /><//>
      <${Field} label=${`Smoothing ${weight || 'off'}`}><input type="range" min="0" max="0.98" step="0.02" value=${weight} onInput=${(e) => setOptions({ smooth: Number(e.target.value) || '' })} /><//>`}
    </div>
    <${ErrorBox} error=${error} />
    ${view === 'table' && html`<${Table} all=${compared} fields=${fields} metric=${metric} options=${options} />`}
    ${view === 'parallel' && html`<${Parallel} all=${compared} fields=${fields} metric=${metric} />`}
    ${view === 'curves' && html`${drawn.length ? html`<${Chart} curves=${drawn} label=${metricName(metric)} share=${isShare(metric)} height=${340} />` : html`<${Empty} title=${shown.length ? 'No rows of this metric yet.' : 'No job is selected.'}>
      <p>${shown.length ? 'A curve appears here as soon as the first rows arrive.' : 'Select jobs in the table below; their curves appear here.'}</p><//>`}
    <p class="hint">${jobs.length > MOST ? `The first ${MOST} of ${jobs.length} selected jobs are drawn. ` : ''}${banded ? 'Bands: mean ± one standard deviation over the jobs of the group. ' : ''}${
      drawn.length ? 'Drag to zoom, double-click to see all; a name in the legend hides its curve.' : ''}</p>`}
  <//>`;
}

const withCurrent = (names, current) => (current && current !== 'all' && !names.includes(current) ? [...names, current] : names);
