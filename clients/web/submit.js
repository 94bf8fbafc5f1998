// The form of a new job. Its fields come from the OpenAPI document, so it knows every setting of this server.

import { html, useEffect, useMemo, useState } from './htm-preact-3.1.1.js';
import { get, post } from './api.js';
import { parseLabels } from './edit.js';
import { setting } from './format.js';
import { go, link } from './route.js';
import { Card, Choice, ErrorBox, Field, Loaded, say, Title, useLoad } from './ui.js';

const PRESETS = { practical: 'practical: trains in minutes', paper: 'paper: as in the paper', authors: "authors: as in the authors' code" };

const KINDS = { train: 'train: one training run', evaluate: 'evaluate: policies on frozen layouts', sweep: 'sweep: training runs over values' };

/** The schema itself, without an alternative for null. Of several alternatives none is chosen: a text stands for all. */
const bare = (schema, document) => {
  const real = schema.oneOf?.filter((one) => one.type !== 'null') ?? [];
  const chosen = real.length === 1 ? real[0] : schema;
  return chosen.$ref ? { ...document.components.schemas[chosen.$ref.split('/').at(-1)], description: schema.description ?? chosen.description } : chosen;
};

/** Settings of a section (`environment` or `training`): [path, schema]. */
function settings(document, section) {
  const request = document.components.schemas.JobRequest.properties;
  const schema = bare(request[section], document);
  return Object.entries(schema.properties ?? {}).map(([name, inner]) => [`${section}.${name}`, { ...bare(inner, document), type: inner.type ?? bare(inner, document).type, default: inner.default }]);
}

const types = (schema) => [schema.type].flat().filter((type) => type && type !== 'null');

