// Curves: a plot by uPlot, smoothing, and the mean and band of several curves.

import uPlot from './uplot-1.6.32.js';
import { html, useEffect, useRef } from './htm-preact-3.1.1.js';
import { number, short } from './format.js';
import { faded, isDark } from './palette.js';

/**
 * Curves over common axes. A curve is `{label, x, y, colour, dash}` and optionally `low` and `high`, its band. The plot follows its
 * data without being made again. `share`: whether values are shares, from 0 to 1. `playhead`: where to draw a vertical line.
 */
export function Chart({ curves, label, height = 320, x: xName = 'environment steps', share = false, playhead = null }) {
  const place = useRef(null);
  const plot = useRef(null);
  const head = useRef(null);
  const dark = isDark();
  const shape = JSON.stringify([curves.map((c) => [c.label, c.colour, c.dash, !!c.low]), height, dark, label, share]);
  const data = joined(curves);
  useEffect(() => {
    const width = () => Math.max(place.current.clientWidth, 200);
    plot.current = new uPlot(options(curves, { label, height, width: width(), xName, share, head }), data, place.current);
    const observer = new ResizeObserver(() => plot.current?.setSize({ width: width(), height }));
    observer.observe(place.current);
    return () => {
      observer.disconnect();
      plot.current.destroy();
      plot.current = null;
    };
  }, [shape]);
  const points = curves.reduce((sum, c) => sum + c.x.length, 0);
  useEffect(() => {
    if (plot.current) plot.current.setData(data);
  }, [data]);
  useEffect(() => {
    head.current = playhead;
    plot.current?.redraw(false);
  }, [playhead]);
  const last = curves.map((c) => `${c.label}: ${number(c.y.at(-1))}`).slice(0, 8).join('; ');
  return html`<div class="chart" ref=${place} role="group" aria-label=${`${label}. Last values: ${last || 'none'}`} data-points=${points}></div>`;
}

function joined(curves) {
  if (!curves.length) return [[], []];
  const tables = curves.map((c) => (c.low ? [c.x, c.y, c.low, c.high] : [c.x, c.y]));
  return uPlot.join(tables);
}

function options(curves, { label, height, width, xName, share, head }) {
  const style = getComputedStyle(document.documentElement);
  const [ink, grid] = ['--faint', '--line'].map((name) => style.getPropertyValue(name).trim());
  const font = '12px system-ui, sans-serif';
  const series = [{ label: 'step', value: (_, v) => (v == null ? '' : number(v, 7)) }];
  const bands = [];
  const few = curves.every((c) => c.x.length < 60);
  for (const c of curves) {
    series.push({
      label: c.label, stroke: c.colour, width: 2, dash: c.dash, spanGaps: true, points: { show: few, size: 5, fill: c.colour },
      value: (u, v, s, i) => (v == null ? '' : number(v)),
    });
    if (c.low) {
      const [low, high] = [series.length, series.length + 1];
      const hidden = { stroke: 'transparent', width: 0, spanGaps: true, points: { show: false }, class: 'band-of-curve' };
      series.push({ ...hidden, label: `${c.label} low` }, { ...hidden, label: `${c.label} high` });
      bands.push({ series: [high, low], fill: faded(c.colour, 0.17) });
    }
  }
  const axis = { stroke: ink, font, labelFont: font, labelSize: 18, grid: { stroke: grid, width: 1 }, ticks: { stroke: grid, width: 1, size: 4 } };
  return {
    width, height, series, bands,
    scales: { x: { time: false }, y: share ? { range: shares } : {} },
    axes: [
      { ...axis, label: xName, values: (_, all) => all.map((v) => short(v)), size: 34 },
      { ...axis, label: label, size: 58, values: (_, all, i, space, step) => all.map((v) => (v == null ? null : step >= 1000 ? short(v) : v.toFixed(places(step)))) },
    ],
    cursor: { y: false, focus: { prox: 24 }, drag: { x: true, y: false } },
    focus: { alpha: 0.35 },
    legend: { live: true, markers: { width: 0, fill: (u, i) => swatch(series[i]) } },
    hooks: {
      draw: [(u) => drawHead(u, head.current, ink)],
      setScale: [(u, key) => { if (key === 'y') u.root.dataset.top = u.scales.y.max; }],
    },
  };
}

