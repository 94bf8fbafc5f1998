// Parts of pages that every page uses.

import { html, useEffect, useRef, useState } from './htm-preact-3.1.1.js';
import { link } from './route.js';

/**
 * Loads something now and then again every `seconds` while the page is visible (0: once), and whenever `deps` change. Keeps the last
 * value when a later load fails.
 */
export function useLoad(load, deps, seconds = 0) {
  const [state, set] = useState({ value: null, error: null, loading: true });
  const again = useRef(() => {});
  useEffect(() => {
    const abort = new AbortController();
    let timer;
    let busy = false;
    set((old) => ({ ...old, loading: true }));
    const run = async () => {
      clearTimeout(timer);
      if (busy || abort.signal.aborted) return;
      busy = true;
      try {
        if (!document.hidden) {
          const value = await load(abort.signal);
          if (!abort.signal.aborted) set({ value, error: null, loading: false });
        }
      } catch (error) {
        if (!abort.signal.aborted) set((old) => ({ ...old, error, loading: false }));
      }
      busy = false;
      if (seconds && !abort.signal.aborted) timer = setTimeout(run, seconds * 1000);
    };
    again.current = run;
    const shown = () => document.hidden || run();
    document.addEventListener('visibilitychange', shown);
    addEventListener('qedgix-key', run);
    run();
    return () => {
      abort.abort();
      clearTimeout(timer);
      document.removeEventListener('visibilitychange', shown);
      removeEventListener('qedgix-key', run);
    };
  }, deps);
  return { ...state, reload: () => again.current() };
}

/** What to do about an error, by its code. */
const ADVICE = {
  unreachable: 'Start the server again, or check the address. This page tries again by itself.',
  unauthenticated: 'Enter an API key with the button at the top. `qedgix keys create` makes one.',
  permission_denied: 'Use an API key that has this scope (`qedgix keys create --scopes ...`).',
  not_found: 'It may have been deleted, or it belongs to another API key.',
  draining: 'The server is stopping. Try again when it has restarted.',
  overloaded: 'The server is busy. Try again in a moment.',
  resource_exhausted: 'A limit is reached. Try again in a moment.',
  storage_full: 'Free space in the data directory of the server, then try again.',
};

export function ErrorBox({ error, retry }) {
  if (!error) return null;
  const advice = ADVICE[error.code];
  return html`<div class="notice error" role="alert">
    <div><strong>${error.message}</strong>
      ${error.code && html` <code>${error.code}</code>`}
      ${advice && html`<p>${advice}</p>`}</div>
    ${retry && html`<button type="button" onClick=${retry}>Try again</button>`}
  </div>`;
}

export function Empty({ title, children }) {
  return html`<div class="empty"><p class="empty-title">${title}</p>${children}</div>`;
}

export const Loading = ({ what }) => html`<p class="loading" role="status">Loading ${what}…</p>`;

/** A page of its own for what is loading, missing or failed; otherwise what `children` makes of the value. */
export function Loaded({ of, what, children }) {
  if (of.value == null) return of.error ? html`<${ErrorBox} error=${of.error} retry=${of.reload} />` : html`<${Loading} what=${what} />`;
  return html`${of.error && html`<${ErrorBox} error=${of.error} retry=${of.reload} />`}${children(of.value)}`;
}

let opened = false;

/** The title of a page, which receives the focus when the reader goes to the page, so that screen readers begin there. */
export function Title({ children, actions, text }) {
  const title = useRef(null);
  useEffect(() => {
    document.title = `${text} · Qedgix`;
    if (opened && document.activeElement === document.body) title.current?.focus({ preventScroll: true });
    opened = true;
  }, [text]);
  return html`<header class="title"><h1 tabindex="-1" ref=${title}>${children ?? text}</h1>
    ${actions && html`<div class="actions">${actions}</div>`}</header>`;
}

const SYMBOLS = { queued: '◷', running: '▶', paused: '⏸\ufe0e', cancelled: '⊘', succeeded: '✓', failed: '✕' };

export const State = ({ state, wanted }) => html`<span class="state ${state}"><span aria-hidden="true">${SYMBOLS[state] ?? '?'}</span> ${state}${
  wanted ? html` <span class="faint">→ ${wanted}</span>` : null}</span>`;

export function Bar({ value, label }) {
  const percent = Math.round(Math.min(Math.max(value, 0), 1) * 1000) / 10;
  return html`<div class="bar" role="progressbar" aria-valuemin="0" aria-valuemax="100" aria-valuenow=${percent} aria-label=${label}>
    <div class="bar-fill" style=${{ width: `${percent}%` }}></div></div>`;
}

export const Card = ({ title, actions, children, class: extra = '' }) => html`<section class="card ${extra}">
  ${title && html`<div class="card-title"><h2>${title}</h2>${actions && html`<div class="actions">${actions}</div>`}</div>`}
  ${children}</section>`;

/** Links that switch between views of a page; `option` is the option of the address that names the view. */
export function Tabs({ parts, views, current, option = 'tab' }) {
  return html`<nav class="tabs" aria-label="Views">${views.map(([id, name]) => html`<a href=${link(parts, { [option]: id === views[0][0] ? '' : id })}
    aria-current=${id === current ? 'page' : undefined}>${name}</a>`)}</nav>`;
}

/** A field of a form with its label. */
export const Field = ({ label, hint, error, children }) => html`<label class="field"><span class="field-label">${label}</span>${children}
  ${hint && html`<span class="hint">${hint}</span>`}${error && html`<span class="hint wrong" role="alert">${error}</span>`}</label>`;

export const Choice = ({ value, options, onChange, ...rest }) => html`<select value=${value} onChange=${(e) => onChange(e.target.value)} ...${rest}>
  ${options.map((option) => {
    const [id, name] = Array.isArray(option) ? option : [option, option];
    return html`<option value=${id} selected=${id === value}>${name}</option>`;
  })}</select>`;

// Messages and questions. `app.js` shows them.

export const messages = new EventTarget();

/** Shows a short message. */
export function say(text, kind = 'done') {
  messages.dispatchEvent(new CustomEvent('message', { detail: { text, kind } }));
}

/** Asks before something that cannot be undone. Resolves to whether the reader agreed. */
export function ask(title, text, action, danger = true) {
  return new Promise((resolve) => messages.dispatchEvent(new CustomEvent('question', { detail: { title, text, action, danger, resolve } })));
}

/** Runs a command of the reader, says what was done or why not, and returns whether it was. */
export async function run(command, done) {
  try {
    await command();
    if (done) say(done);
    return true;
  } catch (error) {
    say(error.message, 'wrong');
    return false;
  }
}

/** A button that is disabled while its command runs. */
export function Action({ command, children, class: extra = '', ...rest }) {
  const [busy, set] = useState(false);
  const click = async (event) => {
    event.preventDefault();
    event.stopPropagation();
    set(true);
    try {
      await command();
    } finally {
      set(false);
    }
  };
  return html`<button type="button" class=${extra} disabled=${busy} onClick=${click} ...${rest}>${children}</button>`;
}

export async function copy(text) {
  try {
    await navigator.clipboard.writeText(text);
    say('Copied.');
  } catch {
    say('The browser does not allow copying on this address. Use https or localhost.', 'wrong');
  }
}
