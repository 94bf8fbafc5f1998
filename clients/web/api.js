// Requests to the server that served this page.

const KEY = 'qedgix-api-key';
const base = new URL('.', location.href.split('#')[0]);

/** Tells the page that the server requires an API key or refuses the one that it has. */
export const keyWanted = new EventTarget();

export const apiKey = {
  get: () => sessionStorage.getItem(KEY) ?? '',
  set: (key) => (key ? sessionStorage.setItem(KEY, key) : sessionStorage.removeItem(KEY)),
};

/** An error response (RFC 9457), or a server that does not answer (code `unreachable`). */
export class ApiError extends Error {
  constructor(problem) {
    super(problem.detail || problem.title || 'unknown error');
    this.name = 'ApiError';
    Object.assign(this, { status: problem.status, code: problem.code, field: problem.field, retryAfter: problem.retry_after });
  }
}

/** The address of a path of the server, also behind a proxy with a prefix. */
export function address(path) {
  return new URL(path.replace(/^\//, ''), base);
}

/** Sends a request and returns the response, whatever its status. */
export async function send(method, path, { body, headers = {}, signal } = {}) {
  const all = { ...headers };
  const key = apiKey.get();
  if (key) all.authorization = `Bearer ${key}`;
  if (body !== undefined && !all['content-type']) all['content-type'] = 'application/json';
  const text = body === undefined || typeof body === 'string' ? body : JSON.stringify(body);
  try {
    return await fetch(address(path), { method, headers: all, body: text, signal, cache: 'no-store' });
  } catch (error) {
    if (error.name === 'AbortError') throw error;
    throw new ApiError({ code: 'unreachable', detail: 'The server does not answer. Is `qedgix serve` still running?' });
  }
}

/** Sends a request and returns the response if it is a success. */
export async function request(method, path, options) {
  const response = await send(method, path, options);
  if (response.ok) return response;
  let problem = { status: response.status, code: 'unknown', detail: `${response.status} ${response.statusText}` };
  try {
    problem = { ...problem, ...(await response.json()) };
  } catch {
    // The response does not come from the server itself but from a proxy.
  }
  if (response.status === 401) keyWanted.dispatchEvent(new Event('wanted'));
  throw new ApiError(problem);
}

async function json(method, path, options) {
  const response = await request(method, path, options);
  return response.status === 204 ? null : response.json();
}

export const get = (path, signal) => json('GET', path, { signal });
export const post = (path, body, options) => json('POST', path, { body, ...options });
export const put = (path, body) => json('PUT', path, { body });
export const patch = (path, body) => json('PATCH', path, { body });
export const remove = (path) => json('DELETE', path);
export const text = async (path) => (await request('GET', path)).text();

/** All entries of a list with pages, at most `most`. `name` is the field with the entries. */
export async function all(path, name, most = 1000, signal) {
  const entries = [];
  let token = '';
  do {
    const next = path + (path.includes('?') ? '&' : '?') + 'page_token=' + encodeURIComponent(token);
    const page = await get(next, signal);
    entries.push(...page[name]);
    token = page.next_page_token;
  } while (token && entries.length < most);
  return entries;
}

/** Saves the response to a GET request as a file. A plain link could not send the API key. */
export async function download(path, fileName) {
  const blob = await (await request('GET', path)).blob();
  const a = document.createElement('a');
  a.href = URL.createObjectURL(blob);
  a.download = fileName;
  a.click();
  setTimeout(() => URL.revokeObjectURL(a.href), 10_000);
}

/**
 * Follows the events of a job until it has ended or `signal` is aborted, and reconnects after failures. Calls `onEvent(name, data)`;
 * `onTrouble(error)` when the stream breaks, and `onTrouble(null)` when it works again.
 */
export async function followJob(id, { onEvent, onTrouble, signal }) {
  let after = 0;
  let wait = 500;
  while (!signal.aborted) {
    try {
      const response = await request('GET', `/v1/jobs/${id}/events?after=${after}`, { signal });
      onTrouble(null);
      if (response.status === 204) return;
      for await (const { id: eventId, event, data } of serverSentEvents(response.body)) {
        after = Number(eventId) || after;
        onEvent(event, JSON.parse(data));
        wait = 500;
      }
      // The stream ends when the job has ended (the next response is 204) or when the server stops.
    } catch (error) {
      if (signal.aborted || [401, 403, 404].includes(error.status)) {
        if (!signal.aborted) onTrouble(error);
        return;
      }
      onTrouble(error);
    }
    await new Promise((resolve) => setTimeout(resolve, wait));
    wait = Math.min(wait * 2, 10_000);
  }
}

/** The events of a stream (text/event-stream). */
async function* serverSentEvents(body) {
  const reader = body.pipeThrough(new TextDecoderStream()).getReader();
  let rest = '';
  for (;;) {
    const { done, value } = await reader.read();
    if (done) return;
    const blocks = (rest + value).split(/\r?\n\r?\n/);
    rest = blocks.pop();
    for (const block of blocks) {
      const event = { event: 'message', data: '' };
      for (const line of block.split(/\r?\n/)) {
        const [, name, value] = /^([a-z]+): ?(.*)$/.exec(line) ?? [];
        if (name === 'data') event.data += value;
        else if (name) event[name] = value;
      }
      if (event.data) yield event;
    }
  }
}
