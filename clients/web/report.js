// Results of jobs that are not curves: the report of an evaluation, and the jobs of a sweep.

import { html } from './htm-preact-3.1.1.js';
import { all, get } from './api.js';
import { Curves } from './curves.js';
import { number, short } from './format.js';
import { share } from './jobs.js';
import { algorithmColour } from './palette.js';
import { link } from './route.js';
import { Bar, Card, Empty, Loaded, State, useLoad } from './ui.js';

const COLUMNS = [['p95_aoi', 'p95'], ['peak_aoi', 'Peak'], ['coverage', 'Coverage'], ['fairness', 'Fairness']];
const shown = (name, value) => (name === 'coverage' ? `${(100 * value).toFixed(1)} %` : number(value, 3));
const interval = (of) => `${number(of.low, 3)} to ${number(of.high, 3)}`;

/** The report of an evaluation: means with their 95 % intervals over layouts, and differences on the same layouts. */
export function Evaluation({ job }) {
  const done = job.state === 'succeeded';
  const report = useLoad((signal) => (done ? get(`/v1/jobs/${job.id}/result`, signal) : null), [job.id, done], 0);
  if (!done) return html`<${Card}><${Empty} title=${job.state === 'failed' ? 'The evaluation failed.' : 'The evaluation has not ended.'}><p>Its report appears here when it has succeeded.</p><//><//>`;
  return html`<${Loaded} of=${report} what="the report">${(r) => {
    if (r.sizes) return html`<${Plan} of=${r} />`;
    const policies = [...r.policies].sort((a, b) => a.summary.mean_aoi.mean - b.summary.mean_aoi.mean);
    const end = Math.max(...policies.map((p) => p.summary.mean_aoi.high));
    return html`<${Card} title="Mean AoI (slots; lower is better)">
        <div class="scroll"><table class="report"><thead><tr><th scope="col">Policy</th><th scope="col" class="wide">Mean with 95 % interval over layouts</th><th scope="col" class="number">Mean</th>${COLUMNS.map(([, text]) => html`<th scope="col" class="number">${text}</th>`)}</tr></thead>
        <tbody>${policies.map(({ policy, summary }) => html`<tr><th scope="row"><a href=${link(['player'], { policy })}>${policy}</a></th><td><${IntervalBar} of=${summary.mean_aoi} end=${end} colour=${algorithmColour(policy.split(/[:@]/)[0])} /></td>
          <td class="number"><strong>${number(summary.mean_aoi.mean)}</strong></td>${COLUMNS.map(([name]) => html`<td class="number">${shown(name, summary.mean[name])}</td>`)}</tr>`)}</tbody></table></div>
        <p class="hint">${r.episodes} layouts of ${r.layouts}: ${r.environment.uavs} UAVs, ${r.environment.users} users, ${r.environment.slots} slots.</p><//>
      ${r.differences.length > 0 && html`<${Card} title="Differences on the same layouts"><div class="scroll"><table><thead><tr><th scope="col">Policies</th><th scope="col" class="number">Difference of mean AoI</th><th scope="col" class="number">95 % interval</th><th scope="col" class="number">First is better</th></tr></thead>
        <tbody>${r.differences.map(({ first, second, difference: d }) => html`<tr><td>${first} minus ${second}</td><td class="number">${d.mean_aoi.mean > 0 ? '+' : ''}${number(d.mean_aoi.mean, 3)}</td><td class="number">${interval(d.mean_aoi)}</td><td class="number">${(100 * d.wins).toFixed(0)} %</td></tr>`)}</tbody></table></div><//>`}`;
  }}<//>`;
}

/** How many UAVs a policy needs: the fleets that were tried, and what the loss of a UAV changes. */
function Plan({ of: r }) {
  const end = Math.max(...[...r.sizes, ...r.failures.flatMap((failure) => failure.sizes)].map((size) => size.p95_aoi.high));
  const colour = algorithmColour(r.policy.split(/[:@]/)[0]);
  const row = (name, size) => html`<tr><th scope="row">${name}</th><td><${IntervalBar} of=${size.p95_aoi} end=${end} colour=${colour} /></td>
    <td class="number"><strong>${number(size.p95_aoi.mean)}</strong></td><td class="number">${number(size.mean_aoi.mean)}</td></tr>`;
  const table = (first, rows) => html`<div class="scroll"><table class="report"><thead><tr><th scope="col">${first}</th><th scope="col" class="wide">p95 AoI with 95 % interval over layouts</th><th scope="col" class="number">p95</th><th scope="col" class="number">Mean AoI</th></tr></thead><tbody>${rows}</tbody></table></div>`;
  return html`<${Card} title=${r.uavs ? `${r.uavs} UAVs keep p95 AoI at ${number(r.target_p95)}` : `No fleet keeps p95 AoI at ${number(r.target_p95)}`}>
      ${table('UAVs', r.sizes.map((size) => row(size.uavs, size)))}
      <p class="hint">${r.policy}, ${r.users} users, ${r.episodes} layouts of ${r.layouts}.${r.uavs ? ` 95 % interval: ${r.interval.map((n) => n ?? 'more').join(' to ')} UAVs.` : ''}</p><//>
    ${r.failures.length > 0 && html`<${Card} title="A UAV is lost">${table('Fleet and slot', r.failures.flatMap((failure) => failure.sizes.map((size) => row(`${size.uavs} UAVs, slot ${failure.slot}`, size))))}<//>`}`;
}

function IntervalBar({ of, end, colour }) {
  const at = (value) => (100 * Math.max(value, 0)) / (end || 1);
  return html`<svg class="interval" viewBox="0 0 100 10" preserveAspectRatio="none" role="img" aria-label=${`${number(of.mean)}, interval ${interval(of)}`}>
    <rect x="0" y="1" width=${at(of.mean)} height="8" fill=${colour} opacity="0.75" /><line x1=${at(of.low)} x2=${at(of.high)} y1="5" y2="5" class="whisker" /></svg>`;
}

/** The jobs of a sweep or an experiment: compared, and as a list. */
export function SweepJobs({ id, options, ended }) {
  const list = useLoad((signal) => all(`/v1/jobs?parent=${id}&page_size=500`, 'jobs', 500, signal), [id, ended], ended ? 0 : 3);
  return html`<${Loaded} of=${list} what="the jobs of this job">${(jobs) => (jobs.length ? html`<${Curves} jobs=${jobs.filter((job) => job.progress.step > 0)} options=${options} first="parallel" />
      <${Card} title=${`${jobs.length} jobs`}><div class="scroll"><table class="stack"><thead><tr><th scope="col">Job</th><th scope="col">State</th><th scope="col">Progress</th></tr></thead>
        <tbody>${jobs.map((job) => html`<tr key=${job.id}><td><a href=${link(['jobs', job.id])}>${job.name ?? job.id.slice(-6)}</a> <span class="faint small">seed ${job.seed}</span></td><td><${State} state=${job.state} wanted=${job.wanted} /></td>
          <td class="progress"><${Bar} value=${share(job)} label="Progress" /><span class="faint small">${short(job.progress.step)} of ${short(job.progress.steps)} steps</span></td></tr>`)}</tbody></table></div><//>`
    : html`<${Card}><${Empty} title="It has made no job yet." /><//>`)}<//>`;
}