/** The value that a text in a field means. Throws a message if it means none. */
function parse(text, schema) {
  const kinds = types(schema);
  if (text === 'none' && [schema.type].flat().includes('null')) return null;
  if (kinds.includes('boolean')) return text === 'true';
  if (kinds.includes('number') || kinds.includes('integer')) {
    const value = Number(text.replace(/[_\s\u202f]/g, ''));
    if (!Number.isFinite(value)) throw new Error('a number is expected');
    if (kinds.includes('integer') && !kinds.includes('number') && !Number.isInteger(value)) throw new Error('a whole number is expected');
    if (schema.minimum != null && value < schema.minimum) throw new Error(`at least ${schema.minimum} is expected`);
    if (schema.maximum != null && value > schema.maximum) throw new Error(`at most ${schema.maximum} is expected`);
    return value;
  }
  if (/^[[{]/.test(text)) {
    try {
      return JSON.parse(text);
    } catch {
      throw new Error('this is not JSON');
    }
  }
  return text;
}

/** `1, 3-5` as [1, 3, 4, 5]. */
export function seeds(text) {
  const all = [];
  for (const part of text.split(/[,\s]+/).filter(Boolean)) {
    const [, from, to] = /^(\d{1,15})(?:-(\d{1,15}))?$/.exec(part) ?? [];
    if (from === undefined) throw new Error(`“${part}” is not a seed. Write 1, 2, 3 or 1-3.`);
    if (Number(to ?? from) - Number(from) > 99 || Number(to ?? from) < Number(from)) throw new Error('A range has 1 to 100 seeds.');
    for (let seed = Number(from); seed <= Number(to ?? from); seed += 1) all.push(seed);
  }
  if (!all.length) throw new Error('At least one seed is needed.');
  if (all.length > 100) throw new Error('At most 100 jobs at once.');
  return [...new Set(all)];
}

export function SubmitPage({ options }) {
  const from = options.get('from');
  const loaded = useLoad(async (signal) => {
    const [document, source] = await Promise.all([get('/openapi.json', signal), from ? get(`/v1/jobs/${from}`, signal) : null]);
    return { document, source };
  }, [from]);
  return html`<p class="crumbs"><a href="#/jobs">Jobs</a></p>
    <${Title} text=${from ? `Clone ${loaded.value?.source?.name ?? 'a job'}` : 'New job'} />
    <${Loaded} of=${loaded} what="the settings">${({ document, source }) => html`<${Form} document=${document} source=${source} options=${options} />`}<//>`;
}

function Form({ document, source, options }) {
  const request = document.components.schemas.JobRequest.properties;
  const algorithms = bare(request.algorithm, document).enum;
  const kinds = (request.kind?.enum ?? ['train']).filter((kind) => kind && (kind === 'train' || KINDS[kind]));
  const start = {
    name: source?.name ?? '', algorithm: source?.algorithm ?? options.get('algorithm') ?? 'qedgix', preset: source?.preset ?? 'practical', seeds: String(source?.seed ?? 1),
    kind: kinds.includes(source?.kind ?? options.get('kind')) ? source?.kind ?? options.get('kind') : 'train', notes: source?.notes ?? '', timeout: '', stop: '',
    policies: source?.evaluation?.policies?.join(', ') ?? options.get('policies') ?? '', layouts: 'eval-v1', episodes: '', grid: '', repeats: '',
    threads: source ? String(source.threads) : '', priority: source?.priority ? String(source.priority) : '', labels: Object.entries(source?.labels ?? {}).map(([k, v]) => `${k}=${v}`).join(', '),
  };
  const [basics, setBasics] = useState(start);
  const [values, setValues] = useState({});
  const [search, setSearch] = useState('');
  const [error, setError] = useState(null);
  const [busy, setBusy] = useState(false);
  const all = useMemo(() => [...settings(document, 'environment'), ...settings(document, 'training')], [document]);
  const initial = useMemo(() => Object.fromEntries(all.map(([path]) => {
    const [section, name] = path.split('.');
    return [path, source ? setting(source[section]?.[name]) : ''];
  })), [all, source]);
  const set = (name) => (value) => setBasics({ ...basics, [name]: value });
  const change = (path, value) => {
    const next = { ...values, [path]: value };
    if (value === initial[path] || (value === '' && !source)) delete next[path];
    setValues(next);
    if (error?.field === path) setError(null);
  };
  const changes = [
    ...Object.keys(start).filter((name) => basics[name] !== start[name]).map((name) => [name, start[name] || 'default', basics[name] || 'default']),
    ...Object.entries(values).map(([path, value]) => [path, initial[path] || 'preset', value]),
  ];
  const submit = async (event) => {
    event.preventDefault();
    setError(null);
    let body;
    try {
      body = bodies(basics, values, all, source);
    } catch (problem) {
      setError(problem);
      return;
    }
    setBusy(true);
    const made = [];
    try {
      for (const job of body) made.push(await post('/v1/jobs', job, { headers: { 'idempotency-key': crypto.randomUUID?.() ?? String(Math.random()) } }));
      say(made.length === 1 ? 'The job is submitted.' : `${made.length} jobs are submitted.`);
      go(made.length === 1 ? link(['jobs', made[0].id]) : link(['jobs'], { jobs: made.map((job) => job.id).join(','), group: 'all' }));
    } catch (problem) {
      if (made.length) problem.message = `${made.length} of ${body.length} jobs are submitted; then: ${problem.message}`;
      setError(problem);
    }
    setBusy(false);
  };
  const evaluates = basics.kind === 'evaluate';
  const visible = all.filter(([path]) => !evaluates || path.startsWith('environment.')).filter(([path, schema]) => `${path} ${schema.description ?? ''}`.toLowerCase().includes(search.toLowerCase()));
  const wrong = (field) => (error?.field === field ? error.message : null);
  const text = (name, label, hint, field) => html`<${Field} label=${label} hint=${hint} error=${wrong(field)}><input value=${basics[name]} onInput=${(e) => set(name)(e.target.value)} /><//>`;
  return html`<form onSubmit=${submit} class="submit">
    <${Card}>
      <div class="form">
        <${Field} label="Name" hint="Of the job and of the policy that it publishes. Empty: none." error=${wrong('name')}><input value=${basics.name} maxlength="63" onInput=${(e) => set('name')(e.target.value)} /><//>
        ${kinds.length > 1 && html`<${Field} label="Kind" error=${wrong('kind')}><${Choice} value=${basics.kind} options=${kinds.map((kind) => [kind, KINDS[kind]])} onChange=${set('kind')} /><//>`}
        ${!evaluates && html`<${Field} label="Algorithm" error=${wrong('algorithm')}><${Choice} value=${basics.algorithm} options=${algorithms} onChange=${set('algorithm')} /><//>
        <${Field} label="Preset" hint="What the settings below start from." error=${wrong('preset')}><${Choice} value=${basics.preset} options=${bare(request.preset, document).enum.map((p) => [p, PRESETS[p] ?? p])} onChange=${set('preset')} /><//>
        ${basics.kind === 'sweep' ? text('repeats', 'Seeds of each combination', 'Empty: 1.', 'sweep.seeds') : html`<${Field} label="Seeds" hint="One job per seed: 1 or 1, 2, 5-8." error=${wrong('seed')}><input value=${basics.seeds} inputmode="numeric" required onInput=${(e) => set('seeds')(e.target.value)} /><//>`}`}
        ${evaluates && html`${text('policies', 'Policies', 'Separated by commas: qedgix, my-policy@live, sweep.', 'evaluation.policies')}
          <${Field} label="Layouts"><${Choice} value=${basics.layouts} options=${['eval-v1', 'valid-v1']} onChange=${set('layouts')} /><//>
          ${text('episodes', 'Number of layouts', 'Empty: 256.', 'evaluation.episodes')}`}
        <${Field} label="Threads" hint=${`1 to ${request.threads.maximum}, the CPU budget. Empty: the server decides.`} error=${wrong('threads')}><input value=${basics.threads} inputmode="numeric" onInput=${(e) => set('threads')(e.target.value)} /><//>
        <${Field} label="Priority" hint="-100 to 100; higher starts first. Empty: 0." error=${wrong('priority')}><input value=${basics.priority} onInput=${(e) => set('priority')(e.target.value)} /><//>
        <${Field} label="Labels" hint="key=value, key=value" error=${wrong('labels')}><input value=${basics.labels} onInput=${(e) => set('labels')(e.target.value)} /><//>
        ${request.timeout && !evaluates && text('timeout', 'Time limit', 'Seconds that the job may run. Empty: none.', 'timeout')}
        ${request.stop && !evaluates && text('stop', 'Stop early', 'When the mean AoI of an evaluation is at most this. Empty: never.', 'stop.at_most')}
        ${request.notes && text('notes', 'Notes', 'For people.', 'notes')}
      </div>
      ${basics.kind === 'sweep' && html`<${Field} label="What varies" hint="One line per field, with its values; all combinations are trained." error=${wrong('sweep.grid')}>
        <textarea rows="4" placeholder=${'training.learning_rate: 0.0003, 0.001\nalgorithm: qmix, qedgix'} value=${basics.grid} onInput=${(e) => set('grid')(e.target.value)}></textarea><//>`}
    <//>
    <${Card} title="Settings" actions=${html`<input type="search" aria-label="Search settings" placeholder="Search settings" value=${search} onInput=${(e) => setSearch(e.target.value)} />`}>
      <p class="hint">${source ? 'All settings of the cloned job. Changed ones are marked.' : 'An empty field keeps the value of the preset.'}</p>
      <div class="settings-list" tabindex="0" role="group" aria-label="Settings">
        ${visible.map(([path, schema]) => html`<${Setting} key=${path} path=${path} schema=${schema} value=${values[path] ?? initial[path]} changed=${path in values} cloned=${!!source} error=${wrong(path)} change=${change} />`)}
        ${!visible.length && html`<p class="faint">No setting matches.</p>`}
      </div>
    <//>
    ${changes.length > 0 && html`<${Card} title=${source ? 'Changes to the cloned job' : 'Differs from the preset'}>
      <table class="changes"><thead><tr><th scope="col">Setting</th><th scope="col">Before</th><th scope="col">Now</th></tr></thead><tbody>${changes.map(([name, before, now]) => html`<tr><th scope="row">${name}</th><td><code>${before}</code></td><td><code>${now}</code></td></tr>`)}</tbody></table><//>`}
    <${ErrorBox} error=${error} />
    <p class="actions"><button class="primary" disabled=${busy}>${busy ? 'Submitting…' : 'Submit'}</button><a class="button" href="#/jobs">Discard</a></p>
  </form>`;
}

function Setting({ path, schema, value, changed, cloned, error, change }) {
  const kinds = types(schema);
  const [section, name] = path.split('.');
  const id = `setting-${path}`;
  const options = schema.enum ?? (kinds.includes('boolean') ? ['true', 'false'] : null);
  const range = [schema.minimum != null ? `at least ${schema.minimum}` : '', schema.maximum != null && schema.maximum < 1e9 ? `at most ${schema.maximum}` : ''].filter(Boolean).join(', ');
  const set = (e) => change(path, e.target.value);
  return html`<div class=${`setting ${changed ? 'changed' : ''}`}>
    <label for=${id}><span class="faint">${section}.</span><strong>${name}</strong></label>
    <div>${options ? html`<select id=${id} value=${value} onChange=${set}>${!cloned && html`<option value="" selected=${!value}>preset</option>`}${options.map((o) => html`<option value=${o} selected=${o === value}>${o}</option>`)}</select>`
      : html`<input id=${id} value=${value} placeholder="preset" onInput=${set} />`}
      ${error && html`<span class="hint wrong" role="alert">${error}</span>`}</div>
    <span class="hint">${schema.description ?? ''}${range ? ` (${range})` : ''}</span></div>`;
}

/** `field: value, value` per line, as the fields of a sweep. Values are JSON where they can be. */
function grid(text, failed) {
  const fields = {};
  for (const line of text.split('\n').map((l) => l.trim()).filter(Boolean)) {
    const [, field, values] = /^([A-Za-z_.]+)\s*[:=]\s*(.+)$/.exec(line) ?? [];
    if (!field) throw failed('sweep.grid', `“${line}” is not FIELD: VALUE, VALUE.`);
    fields[field] = values.split(',').map((value) => {
      try {
        return JSON.parse(value);
      } catch {
        return value.trim();
      }
    });
  }
  if (!Object.keys(fields).length) throw failed('sweep.grid', 'At least one field is needed.');
  return fields;
}

/** The requests of the form: one job per seed. */
function bodies(basics, values, all, source) {
  const failed = (field, problem) => Object.assign(new Error(problem), { field });
  const evaluates = basics.kind === 'evaluate';
  const body = { ...(basics.kind === 'train' ? {} : { kind: basics.kind }), ...(evaluates ? {} : { algorithm: basics.algorithm, preset: basics.preset }) };
  if (basics.name.trim()) body.name = basics.name.trim();
  if (basics.notes) body.notes = basics.notes;
  for (const name of ['threads', 'priority', 'timeout']) {
    if (basics[name].trim() === '') continue;
    if (!/^-?\d+$/.test(basics[name].trim())) throw failed(name, 'A whole number is expected.');
    body[name] = Number(basics[name]);
  }
  try {
    if (basics.labels.trim()) body.labels = parseLabels(basics.labels);
  } catch (problem) {
    throw failed('labels', problem.message);
  }
  if (evaluates) {
    body.evaluation = { policies: basics.policies.split(/[,\s]+/).filter(Boolean), layouts: basics.layouts, ...(basics.episodes ? { episodes: Number(basics.episodes) } : {}) };
  } else if (basics.stop.trim()) {
    if (!Number.isFinite(Number(basics.stop))) throw failed('stop.at_most', 'A number is expected.');
    body.stop = { metric: 'eval/mean_aoi', at_most: Number(basics.stop) };
  }
  if (basics.kind === 'sweep') body.sweep = { grid: grid(basics.grid, failed), ...(basics.repeats ? { seeds: Number(basics.repeats) } : {}) };
  for (const section of evaluates ? ['environment'] : ['environment', 'training']) {
    if (source?.[section]) body[section] = { ...source[section] };
  }
  for (const [path, schema] of all) {
    if (!(path in values) || (evaluates && !path.startsWith('environment.'))) continue;
    const [section, name] = path.split('.');
    try {
      body[section] = { ...body[section], [name]: parse(values[path].trim(), schema) };
    } catch (problem) {
      throw failed(path, `${path}: ${problem.message}`);
    }
  }
  if (evaluates) return [body];
  let list;
  try {
    list = seeds(basics.seeds);
  } catch (problem) {
    throw failed('seed', problem.message);
  }
  return list.map((seed) => ({ ...body, seed }));
}