/** The axis of shares: it ends at 1, also where a curve lies on 1. */
function shares(u, least, most) {
  if (least == null) return [0, 1];
  const [low, high] = uPlot.rangeNum(least, most, 0.1, true);
  return [Math.max(low, 0), Math.min(high, 1)];
}

/** The background that shows colour and dash of a curve in the legend. */
function swatch({ stroke, dash }) {
  if (!dash?.length) return stroke;
  let at = 0;
  const parts = dash.map((length, i) => `${i % 2 ? 'transparent' : stroke} ${at}px ${at += length}px`);
  return `repeating-linear-gradient(90deg, ${parts.join(', ')})`;
}

/** Decimal places of marks that are `step` apart: 2 for 0.25. At most 9. */
export function places(step) {
  const rounded = (n) => Math.abs(step * 10 ** n - Math.round(step * 10 ** n)) < step * 10 ** n * 1e-6;
  let n = 0;
  while (n < 9 && !rounded(n)) n += 1;
  return n;
}

function drawHead(u, x, ink) {
  if (x == null) return;
  const at = Math.round(u.valToPos(x, 'x', true));
  u.ctx.save();
  u.ctx.strokeStyle = ink;
  u.ctx.lineWidth = 2;
  u.ctx.beginPath();
  u.ctx.moveTo(at, u.bbox.top);
  u.ctx.lineTo(at, u.bbox.top + u.bbox.height);
  u.ctx.stroke();
  u.ctx.restore();
}

/** The values smoothed by an exponential mean with this weight (0: not at all), without the bias of its beginning. */
export function smooth(values, weight) {
  if (!weight) return values;
  let sum = 0;
  let share = 0;
  return values.map((value) => {
    if (value == null) return null;
    sum = weight * sum + (1 - weight) * value;
    share = weight * share + (1 - weight);
    return sum / share;
  });
}

/** Value of a curve at `x`, between its points; null outside of them. */
function at(curve, x, from) {
  let i = from;
  while (i < curve.x.length && curve.x[i] < x) i += 1;
  if (i === curve.x.length) return [null, i];
  if (curve.x[i] === x) return [curve.y[i], i];
  if (i === 0) return [null, 0];
  const share = (x - curve.x[i - 1]) / (curve.x[i] - curve.x[i - 1]);
  return [curve.y[i - 1] + share * (curve.y[i] - curve.y[i - 1]), i];
}

/** Most places at which a mean is computed. */
const PLACES = 600;

/** The mean of curves, with a band of one standard deviation at both sides, where at least two curves exist. */
export function mean(curves) {
  const known = curves.filter((c) => c.x.length);
  let xs = [...new Set(known.flatMap((c) => c.x))].sort((a, b) => a - b);
  if (xs.length > PLACES) xs = xs.filter((_, i) => i % Math.ceil(xs.length / PLACES) === 0 || i === xs.length - 1);
  const result = { x: [], y: [], low: [], high: [] };
  const places = known.map(() => 0);
  for (const x of xs) {
    const values = [];
    known.forEach((curve, k) => {
      const [value, i] = at(curve, x, places[k]);
      places[k] = Math.max(i - 1, 0);
      if (value != null) values.push(value);
    });
    // Where some curves have ended already, the mean would jump.
    if (!values.length || values.length < Math.min(known.length, 2)) continue;
    const m = values.reduce((a, b) => a + b, 0) / values.length;
    const deviation = values.length > 1 ? Math.sqrt(values.reduce((a, v) => a + (v - m) ** 2, 0) / (values.length - 1)) : 0;
    result.x.push(x);
    result.y.push(m);
    result.low.push(m - deviation);
    result.high.push(m + deviation);
  }
  if (known.length < 2) {
    delete result.low;
    delete result.high;
  }
  return result;
}
