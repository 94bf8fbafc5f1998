// Policies, their versions and aliases.

import { html, useState } from './htm-preact-3.1.1.js';
import { all, download, get, post, put, remove } from './api.js';
import { ago, clock, flatten, number, setting, short } from './format.js';
import { algorithmColour } from './palette.js';
import { link } from './route.js';
import { Action, ask, Card, Choice, Empty, Field, Loaded, run, Tabs, Title, useLoad } from './ui.js';

const isBaseline = (policy) => policy.kind === 'POLICY_KIND_BASELINE';
const algorithm = (policy) => (isBaseline(policy) ? policy.ref.name : policy.config?.algorithm);
const NEEDS = { NEEDS_DETECTIONS: 'detections only', NEEDS_OWN_POSITIONS: "each UAV's position", NEEDS_FULL_SCENE: 'the full scene' };
const metric = (policy, name) => policy.metrics?.[name] ?? policy.metrics?.[`eval/${name}`];
const percent = (value) => (value == null ? '–' : `${(100 * value).toFixed(1)} %`);

const Swatch = ({ policy }) => html`<span class="swatch" style=${{ background: algorithmColour(algorithm(policy)) }}></span>`;

export function PoliciesPage() {
  const list = useLoad((signal) => all('/v1/policies?page_size=500', 'policies', 2000, signal), [], 5);
  return html`<${Title} text="Policies" />
    <${Loaded} of=${list} what="the policies">${(policies) => {
      const learned = policies.filter((p) => !isBaseline(p));
      const rules = policies.filter(isBaseline);
      return html`
        <${Card} title="Learned">${learned.length ? html`<div class="scroll"><table class="stack"><thead><tr><th scope="col">Policy</th><th scope="col">Aliases</th><th scope="col" class="number">Newest</th><th scope="col" class="number">Mean AoI</th><th scope="col" class="number">Coverage</th><th scope="col">Trained for</th><th scope="col"><span class="hidden">Commands</span></th></tr></thead>
          <tbody>${learned.map((p) => html`<tr><td><${Swatch} policy=${p} /> <a class="strong" href=${link(['policies', p.ref.name])}>${p.ref.name}</a><div class="faint small">${p.description}</div></td>
            <td>${p.aliases.map((a) => html`<span class="label">@${a}</span>`)}</td>
            <td class="number" data-name="Newest version">${p.ref.version}${p.loaded ? '' : ' (unloaded)'}</td><td class="number" data-name="Mean AoI">${number(metric(p, 'mean_aoi'))}</td><td class="number" data-name="Coverage">${percent(metric(p, 'coverage'))}</td>
            <td>${p.config?.environment ? html`<span class="nowrap">${p.config.environment.uavs} UAVs, ${p.config.environment.users} users</span>` : '–'}</td>
            <td class="row-actions"><a class="button small" href=${link(['player'], { policy: p.ref.name })} aria-label=${`Fly ${p.ref.name}`}>Fly</a></td></tr>`)}</tbody></table></div>`
          : html`<${Empty} title="No learned policy."><p><a class="button primary" href="#/submit">Train one</a></p><p class="hint">Or upload a checkpoint: <code>qedgix policies upload my-policy policy.safetensors</code></p><//>`}<//>
        <${Card} title="Rules">
          <p class="hint">Baselines follow fixed rules and need no training.</p>
          <div class="scroll"><table class="stack"><thead><tr><th scope="col">Policy</th><th scope="col">Rule</th><th scope="col">Needs</th><th scope="col"><span class="hidden">Commands</span></th></tr></thead>
          <tbody>${rules.map((p) => html`<tr><td class="nowrap"><${Swatch} policy=${p} /> <a class="strong" href=${link(['policies', p.ref.name])}>${p.ref.name}</a></td><td>${p.description}</td><td class="nowrap faint">${NEEDS[p.needs] ?? p.needs}</td>
            <td class="row-actions"><a class="button small" href=${link(['player'], { policy: p.ref.name })} aria-label=${`Fly ${p.ref.name}`}>Fly</a></td></tr>`)}</tbody></table></div><//>`;
    }}<//>`;
}

const VIEWS = [['versions', 'Versions'], ['history', 'History of aliases'], ['configuration', 'Configuration']];
/** Versions whose figures are loaded, newest first. */
const FIGURES = 20;

async function loadPolicy(name, signal) {
  const newest = await get(`/v1/policies/${encodeURIComponent(name)}`, signal);
  if (isBaseline(newest)) return { newest, versions: [], aliases: [] };
  const path = `/v1/policies/${encodeURIComponent(name)}`;
  const [versions, aliases] = await Promise.all([all(`${path}/versions?page_size=100`, 'versions', 500, signal), all(`${path}/aliases?page_size=500`, 'aliases', 500, signal)]);
  const details = await Promise.all(versions.slice(0, FIGURES).map((v) => (v.ref.version === newest.ref.version ? newest : get(`${path}:${v.ref.version}`, signal).catch(() => null))));
  return { newest, aliases, versions: versions.map((v, i) => ({ ...v, ...(details[i] ?? {}), aliases: v.aliases, loaded: v.loaded })) };
}

