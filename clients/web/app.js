// The page around all views: navigation, the status of the server, the API key, the theme, questions and messages.

import { html, render, useEffect, useRef, useState, useErrorBoundary } from './htm-preact-3.1.1.js';
import { apiKey, keyWanted, text } from './api.js';
import { ConsolePage } from './console.js';
import { JobPage } from './job.js';
import { JobsPage } from './jobs.js';
import { PlayerPage } from './player.js';
import { PoliciesPage, PolicyPage } from './policies.js';
import { link, useRoute } from './route.js';
import { ServingPage } from './serving.js';
import { SubmitPage } from './submit.js';
import { Empty, messages, Title, useLoad } from './ui.js';

const PAGES = [['jobs', 'Jobs'], ['policies', 'Policies'], ['player', 'Player'], ['serving', 'Serving'], ['console', 'API']];

/** The values of the metrics without labels, and of `qedgix_jobs` by state (Prometheus text). */
export function parseMetrics(source) {
  const found = {};
  for (const line of source.split('\n')) {
    const [, name, labels, value] = /^([a-z_]+)(?:\{(.*)\})? ([-+0-9.eENaInf]+)$/.exec(line) ?? [];
    if (name) found[labels ? `${name}{${labels}}` : name] = Number(value);
  }
  return found;
}

async function loadStatus() {
  const [ready, metrics] = await Promise.all([text('/readyz').then(() => null, (error) => error), text('/metrics')]);
  return { ready, metrics: parseMetrics(metrics), at: Date.now() };
}

function Status({ status }) {
  const value = status.value;
  const broken = status.error ?? value?.ready;
  const jobs = (state) => value?.metrics[`qedgix_jobs{state="${state}"}`] ?? 0;
  const [busy, budget] = [value?.metrics.qedgix_training_threads_busy ?? 0, value?.metrics.qedgix_training_threads ?? 0];
  const state = broken ? (broken.code === 'unauthenticated' ? 'API key required' : broken.code === 'unreachable' ? 'not reachable' : broken.code === 'permission_denied' ? 'no right to read' : 'not ready') : value ? 'ready' : 'connecting';
  return html`<div class="status" role="status" title=${broken?.message ?? 'The server answers and can serve.'}>
    <span class="dot ${broken ? 'bad' : value ? 'good' : ''}" aria-hidden="true"></span><span class="status-state">${state}</span>
    ${value && !broken && html`<span class="status-load" title="Training threads in use, of the CPU budget">
      <span class="meter" aria-hidden="true"><span style=${{ width: `${budget ? (100 * busy) / budget : 0}%` }}></span></span>
      ${busy} of ${budget} threads</span>
      <span class="status-jobs">${jobs('running')} running, ${jobs('queued')} waiting</span>`}
  </div>`;
}

const THEMES = ['', 'light', 'dark'];
const THEME_ICONS = {
  '': 'M12 3a9 9 0 1 0 0 18zM12 3a9 9 0 0 1 0 18',
  light: 'M12 8a4 4 0 1 0 0 8 4 4 0 0 0 0-8zM12 2v3M12 19v3M2 12h3M19 12h3M5 5l2 2M17 17l2 2M5 19l2-2M17 7l2-2',
  dark: 'M20 14.5A8.5 8.5 0 1 1 9.5 4 7 7 0 0 0 20 14.5z',
};
const THEME_NAMES = { '': 'system', light: 'light', dark: 'dark' };

const Icon = ({ path }) => html`<svg class="icon" viewBox="0 0 24 24" width="20" height="20" aria-hidden="true"><path d=${path} /></svg>`;

function Theme({ redraw }) {
  const [theme, set] = useState(document.documentElement.dataset.theme ?? '');
  const next = THEMES[(THEMES.indexOf(theme) + 1) % THEMES.length];
  const change = () => {
    set(next);
    if (next) document.documentElement.dataset.theme = next;
    else delete document.documentElement.dataset.theme;
    try {
      if (next) localStorage.setItem('qedgix-theme', next);
      else localStorage.removeItem('qedgix-theme');
    } catch {
      // Storage is not available: the choice holds until the page is closed.
    }
    redraw();
  };
  useEffect(() => {
    const dark = matchMedia('(prefers-color-scheme: dark)');
    dark.addEventListener('change', redraw);
    return () => dark.removeEventListener('change', redraw);
  }, []);
  return html`<button type="button" class="quiet" onClick=${change} title=${`Theme: ${THEME_NAMES[theme]}. Click for ${THEME_NAMES[next]}.`}
    aria-label=${`Theme: ${THEME_NAMES[theme]}. Change to ${THEME_NAMES[next]}.`}><${Icon} path=${THEME_ICONS[theme]} /></button>`;
}

function KeyDialog({ open, close, wanted, refused }) {
  const dialog = useRef(null);
  const [key, set] = useState('');
  useEffect(() => {
    if (open && !dialog.current.open) {
      set(apiKey.get());
      dialog.current.showModal();
    }
    if (!open && dialog.current.open) dialog.current.close();
  }, [open]);
  const save = (value) => {
    apiKey.set(value.trim());
    close(true);
    dispatchEvent(new Event('qedgix-key'));
  };
  return html`<dialog ref=${dialog} onCancel=${() => close(false)} aria-labelledby="key-title">
    <form onSubmit=${(e) => { e.preventDefault(); save(key); }}>
      <h2 id="key-title">API key</h2>
      ${wanted && html`<p class="wrong">${refused ? 'The server refuses this key: it is wrong, expired or revoked.' : 'This server requires an API key.'}</p>`}
      <p>The key stays in this tab and is sent to this server only. <code>qedgix keys create --name me --scopes read,act,jobs</code> makes one.</p>
      <label class="field"><span class="field-label">Key</span><input type="password" autocomplete="off" value=${key} placeholder="qdx_…" onInput=${(e) => set(e.target.value)} /></label>
      <div class="dialog-actions">
        ${apiKey.get() && html`<button type="button" onClick=${() => save('')}>Forget the key</button>`}
        <button type="button" onClick=${() => close(false)}>Cancel</button><button class="primary">Use this key</button></div>
    </form></dialog>`;
}

