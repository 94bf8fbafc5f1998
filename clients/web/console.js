// Requests to this server, from its OpenAPI document.

import { html, useEffect, useMemo, useState } from './htm-preact-3.1.1.js';
import { address, apiKey, get, send } from './api.js';
import { bytes } from './format.js';
import { link, setOptions } from './route.js';
import { Card, copy, Empty, ErrorBox, Field, Loaded, Title, useLoad } from './ui.js';

/** Longest text of a response that is shown. */
const SHOWN = 200_000;

export function ConsolePage({ options }) {
  const document = useLoad((signal) => get('/openapi.json', signal), [], 0);
  return html`<${Title} text="API console" actions=${html`<a class="button" href="docs">Reference</a><a class="button" href="openapi.json">OpenAPI document</a>`} />
    <${Loaded} of=${document} what="the operations">${(value) => html`<${Console} document=${value} options=${options} />`}<//>`;
}

function operations(document) {
  return Object.entries(document.paths).flatMap(([path, item]) => Object.entries(item)
    .filter(([verb]) => ['get', 'post', 'put', 'patch', 'delete'].includes(verb))
    .map(([verb, operation]) => ({ path, verb: verb.toUpperCase(), id: operation.operationId, tag: operation.tags?.[0] ?? 'other', ...operation })));
}

/** A schema, with a reference followed. */
const follow = (document, schema) => (schema?.$ref ? schema.$ref.split('/').slice(1).reduce((at, name) => at?.[name], document) : schema);

function Console({ document, options }) {
  const [search, setSearch] = useState('');
  const all = useMemo(() => operations(document), [document]);
  const chosen = all.find((o) => o.id === options.get('operation')) ?? all.find((o) => o.id === 'listPolicies') ?? all[0];
  const found = all.filter((o) => `${o.verb} ${o.path} ${o.summary ?? ''} ${o.id}`.toLowerCase().includes(search.toLowerCase()));
  const tags = [...new Set(found.map((o) => o.tag))];
  return html`<div class="console">
    <nav class="card operations" aria-label="Operations"><input type="search" aria-label="Search operations" placeholder="Search" value=${search} onInput=${(e) => setSearch(e.target.value)} />
      <div class="operation-list" tabindex="0" role="group" aria-label="Operations">${tags.map((tag) => html`<h2 class="small faint">${tag}</h2><ul>${found.filter((o) => o.tag === tag).map((o) => html`<li><a href=${link(['console'], { operation: o.id })} aria-current=${o.id === chosen.id ? 'true' : undefined}><span class="verb ${o.verb.toLowerCase()}">${o.verb}</span> <span>${o.path}</span></a></li>`)}</ul>`)}
      ${!found.length && html`<p class="faint">No operation matches.</p>`}</div></nav>
    <${Operation} key=${chosen.id} document=${document} operation=${chosen} options=${options} /></div>`;
}

/** A body to start from: the example of the schema, or its required fields. */
function exampleBody(document, operation) {
  const content = follow(document, operation.requestBody)?.content?.['application/json'];
  if (!content) return null;
  const schema = follow(document, content.schema);
  return JSON.stringify(content.example ?? schema?.example ?? Object.fromEntries((schema?.required ?? []).map((name) => [name, null])), null, 2);
}

