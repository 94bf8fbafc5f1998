// Numbers, times and states as text.

/** A number with about `digits` significant digits. */
export function number(value, digits = 4) {
  if (value == null || Number.isNaN(value)) return '–';
  if (!Number.isFinite(value)) return String(value);
  if (Number.isInteger(value) && Math.abs(value) < 1e15) return group(value);
  const size = Math.abs(value);
  if (size !== 0 && (size < 1e-4 || size >= 1e7)) return value.toExponential(Math.max(digits - 2, 1));
  const places = Math.max(0, digits - 1 - Math.floor(Math.log10(size || 1)));
  return size >= 10_000 ? group(Math.round(value)) : value.toFixed(Math.min(places, 6));
}

const group = (value) => String(value).replace(/\B(?=(\d{3})+(?!\d))/g, '\u202f');

/** A count in short form: 1.2 M. */
export function short(value) {
  for (const [size, unit] of [[1e12, 'T'], [1e9, 'G'], [1e6, 'M'], [1e3, 'k']]) {
    if (Math.abs(value) >= size) return `${(value / size).toPrecision(3).replace(/(\.\d*?)0+$/, '$1').replace(/\.$/, '')}\u202f${unit}`;
  }
  return String(Math.round(value * 100) / 100);
}

export function bytes(value) {
  if (value < 1024) return `${value} B`;
  const units = ['KiB', 'MiB', 'GiB', 'TiB'];
  let i = -1;
  do {
    value /= 1024;
    i += 1;
  } while (value >= 1024 && i < units.length - 1);
  return `${value.toFixed(value < 10 ? 1 : 0)} ${units[i]}`;
}

/** Seconds as text: 2 h 5 min. */
export function duration(seconds) {
  if (seconds == null || !Number.isFinite(seconds)) return '–';
  const s = Math.max(0, Math.round(seconds));
  if (s < 60) return `${s} s`;
  if (s < 3600) return `${Math.floor(s / 60)} min ${s % 60} s`;
  if (s < 86_400) return `${Math.floor(s / 3600)} h ${Math.floor((s % 3600) / 60)} min`;
  return `${Math.floor(s / 86_400)} d ${Math.floor((s % 86_400) / 3600)} h`;
}

/** How long ago a time is. */
export function ago(time) {
  if (!time) return '–';
  const seconds = (Date.now() - new Date(time)) / 1000;
  return seconds < 5 ? 'just now' : `${duration(seconds).replace(/^(\d+ \w+) .*/, '$1')} ago`;
}

export const clock = (time) => (time ? new Date(time).toLocaleString() : '–');

/** A configured value as text. */
export const setting = (value) => (value == null ? 'none' : typeof value === 'object' ? JSON.stringify(value) : String(value));

/** The entries of nested objects, as [path, value]. */
export function flatten(object, prefix = '') {
  return Object.entries(object ?? {}).flatMap(([name, value]) => {
    const path = prefix ? `${prefix}.${name}` : name;
    return value && typeof value === 'object' && !Array.isArray(value) ? flatten(value, path) : [[path, value]];
  });
}

/** The metrics that jobs record, with what they say. */
export const METRICS = {
  'eval/mean_aoi': 'Mean AoI in evaluations (slots)',
  'eval/p95_aoi': '95th percentile of AoI in evaluations (slots)',
  'eval/peak_aoi': 'Peak AoI in evaluations (slots)',
  'eval/coverage': 'Coverage in evaluations (share of users)',
  'eval/fairness': 'Fairness in evaluations (Jain)',
  'train/mean_aoi': 'Mean AoI while training (slots)',
  loss: 'Loss',
  grad_norm: 'Norm of the gradient',
  q_tot: 'Q_tot',
  epsilon: 'Exploration rate',
  env_steps_per_s: 'Environment steps per second',
  'eval-v1/mean_aoi': 'Mean AoI on the layouts of eval-v1 (slots)',
};

/** Metrics whose values are shares, from 0 to 1. */
export const isShare = (name) => ['eval/coverage', 'eval/fairness'].includes(name);

export const metricName = (name) => METRICS[name] ?? name;