function Question() {
  const dialog = useRef(null);
  const [question, set] = useState(null);
  useEffect(() => {
    const show = (event) => {
      set(event.detail);
      if (!dialog.current.open) dialog.current.showModal();
    };
    messages.addEventListener('question', show);
    return () => messages.removeEventListener('question', show);
  }, []);
  const answer = (yes) => {
    question?.resolve(yes);
    set(null);
    if (dialog.current.open) dialog.current.close();
  };
  return html`<dialog ref=${dialog} onClose=${() => answer(false)} aria-labelledby="question-title">
    ${question && html`<h2 id="question-title">${question.title}</h2><p>${question.text}</p>
      <div class="dialog-actions"><button type="button" onClick=${() => answer(false)}>Keep it as it is</button>
        <button type="button" class=${question.danger ? 'danger' : 'primary'} onClick=${() => answer(true)}>${question.action}</button></div>`}
  </dialog>`;
}

function Messages() {
  const [all, set] = useState([]);
  useEffect(() => {
    const show = (event) => {
      const message = { ...event.detail, id: Math.random() };
      set((old) => [...old.slice(-3), message]);
      setTimeout(() => set((old) => old.filter((m) => m.id !== message.id)), message.kind === 'wrong' ? 9000 : 4000);
    };
    messages.addEventListener('message', show);
    return () => messages.removeEventListener('message', show);
  }, []);
  return html`<div class="messages" role="status" aria-live="polite">${all.map((m) => html`<p key=${m.id} class="message ${m.kind}">${m.text}</p>`)}</div>`;
}

function Page({ route }) {
  const [page = 'jobs', id] = route.parts;
  const [error, reset] = useErrorBoundary();
  useEffect(() => reset(), [route.parts.join('/')]);
  if (error) {
    console.error(error);
    return html`<div class="notice error" role="alert"><div><strong>This view failed: ${error.message}</strong><p>Reload the page. If it happens again, it is a bug of the dashboard; the server is not affected.</p></div></div>`;
  }
  if (page === 'jobs') return id ? html`<${JobPage} key=${id} id=${id} options=${route.query} />` : html`<${JobsPage} options=${route.query} />`;
  if (page === 'submit') return html`<${SubmitPage} key=${route.query.get('from')} options=${route.query} />`;
  if (page === 'policies') return id ? html`<${PolicyPage} key=${id} name=${id} options=${route.query} />` : html`<${PoliciesPage} />`;
  if (page === 'player') return html`<${PlayerPage} options=${route.query} />`;
  if (page === 'serving') return html`<${ServingPage} />`;
  if (page === 'console') return html`<${ConsolePage} options=${route.query} />`;
  return html`<${Title} text="No such page" /><${Empty} title=${`There is no page “${page}”.`}><p><a href="#/jobs">Go to the jobs</a></p><//>`;
}

function App() {
  const route = useRoute();
  const [keyOpen, setKeyOpen] = useState(false);
  const [wanted, setWanted] = useState(false);
  const [keys, setKeys] = useState(0);
  // Who closes the dialog without a key is not asked again by every request that fails.
  const declined = useRef(false);
  const [, redraw] = useState(0);
  const status = useLoad(loadStatus, [], 5);
  useEffect(() => {
    const want = () => {
      if (declined.current) return;
      setWanted(true);
      setKeyOpen(true);
    };
    keyWanted.addEventListener('wanted', want);
    return () => keyWanted.removeEventListener('wanted', want);
  }, []);
  useEffect(() => {
    scrollTo(0, 0);
  }, [route.parts.join('/')]);
  const closeKey = (changed) => {
    declined.current = !changed;
    setKeyOpen(false);
    setWanted(false);
    if (changed) setKeys(keys + 1);
  };
  const current = { submit: 'jobs' }[route.parts[0]] ?? route.parts[0] ?? 'jobs';
  const skip = (e) => {
    e.preventDefault();
    document.querySelector('h1')?.focus();
  };
  return html`
    <a class="skip" href="#main" onClick=${skip}>Skip to the content</a>
    <header class="top">
      <a class="brand" href="#/jobs"><img src="ui/icon.svg" alt="" width="26" height="26" /> Qedgix</a>
      <nav class="main-nav" aria-label="Pages">${PAGES.map(([id, name]) => html`<a href=${link([id])} aria-current=${current === id ? 'page' : undefined}>${name}</a>`)}</nav>
      <${Status} status=${status} />
      <button type="button" class="quiet" onClick=${() => { setWanted(false); setKeyOpen(true); }} title="API key" aria-label=${apiKey.get() ? 'API key: set' : 'API key: not set'}><${Icon} path="M7 14a4 4 0 1 1 3.9-5H21v4h-2v3h-4v-3h-4.1A4 4 0 0 1 7 14z" /></button>
      <${Theme} redraw=${() => redraw((n) => n + 1)} />
    </header>
    <main id="main"><${Page} key=${keys} route=${route} /></main>
    <${KeyDialog} open=${keyOpen} wanted=${wanted} refused=${apiKey.get() !== ''} close=${closeKey} />
    <${Question} /><${Messages} />`;
}

render(html`<${App} />`, document.getElementById('app'));
