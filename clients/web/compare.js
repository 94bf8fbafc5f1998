// Selected jobs side by side: a table of what differs with the results, and parallel coordinates.

import { html, useState } from './htm-preact-3.1.1.js';
import { metricName, number, short } from './format.js';
import { link, setOptions } from './route.js';
import { aoiColour } from './scene.js';
import { Empty } from './ui.js';

/** Metrics of which the largest value is the best. */
const LARGEST = new Set(['eval/coverage', 'eval/fairness', 'q_tot', 'env_steps_per_s']);

/** The jobs with their values of the differing fields, and the best and the last value of the metric. */
export function results(jobs, fields, rows, metric) {
  return jobs.map((job) => {
    const y = rows(job.id).y.filter((value) => value != null);
    const best = y.length ? y.reduce((a, b) => ((LARGEST.has(metric) ? b > a : b < a) ? b : a)) : null;
    return { job, values: new Map(fields.differing.map((name) => [name, fields.byJob.get(job.id)?.get(name) ?? '–'])), best, last: y.at(-1) ?? null };
  });
}

const numeric = (text) => (/^-?[\d.]+(e-?\d+)?$/.test(text) ? Number(text) : null);

export function Table({ all, fields, metric, options }) {
  const by = options.get('sort') ?? 'best';
  const down = by.startsWith('-');
  const key = (result) => {
    const name = by.replace(/^-/, '');
    const value = name === 'best' || name === 'last' ? result[name] : result.values.get(name);
    return value == null ? null : typeof value === 'number' ? value : numeric(value) ?? value;
  };
  const sorted = [...all].sort((a, b) => {
    const [x, y] = [key(a), key(b)];
    if (x == null || y == null) return (x == null) - (y == null);
    return (x < y ? -1 : x > y ? 1 : 0) * (down ? -1 : 1);
  });
  const head = (name, text) => html`<th scope="col" class=${name === 'best' || name === 'last' ? 'number' : ''} aria-sort=${by === name ? 'ascending' : by === `-${name}` ? 'descending' : 'none'}>
    <button type="button" class="head" onClick=${() => setOptions({ sort: by === name ? `-${name}` : name })}>${text}${by === name ? ' ↑' : by === `-${name}` ? ' ↓' : ''}</button></th>`;
  return html`<div class="scroll"><table class="results"><thead><tr><th scope="col">Job</th>${fields.differing.map((name) => head(name, name))}${head('best', 'Best')}${head('last', 'Last')}</tr></thead>
    <tbody>${sorted.map(({ job, values, best, last }) => html`<tr key=${job.id}><td><a href=${link(['jobs', job.id])}>${job.name ?? job.id.slice(-6)}</a></td>${fields.differing.map((name) => html`<td>${values.get(name)}</td>`)}<td class="number strong">${number(best)}</td><td class="number">${number(last)}</td></tr>`)}</tbody></table></div>
    <p class="hint">${metricName(metric)}. Columns: what differs among the selected jobs.</p>`;
}

const [WIDTH, HEIGHT, TOP, BOTTOM, SIDE] = [1120, 340, 44, 18, 70];
/** Axes that fit beside each other. */
const MOST_AXES = 9;

/** An axis: the place (0 to 1) of every value, and its marks. */
function axis(name, texts) {
  const distinct = [...new Set(texts)];
  const numbers = distinct.map((text) => (typeof text === 'number' ? text : numeric(String(text))));
  if (numbers.every((value) => value != null)) {
    const [low, high] = [Math.min(...numbers), Math.max(...numbers)];
    const log = low > 0 && high / low > 30;
    const scale = (value) => (low === high ? 0.5 : log ? Math.log(value / low) / Math.log(high / low) : (value - low) / (high - low));
    const marks = numbers.length <= 6 ? numbers : [0, 0.25, 0.5, 0.75, 1].map((s) => (log ? low * (high / low) ** s : low + s * (high - low)));
    const places = marks.map((value) => [scale(value), Math.abs(value) >= 1e4 ? short(value) : String(Number(value.toPrecision(3)))]).sort((a, b) => a[0] - b[0]);
    return { name, place: (text) => scale(Number(text)), marks: places.filter(([place], i) => i === 0 || place - places[i - 1][0] > 0.05) };
  }
  const sorted = distinct.map(String).sort();
  const scale = (text) => (sorted.length === 1 ? 0.5 : sorted.indexOf(String(text)) / (sorted.length - 1));
  return { name, place: scale, marks: sorted.slice(0, 14).map((text) => [scale(text), text.length > 16 ? `${text.slice(0, 15)}…` : text]) };
}

export function Parallel({ all, fields, metric }) {
  const [focus, setFocus] = useState(null);
  const done = all.filter((result) => result.best != null);
  const names = fields.differing.filter((name) => name !== 'name' || fields.differing.length === 1).slice(0, MOST_AXES);
  if (!done.length || !names.length) return html`<${Empty} title="Nothing to compare."><p>Select at least two jobs that differ in their configuration and have rows of this metric.</p><//>`;
  const axes = [...names.map((name) => axis(name, done.map((r) => r.values.get(name)))), axis(`best ${metric}`, done.map((r) => r.best))];
  const x = (i) => SIDE + (i * (WIDTH - 2 * SIDE)) / (axes.length - 1);
  const y = (place) => TOP + (1 - place) * (HEIGHT - TOP - BOTTOM);
  const result = axes.at(-1);
  const line = (r) => axes.map((a, i) => `${x(i).toFixed(1)},${y(a.place(i < names.length ? r.values.get(a.name) : r.best)).toFixed(1)}`).join(' ');
  const text = (r) => `${r.job.name ?? r.job.id.slice(-6)}: ${names.map((name) => `${name.split('.').at(-1)} ${r.values.get(name)}`).join(', ')}; best ${number(r.best)}`;
  const good = (r) => (LARGEST.has(metric) ? 1 - result.place(r.best) : result.place(r.best));
  return html`<div class="scroll"><svg class="parallel" viewBox=${`0 0 ${WIDTH} ${HEIGHT}`} role="img" aria-label=${`Parallel coordinates of ${done.length} jobs. The table has the same values.`}>
      ${done.map((r) => html`<polyline key=${r.job.id} points=${line(r)} fill="none" stroke=${aoiColour(good(r), 1)} stroke-width=${focus === r.job.id ? 5 : 2} opacity=${focus && focus !== r.job.id ? 0.25 : 0.9}
        onMouseEnter=${() => setFocus(r.job.id)} onMouseLeave=${() => setFocus(null)} onClick=${() => { location.hash = link(['jobs', r.job.id]); }}><title>${text(r)}</title></polyline>`)}
      ${axes.map((a, i) => html`<g key=${a.name}><line x1=${x(i)} x2=${x(i)} y1=${TOP} y2=${HEIGHT - BOTTOM} class="axis" /><text x=${x(i)} y=${TOP - 18} class="axis-name">${a.name.replace(/^(training|environment|labels)\./, '')}</text>
        ${a.marks.map(([place, mark]) => html`<text x=${x(i) + (i === axes.length - 1 ? 8 : -8)} y=${y(place) + 4} class="mark" text-anchor=${i === axes.length - 1 ? 'start' : 'end'}>${mark}</text>`)}</g>`)}
    </svg></div><p class="hint" role="status">${focus ? text(done.find((r) => r.job.id === focus)) : 'One line per job, dark blue: best, yellow: worst. Point at a line to read its values.'}</p>`;
}
