// The address of a view: `#/PAGE/ID?option=value`. Everything that a reader wants to share is in it.

import { useEffect, useState } from './htm-preact-3.1.1.js';

const changed = new EventTarget();

/** The parts of the current address. */
export function route() {
  const [path, query = ''] = location.hash.replace(/^#/, '').split('?');
  const parts = path.split('/').filter(Boolean).map(decode);
  return { parts, query: new URLSearchParams(query) };
}

function decode(text) {
  try {
    return decodeURIComponent(text);
  } catch {
    return text;
  }
}

/** The address of a view, for links. Options that are empty are left out. */
export function link(parts, options = {}) {
  const query = new URLSearchParams(Object.entries(options).filter(([, value]) => value !== '' && value != null));
  const text = query.toString();
  return '#/' + parts.map(encodeURIComponent).join('/') + (text && '?' + text);
}

/** Goes to another view. */
export function go(address) {
  location.hash = address;
}

/** Changes options of the current view without a new entry in the history. An empty value removes the option. */
export function setOptions(options) {
  const { parts, query } = route();
  for (const [name, value] of Object.entries(options)) {
    if (value === '' || value == null) query.delete(name);
    else query.set(name, value);
  }
  history.replaceState(null, '', link(parts, Object.fromEntries(query)));
  changed.dispatchEvent(new Event('change'));
}

/** The current address, as state of a component. */
export function useRoute() {
  const [now, set] = useState(route);
  useEffect(() => {
    const update = () => set(route());
    addEventListener('hashchange', update);
    changed.addEventListener('change', update);
    return () => {
      removeEventListener('hashchange', update);
      changed.removeEventListener('change', update);
    };
  }, []);
  return now;
}
