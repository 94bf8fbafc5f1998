// What can be changed of a job after its submission: name, labels, priority, notes.

import { html, useEffect, useRef, useState } from './htm-preact-3.1.1.js';
import { patch } from './api.js';
import { ErrorBox, Field, say } from './ui.js';

const labelText = (labels) => Object.entries(labels ?? {}).map(([k, v]) => `${k}=${v}`).join(', ');

/** `key=value, key=value` as an object. Throws a message if it is none. */
export function parseLabels(text) {
  const labels = {};
  for (const pair of text.split(',').map((p) => p.trim()).filter(Boolean)) {
    const [, key, value] = /^([^=]+)=(.*)$/.exec(pair) ?? [];
    if (!key) throw new Error(`“${pair}” is not key=value.`);
    labels[key.trim()] = value.trim();
  }
  return labels;
}

export function Edit({ job, close }) {
  const dialog = useRef(null);
  const [form, set] = useState({ name: job.name ?? '', labels: labelText(job.labels), priority: String(job.priority), notes: job.notes });
  const [error, setError] = useState(null);
  useEffect(() => dialog.current.showModal(), []);
  const input = (name) => (e) => set({ ...form, [name]: e.target.value });
  const save = async (event) => {
    event.preventDefault();
    try {
      const labels = parseLabels(form.labels);
      const removed = Object.fromEntries(Object.keys(job.labels).filter((key) => !(key in labels)).map((key) => [key, null]));
      await patch(`/v1/jobs/${job.id}`, { name: form.name.trim() || null, labels: { ...removed, ...labels }, priority: Number(form.priority) || 0, notes: form.notes || null });
      say('The job is changed.');
      close();
    } catch (problem) {
      setError(problem);
    }
  };
  return html`<dialog ref=${dialog} onCancel=${close} aria-labelledby="edit-title"><form onSubmit=${save}>
    <h2 id="edit-title">Edit the job</h2>
    <${Field} label="Name" hint="Of the policy that it will publish, too."><input value=${form.name} maxlength="63" onInput=${input('name')} /><//>
    <${Field} label="Labels" hint="key=value, key=value"><input value=${form.labels} onInput=${input('labels')} /><//>
    <${Field} label="Priority" hint="-100 to 100; higher starts first."><input type="number" min="-100" max="100" value=${form.priority} onInput=${input('priority')} /><//>
    <${Field} label="Notes"><textarea rows="4" maxlength="4000" value=${form.notes} onInput=${input('notes')}></textarea><//>
    <${ErrorBox} error=${error} />
    <div class="dialog-actions"><button type="button" onClick=${close}>Discard</button><button class="primary">Save</button></div></form></dialog>`;
}