export function PolicyPage({ name, options }) {
  const policy = useLoad((signal) => loadPolicy(name, signal), [name], 10);
  const view = VIEWS.some(([id]) => id === options.get('tab')) ? options.get('tab') : 'versions';
  return html`<p class="crumbs"><a href="#/policies">Policies</a></p>
    <${Title} text=${name} actions=${html`<a class="button primary" href=${link(['player'], { policy: name })}>Fly it</a>`} />
    <${Loaded} of=${policy} what="the policy">${({ newest, versions, aliases }) => (isBaseline(newest) ? html`<${Card}><p><${Swatch} policy=${newest} /> ${newest.description}</p>
        <dl class="facts"><dt>Needs</dt><dd>${NEEDS[newest.needs]}</dd><dt>Headings</dt><dd>${newest.headings}</dd></dl><//>`
      : html`<${Aliases} name=${name} aliases=${aliases} versions=${versions} reload=${policy.reload} />
        <${Tabs} parts=${['policies', name]} views=${VIEWS} current=${view} />
        ${view === 'versions' && html`<${Versions} name=${name} versions=${versions} reload=${policy.reload} />`}
        ${view === 'history' && html`<${History} name=${name} reload=${policy.reload} key=${JSON.stringify(aliases)} />`}
        ${view === 'configuration' && html`<${Configuration} policy=${newest} />`}`)}<//>`;
}

/** Moves an alias after a question, only if nobody else has moved it meanwhile. */
async function promote(name, alias, version, from) {
  const text = from ? `Requests for ${name}@${alias} go to version ${from} now and to version ${version} from then on. Open sessions keep their version.`
    : `Requests for ${name}@${alias} will go to version ${version}.`;
  if (!(await ask(`Point ${alias} to version ${version}?`, text, from ? `Move ${alias}` : `Create ${alias}`, false))) return;
  await run(() => put(`/v1/policies/${name}/aliases/${encodeURIComponent(alias)}`, { version, expected: from ?? 0 }), `${name}@${alias} is version ${version}.`);
}

function Aliases({ name, aliases, versions, reload }) {
  const [alias, setAlias] = useState(aliases[0]?.alias ?? 'live');
  const [version, setVersion] = useState(String(versions[0]?.ref.version ?? 1));
  const from = aliases.find((a) => a.alias === alias)?.version;
  const drop = async (a) => {
    if (await ask(`Delete the alias ${a.alias}?`, `Requests for ${name}@${a.alias} will fail.`, 'Delete the alias')) {
      await run(() => remove(`/v1/policies/${name}/aliases/${encodeURIComponent(a.alias)}?expected=${a.version}`), `The alias ${a.alias} is deleted.`);
      reload();
    }
  };
  return html`<${Card} title="Aliases">
    ${aliases.length ? html`<p>${aliases.map((a) => html`<span class="alias"><strong>@${a.alias}</strong> → version ${a.version} <${Action} class="small" command=${() => drop(a)} aria-label=${`Delete the alias ${a.alias}`}>Delete<//></span>`)}</p>`
    : html`<p class="faint">No alias yet. An alias is a movable name such as <code>live</code>: callers that use <code>${name}@live</code> follow it.</p>`}
    <form class="controls" onSubmit=${(e) => e.preventDefault()}>
      <${Field} label="Alias"><input value=${alias} list="aliases" required pattern="[A-Za-z0-9_\\-][A-Za-z0-9._\\-]*" maxlength="64" onInput=${(e) => setAlias(e.target.value)} /><//>
      <datalist id="aliases">${aliases.map((a) => html`<option value=${a.alias} />`)}</datalist>
      <${Field} label="Version"><${Choice} value=${version} options=${versions.map((v) => [String(v.ref.version), `${v.ref.version}${metric(v, 'mean_aoi') != null ? `: mean AoI ${number(metric(v, 'mean_aoi'))}` : ''}`])} onChange=${setVersion} /><//>
      <${Action} class="primary" disabled=${!alias || from === Number(version)} command=${() => promote(name, alias, Number(version), from).then(reload)}>${from ? 'Promote' : 'Create alias'}<//>
    </form><//>`;
}

