// A server as its users start it, with a temporary data directory.

import { execFileSync, spawn } from 'node:child_process';
import { existsSync, mkdtempSync, readFileSync, rmSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';

const binary = process.env.QEDGIX_BIN;
const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

/** Waits until `condition` returns something true, and returns it. */
export async function until(what, condition, seconds = 30) {
  const end = Date.now() + seconds * 1000;
  for (;;) {
    const found = await condition();
    if (found) return found;
    if (Date.now() > end) throw new Error(`this did not happen in ${seconds} s: ${what}`);
    await pause(50);
  }
}

export class Server {
  constructor() {
    this.data = mkdtempSync(join(tmpdir(), 'qedgix-web-'));
    this.key = null;
  }

  /** The output of a command on the data directory of the server. */
  run(...args) {
    return execFileSync(binary, [...args, '--data-dir', this.data], { encoding: 'utf8', stdio: ['ignore', 'pipe', 'pipe'] });
  }

  async start(...flags) {
    const file = join(this.data, 'endpoints.json');
    rmSync(file, { force: true });
    const args = ['serve', '--grpc-addr', '127.0.0.1:0', '--http-addr', `127.0.0.1:${this.port ?? 0}`, '--data-dir', this.data, '--cpu-budget', '1', ...flags];
    this.process = spawn(binary, args, { stdio: ['ignore', 'pipe', 'pipe'] });
    this.log = '';
    for (const stream of [this.process.stdout, this.process.stderr]) stream.on('data', (text) => { this.log += text; });
    const ended = new Promise((resolve) => this.process.once('exit', resolve));
    this.ended = ended;
    await until('the server writes its addresses', () => {
      if (this.process.exitCode != null) throw new Error(`the server ended: ${this.log}`);
      return existsSync(file) && readFileSync(file, 'utf8').trim();
    });
    // A server that is started again has the same address.
    this.url = `http://${JSON.parse(readFileSync(file, 'utf8')).http}`;
    this.port = new URL(this.url).port;
    return this;
  }

  async stop() {
    this.process?.kill('SIGTERM');
    await this.ended;
  }

  async close() {
    this.process?.kill('SIGKILL');
    await this.ended;
    rmSync(this.data, { recursive: true, force: true });
  }

  /** A request to the REST interface; returns the JSON of the response. */
  async call(method, path, body) {
    const headers = { ...(body ? { 'content-type': 'application/json' } : {}), ...(this.key ? { authorization: `Bearer ${this.key}` } : {}) };
    const response = await fetch(this.url + path, { method, headers, body: body && JSON.stringify(body) });
    const text = await response.text();
    if (!response.ok) throw new Error(`${method} ${path}: ${response.status} ${text}`);
    return text ? JSON.parse(text) : null;
  }

  /** Submits a training job and returns its id. */
  async submit(name, { seed = 1, steps = 2000, ...training } = {}) {
    return (await this.call('POST', '/v1/jobs', { name, algorithm: 'qmix', seed, threads: 1, training: { steps, eval_every: 500, eval_episodes: 8, ...training } })).id;
  }

  async reaches(id, ...states) {
    return until(`job ${id} is ${states.join(' or ')}`, async () => {
      const { state, reason } = await this.call('GET', `/v1/jobs/${id}`);
      if (state === 'failed' && !states.includes('failed')) throw new Error(`the job failed: ${reason}`);
      return states.includes(state) && state;
    }, 60);
  }

  /** Kills the workers of the server. */
  killWorkers() {
    try {
      for (const id of execFileSync('pgrep', ['-P', String(this.process.pid)], { encoding: 'utf8' }).split('\n').filter(Boolean)) process.kill(Number(id), 'SIGKILL');
    } catch {
      // There is no worker at this moment.
    }
  }
}