function Operation({ document, operation, options }) {
  const parameters = (operation.parameters ?? []).map((p) => follow(document, p));
  const example = useMemo(() => exampleBody(document, operation), [operation]);
  const [values, setValues] = useState(() => Object.fromEntries(parameters.map((p) => [p.name, options.get(p.name) ?? ''])));
  const [body, setBody] = useState(example ?? '');
  const [answer, setAnswer] = useState(null);
  const [error, setError] = useState(null);
  const [busy, setBusy] = useState(null);
  useEffect(() => () => busy?.abort(), [busy]);
  const set = (name, value) => {
    setValues({ ...values, [name]: value });
    if (parameters.find((p) => p.name === name).in !== 'header') setOptions({ [name]: value });
  };
  const query = new URLSearchParams(parameters.filter((p) => p.in === 'query' && values[p.name] !== '').map((p) => [p.name, values[p.name]])).toString();
  const path = parameters.filter((p) => p.in === 'path').reduce((at, p) => at.replace(`{${p.name}}`, encodeURIComponent(values[p.name])), operation.path) + (query && `?${query}`);
  const headers = Object.fromEntries(parameters.filter((p) => p.in === 'header' && values[p.name] !== '').map((p) => [p.name, values[p.name]]));
  const missing = parameters.filter((p) => p.required && values[p.name] === '').map((p) => p.name);
  const quoted = (text) => `'${text.replace(/'/g, "'\\''")}'`;
  const curl = ['curl -s', operation.verb === 'GET' || (operation.verb === 'POST' && body.trim()) ? '' : `-X ${operation.verb}`, ...Object.entries(headers).map(([n, v]) => `-H ${quoted(`${n}: ${v}`)}`),
    apiKey.get() ? '-H "authorization: Bearer $QEDGIX_API_KEY"' : '', quoted(address(path).href), example != null && body.trim() ? `--json ${quoted(body)}` : ''].filter(Boolean).join(' ');
  const submit = async (event) => {
    event.preventDefault();
    const abort = new AbortController();
    setBusy(abort);
    setError(null);
    setAnswer(null);
    const began = performance.now();
    try {
      const response = await send(operation.verb, path, { body: example != null && body.trim() ? body : undefined, headers, signal: abort.signal });
      const told = { status: response.status, reason: response.statusText, headers: [...response.headers] };
      await read(response, (text, size) => setAnswer({ ...told, text, size, took: performance.now() - began }));
    } catch (problem) {
      if (problem.name !== 'AbortError') setError(problem);
    }
    setBusy(null);
  };
  return html`<div class="operation"><${Card}>
      <h2><span class="verb ${operation.verb.toLowerCase()}">${operation.verb}</span> <code>${operation.path}</code></h2>
      <p><strong>${operation.summary}</strong></p>${operation.description && html`<p class="faint">${operation.description}</p>`}
      <form onSubmit=${submit}>
        <div class="form">${parameters.map((p) => html`<${Field} label=${`${p.name}${p.required ? '' : ' (optional)'}`} hint=${p.description}>${p.schema?.enum || follow(document, p.schema)?.enum
          ? html`<select value=${values[p.name]} onChange=${(e) => set(p.name, e.target.value)}><option value=""></option>${(p.schema.enum ?? follow(document, p.schema).enum).map((v) => html`<option value=${v} selected=${v === values[p.name]}>${v}</option>`)}</select>`
          : html`<input value=${values[p.name]} required=${p.required} placeholder=${p.example ?? ''} onInput=${(e) => set(p.name, e.target.value)} />`}<//>`)}</div>
        ${example != null && html`<${Field} label="Body (JSON)"><textarea rows=${Math.min(Math.max(body.split('\n').length + 1, 5), 22)} spellcheck="false" value=${body} onInput=${(e) => setBody(e.target.value)}></textarea><//>`}
        <p class="actions"><button class="primary" disabled=${!!busy || missing.length > 0}>Send</button>${busy && html`<button type="button" onClick=${() => busy.abort()}>Stop</button>`}<button type="button" onClick=${() => copy(curl)}>Copy as curl</button>
          ${missing.length > 0 && html`<span class="hint">Fill in ${missing.join(', ')}.</span>`}</p>
        <pre class="curl" tabindex="0" aria-label="The request as a curl command">${curl}</pre>
      </form><//>
    <${ErrorBox} error=${error} />
    ${answer ? html`<${Card} title=${html`<span class=${answer.status < 400 ? 'good' : 'wrong'}>${answer.status} ${answer.reason}</span>`} actions=${html`<span class="faint small">${answer.took.toFixed(1)} ms, ${bytes(answer.size)}</span><button type="button" onClick=${() => copy(answer.text)}>Copy</button>`}>
      <pre tabindex="0" aria-label="Response">${pretty(answer.text)}</pre><details><summary>Headers</summary><pre>${answer.headers.map(([n, v]) => `${n}: ${v}`).join('\n')}</pre></details><//>`
    : !error && html`<${Card}><${Empty} title=${busy ? 'Waiting for the response…' : 'The response appears here.'} /><//>`}</div>`;
}

/** Reads a response piece by piece, so that streams of events are shown as they arrive. Keeps at most `SHOWN` characters. */
async function read(response, show) {
  const reader = response.body?.getReader();
  const decoder = new TextDecoder();
  let [text, size] = ['', 0];
  show(text, size);
  while (reader) {
    const { done, value } = await reader.read();
    if (done) break;
    size += value.length;
    if (text.length < SHOWN) text += decoder.decode(value, { stream: true });
    show(text.length < SHOWN ? text : `${text.slice(0, SHOWN)}\n… (cut)`, size);
  }
}

function pretty(text) {
  try {
    return JSON.stringify(JSON.parse(text), null, 2);
  } catch {
    return text || '(empty)';
  }
}