function Versions({ name, versions, reload }) {
  const path = (v) => `/v1/policies/${name}:${v.ref.version}`;
  const best = Math.min(...versions.map((v) => metric(v, 'mean_aoi') ?? Infinity));
  const load = (v) => run(() => post(`${path(v)}/${v.loaded ? 'unload' : 'load'}`), `Version ${v.ref.version} is ${v.loaded ? 'unloaded' : 'loaded'}.`).then(reload);
  const drop = async (v) => {
    if (await ask(`Delete ${name}:${v.ref.version}?`, 'The version cannot be restored. It is refused while an alias or a session uses it.', 'Delete the version')) {
      await run(() => remove(`/v1/policies/${name}/versions/${v.ref.version}`), `Version ${v.ref.version} is deleted.`);
      reload();
    }
  };
  return html`<${Card}><div class="scroll"><table class="stack"><thead><tr><th scope="col">Version</th><th scope="col" class="number">Mean AoI</th><th scope="col" class="number">p95</th><th scope="col" class="number">Peak</th><th scope="col" class="number">Coverage</th><th scope="col" class="number">Fairness</th><th scope="col" class="number">Step</th><th scope="col">Published</th><th scope="col"><span class="hidden">Commands</span></th></tr></thead>
    <tbody>${versions.map((v) => {
      const aoi = metric(v, 'mean_aoi');
      return html`<tr><td><strong>${v.ref.version}</strong> ${v.aliases.map((a) => html`<span class="label">@${a}</span>`)}${!v.loaded && html`<span class="label">unloaded</span>`}<div class="faint small"><code>${v.ref.digest.slice(0, 12)}</code></div></td>
        <td class="number" data-name="Mean AoI">${number(aoi)}${aoi === best && versions.length > 1 ? html`<div class="small good">best</div>` : ''}</td><td class="number" data-name="p95">${number(metric(v, 'p95_aoi'))}</td><td class="number" data-name="Peak">${number(metric(v, 'peak_aoi'))}</td><td class="number" data-name="Coverage">${percent(metric(v, 'coverage'))}</td><td class="number" data-name="Fairness">${number(metric(v, 'fairness'), 3)}</td><td class="number" data-name="Step">${v.metrics?.step ? short(v.metrics.step) : '–'}</td>
        <td class="nowrap" title=${clock(v.created_at)}>${v.created_at ? ago(v.created_at) : ''}</td>
        <td class="row-actions"><a class="button small" href=${link(['player'], { policy: `${name}:${v.ref.version}` })} aria-label=${`Fly version ${v.ref.version}`}>Fly</a><${Action} class="small" command=${() => run(() => download(`${path(v)}/export`, `${name}-${v.ref.version}.safetensors`))}>Save<//><${Action} class="small" command=${() => load(v)}>${v.loaded ? 'Unload' : 'Load'}<//><${Action} class="small" command=${() => drop(v)}>Delete<//></td></tr>`;
    })}</tbody></table></div>
    <p class="hint">Figures of the evaluation at which the checkpoint was taken. Mean AoI in slots; lower is better.</p><//>`;
}

function History({ name, reload }) {
  const history = useLoad((signal) => all(`/v1/policies/${name}/history?page_size=200`, 'history', 1000, signal), [name], 0);
  const back = (move) => promote(name, move.alias, move.previous, move.version).then(() => {
    history.reload();
    reload();
  });
  return html`<${Loaded} of=${history} what="the history">${(moves) => {
    const newest = new Set();
    return moves.length ? html`<${Card}><table class="stack"><thead><tr><th scope="col">Time</th><th scope="col">Alias</th><th scope="col">Change</th><th scope="col">By</th><th scope="col"><span class="hidden">Commands</span></th></tr></thead>
      <tbody>${moves.map((m) => {
        const current = !newest.has(m.alias) && newest.add(m.alias);
        return html`<tr><td>${clock(m.at)}</td><td>@${m.alias}</td><td>${m.version == null ? `deleted (was version ${m.previous})` : m.previous == null ? `created: version ${m.version}` : `version ${m.previous} → ${m.version}`}</td><td class="named" data-name="By">${m.by ?? '–'}</td>
          <td class="row-actions">${current && m.previous && m.version ? html`<${Action} class="small" command=${() => back(m)}>Back to ${m.previous}<//>` : ''}</td></tr>`;
      })}</tbody></table><//>` : html`<${Empty} title="No alias has been moved yet."><p>Every change of an alias is listed here, with the key that made it.</p><//>`;
  }}<//>`;
}

function Configuration({ policy }) {
  return html`<div class="grid">${[['Environment', policy.config?.environment], ['Training', policy.config?.training]].map(([name, values]) => html`<${Card} title=${name}><table class="settings"><tbody>${flatten(values ?? {}).map(([path, value]) => html`<tr><th scope="row">${path}</th><td class="number"><code>${setting(value)}</code></td></tr>`)}</tbody></table><//>`)}</div>`;
}
