// Tests of the dashboard in a real browser. `tests/web/run` installs the tools and starts this file.

import { createRequire } from 'node:module';
import { execFileSync } from 'node:child_process';
import { mkdirSync, readFileSync } from 'node:fs';
import { join } from 'node:path';
import assert from 'node:assert/strict';
import { Server, until } from './server.mjs';

const require = createRequire(join(process.env.QEDGIX_WEB_TOOLS, 'x.js'));
const { chromium } = require('playwright-core');
const axeSource = `${readFileSync(require.resolve('axe-core/axe.min.js'), 'utf8')};0`;

/** If given, pictures of all pages are written to this directory. */
const pictures = process.env.QEDGIX_WEB_PICTURES;
const DESKTOP = { width: 1280, height: 860 };
const PHONE = { width: 390, height: 844 };

const browser = await chromium.launch({ executablePath: process.env.CHROMIUM, args: ['--no-sandbox', '--disable-dev-shm-usage'] });
const servers = [];
const problems = [];

async function serve(...flags) {
  const server = new Server();
  servers.push(server);
  return server.start(...flags);
}

/** A page of its own; what it writes to its console as an error fails the test, unless `expected` matches it. */
async function open(url, { viewport = DESKTOP, colorScheme = 'light', expected = null } = {}) {
  const context = await browser.newContext({ viewport, colorScheme, bypassCSP: false });
  context.setDefaultTimeout(20_000);
  const page = await context.newPage();
  page.on('console', (message) => {
    if (message.type() === 'error' && !expected?.test(message.text())) problems.push(`console: ${message.text()} (${message.location().url})`);
  });
  page.on('pageerror', (error) => problems.push(`error of the page: ${error.stack}`));
  await page.goto(url);
  return page;
}

const title = (page, text) => page.getByRole('heading', { level: 1, name: text }).waitFor();
const points = (page) => page.locator('.chart').first().evaluate((chart) => Number(chart.dataset.points)).catch(() => 0);
const slot = async (page) => Number(/slot (\d+)/.exec(await page.locator('.slot-number').textContent())[1]);
const state = (page, name) => page.locator('h1 .state', { hasText: name }).waitFor();

/** The server of most tests: without keys; a job fails at its first failure. */
const main = await serve('--max-attempts', '1');

const tests = {
  async 'without jobs the page says what to do'() {
    const page = await open(main.url);
    await page.getByText('No jobs yet.').waitFor();
    await page.getByRole('link', { name: 'Submit the first job' }).click();
    await title(page, 'New job');
  },

  async 'a job is submitted, and its curve grows while it runs; it is paused, resumed and cancelled'() {
    const page = await open(`${main.url}/#/submit`);
    await page.getByLabel('Name', { exact: false }).first().fill('web-long');
    await page.getByLabel('Algorithm').selectOption('qmix');
    for (const [name, value] of [['steps', '50000000'], ['eval_every', '1000'], ['eval_episodes', '8']]) {
      await page.getByLabel(`training.${name}`, { exact: true }).fill(value);
    }
    await page.locator('table.changes', { hasText: 'training.steps' }).waitFor();
    await page.getByRole('button', { name: 'Submit' }).click();
    await title(page, 'web-long');
    await state(page, 'running');
    const before = await until('the curve has points', () => points(page));
    await until('the curve grows while the job runs', async () => (await points(page)) > before + 2);
    await page.getByRole('button', { name: 'Pause' }).click();
    await state(page, 'paused');
    await page.getByRole('button', { name: 'Resume' }).click();
    await state(page, 'running');
    await page.getByRole('button', { name: 'Cancel' }).click();
    await page.getByRole('dialog').getByRole('button', { name: 'Keep it as it is' }).click();
    await page.getByRole('button', { name: 'Cancel' }).click();
    await page.getByRole('dialog').getByRole('button', { name: 'Cancel the job' }).click();
    await state(page, 'cancelled');
    await page.getByRole('link', { name: 'Events' }).click();
    await page.locator('tbody tr', { hasText: 'paused' }).first().waitFor();
  },

  async 'a failed job is retried'() {
    const id = await main.submit('web-fails', { steps: 50_000_000 });
    await main.reaches(id, 'running');
    await until('the job fails', async () => {
      main.killWorkers();
      return (await main.call('GET', `/v1/jobs/${id}`)).state === 'failed';
    });
    const page = await open(`${main.url}/#/jobs/${id}`);
    await state(page, 'failed');
    await page.getByText('Reason:').waitFor();
    await page.getByRole('button', { name: 'Retry' }).click();
    await state(page, 'running');
    await main.call('POST', `/v1/jobs/${id}/cancel`);
    await state(page, 'cancelled');
  },

  async 'a clone shows what is changed and has everything else of its job'() {
    const source = await main.submit('web-source', { steps: 1500, batch: 16 });
    const page = await open(`${main.url}/#/submit?from=${source}`);
    await title(page, 'Clone web-source');
    await page.getByLabel('Seeds').fill('7');
    await page.getByLabel('training.gamma', { exact: true }).fill('0.9');
    const changes = page.locator('table.changes');
    assert.match(await changes.textContent(), /seeds.*1.*7/s);
    assert.match(await changes.textContent(), /training\.gamma.*0\.95.*0\.9/s);
    await page.getByLabel('training.gamma', { exact: true }).fill('2');
    await page.getByRole('button', { name: 'Submit' }).click();
    await page.locator('.setting .wrong').waitFor();
    await page.getByLabel('training.gamma', { exact: true }).fill('0.9');
    await page.getByRole('button', { name: 'Submit' }).click();
    await page.waitForURL(/#\/jobs\//);
    const { training, seed } = await main.call('GET', `/v1/jobs/${page.url().split('/').at(-1)}`);
    assert.deepEqual([training.gamma, training.batch, training.steps, seed], [0.9, 16, 1500, 7]);
  },

  async 'jobs are compared: curves of seeds become a mean with a band'() {
    const ids = [];
    for (const seed of [1, 2, 3]) ids.push(await main.submit('web-seeds', { seed }));
    for (const id of ids) await main.reaches(id, 'succeeded');
    const page = await open(`${main.url}/#/jobs?jobs=${ids.join(',')}`);
    await until('three curves are drawn', async () => (await page.locator('.u-legend .u-series:not(.band-of-curve)').count()) === 4);
    await page.getByLabel('Group by').selectOption('all');
    await page.locator('.u-label', { hasText: /\(3 jobs\)$/ }).waitFor();
    await page.getByText('Bands: mean').waitFor();
    assert.match(page.url(), /group=all/);
    await page.getByLabel('Search').fill('no-such-job');
    await page.getByText('No job matches.').waitFor();
    if (pictures) await page.getByRole('button', { name: 'Show all jobs' }).click();
  },

  async 'curves of one colour differ in the legend as they do in the plot, and shares end at 1'() {
    const ids = [];
    for (const [algorithm, seed] of [['vdn', 1], ['vdn', 2], ['iql', 1]]) {
      const training = { steps: 1000, eval_every: 500, eval_episodes: 8 };
      ids.push((await main.call('POST', '/v1/jobs', { name: 'web-dashes', algorithm, seed, threads: 1, environment: { uavs: 9, users: 1 }, training })).id);
    }
    for (const id of ids) await main.reaches(id, 'succeeded');
    const page = await open(`${main.url}/#/jobs?jobs=${ids.join(',')}&metric=eval/coverage`);
    const markers = page.locator('.u-legend .u-series:not(.band-of-curve) .u-marker');
    await until('three curves are drawn', async () => (await markers.count()) === 4);
    const swatches = await markers.evaluateAll((all) => all.slice(1).map((one) => one.style.background));
    assert.equal(new Set(swatches).size, 3, swatches.join('; '));
    assert.equal(swatches.filter((one) => one.includes('gradient')).length, 1, swatches.join('; '));
    assert.equal(await page.locator('.chart .uplot').first().getAttribute('data-top'), '1');
    const decimals = await page.evaluate(async () => {
      const { places } = await import('/ui/chart.js');
      return [100, 1, 2.5, 0.5, 0.25, 0.1, 0.02, 1e-7, 1e-12].map(places);
    });
    assert.deepEqual(decimals, [0, 0, 1, 1, 2, 1, 2, 7, 9]);
    if (pictures) await picture(page, 'dashes');
  },

  async 'a waiting job says why, is edited, and is found by kind, label and best value'() {
    const long = await main.submit('web-first', { steps: 50_000_000 });
    await main.reaches(long, 'running');
    const waiting = await main.submit('web-waits');
    const page = await open(`${main.url}/#/jobs/${waiting}`);
    await state(page, 'queued');
    await page.getByText('Waiting:').waitFor();
    await page.getByRole('button', { name: 'Edit' }).click();
    const dialog = page.getByRole('dialog');
    await dialog.getByLabel('Labels').fill('team=web');
    await dialog.getByLabel('Notes').fill('of a test');
    await dialog.getByRole('button', { name: 'Save' }).click();
    await page.locator('.label', { hasText: 'team=web' }).waitFor();
    await page.getByText('of a test').waitFor();
    await main.call('POST', `/v1/jobs/${waiting}/cancel`);
    await main.call('POST', `/v1/jobs/${long}/cancel`);
    await page.goto(`${main.url}/#/jobs?q=team=web&kind=train`);
    await page.getByRole('link', { name: 'web-waits' }).waitFor();
    await page.getByLabel('Search').fill('web-seeds');
    await page.getByLabel('Order').selectOption('best:eval/mean_aoi');
    await until('jobs are sorted by their best value', async () => {
      const best = (await page.locator('td[data-name="Best mean AoI"]').allTextContents()).map(Number);
      return best.length === 3 && best.every((value, i) => i === 0 || value >= best[i - 1]);
    });
  },

  async 'policies are evaluated by a job, and its report compares them'() {
    const page = await open(`${main.url}/#/submit?kind=evaluate&policies=qedgix,sweep`);
    await page.getByLabel('Number of layouts').fill('8');
    await page.getByRole('button', { name: 'Submit' }).click();
    await state(page, 'succeeded');
    await page.locator('table.report tbody tr').nth(1).waitFor();
    await page.getByText('Differences on the same layouts').waitFor();
  },

  async 'a sweep compares its jobs'() {
    const page = await open(`${main.url}/#/submit?kind=sweep`);
    await page.getByLabel('Name', { exact: false }).first().fill('web-sweep');
    await page.getByLabel('Algorithm').selectOption('qmix');
    await page.getByLabel('What varies').fill('training.learning_rate: 0.0003, 0.003');
    for (const [name, value] of [['steps', '1500'], ['eval_every', '500'], ['eval_episodes', '8']]) {
      await page.getByLabel(`training.${name}`, { exact: true }).fill(value);
    }
    await page.getByRole('button', { name: 'Submit' }).click();
    await state(page, 'succeeded');
    await until('a line per job', async () => (await page.locator('.parallel polyline').count()) === 2);
    await page.getByRole('button', { name: 'Table' }).click();
    await page.locator('.results th', { hasText: 'training.learning_rate' }).waitFor();
  },

  async 'a version is promoted, and the history shows it'() {
    await until('three versions are published', async () => (await main.call('GET', '/v1/policies/web-seeds')).version_count === 3);
    const page = await open(`${main.url}/#/policies/web-seeds`);
    for (const [version, button] of [['2', 'Create alias'], ['3', 'Promote']]) {
      await page.locator('form.controls select').selectOption(version);
      await page.getByRole('button', { name: button }).click();
      await page.getByRole('dialog').getByRole('button', { name: version === '2' ? 'Create live' : 'Move live' }).click();
      await page.locator('.alias', { hasText: `version ${version}` }).waitFor();
    }
    assert.equal((await main.call('GET', '/v1/policies/web-seeds@live')).ref.version, 3);
    await page.getByRole('link', { name: 'History of aliases' }).click();
    await page.getByText('version 2 → 3').waitFor();
    await page.getByRole('button', { name: 'Back to 2' }).click();
    await page.getByRole('dialog').getByRole('button', { name: 'Move live' }).click();
    await page.getByText('version 3 → 2').waitFor();
  },

  async 'the player plays, scrubs, compares two policies on one layout and flies over drawn users'() {
    const page = await open(`${main.url}/#/player?policy=qedgix&against=sweep&seed=10003`);
    await until('it plays', async () => (await slot(page)) > 2);
    await until('both episodes are flown', async () => (await page.locator('.figures thead th').count()) === 3);
    await page.getByLabel('Slot', { exact: true }).evaluate((range) => {
      range.value = '40';
      range.dispatchEvent(new Event('input', { bubbles: true }));
    });
    await until('it is at the slot', async () => (await slot(page)) === 40);
    assert.match(page.url(), /slot=40/);
    const aoi = await page.locator('.aoi-now').allTextContents();
    await page.getByRole('button', { name: '+1 slot' }).click();
    assert.equal(await slot(page), 41);
    await page.reload();
    await until('the same slot after a reload', async () => (await page.locator('.figures thead th').count()) === 3 && (await slot(page)) === 41);
    await page.getByRole('button', { name: '−1 slot' }).click();
    assert.deepEqual(await page.locator('.aoi-now').allTextContents(), aoi, 'the layout determines the episode');
    await page.getByRole('button', { name: 'Draw a layout' }).click();
    await page.getByRole('button', { name: 'Remove all' }).click();
    const square = page.locator('canvas.scene');
    const box = await square.boundingBox();
    for (const [x, y] of [[0.3, 0.3], [0.7, 0.6]]) await square.click({ position: { x: x * box.width, y: y * box.height } });
    await square.press('ArrowUp');
    await square.press('Enter');
    await page.getByRole('button', { name: 'Fly over 3 users' }).click();
    await until('an episode with the drawn users', async () => (await page.locator('.figures thead th').count()) === 3);
    assert.equal(new URLSearchParams(page.url().split('?')[1]).get('draw').split(';').length, 3);
    await until('no environment is left', async () => (await main.call('GET', '/v1/environments')).environments.length === 0);
  },

  async 'the console sends a request'() {
    const page = await open(`${main.url}/#/console?operation=act`);
    await page.getByRole('button', { name: 'Send' }).click();
    await page.getByRole('heading', { name: '200' }).waitFor();
    await page.getByLabel('Response').filter({ hasText: 'heading_index' }).waitFor();
    await page.getByRole('link', { name: 'GET /v1/jobs/{id}/events' }).click();
    await page.getByLabel('id', { exact: false }).first().fill(await main.submit('web-console'));
    await page.getByRole('button', { name: 'Send' }).click();
    await page.getByLabel('Response').filter({ hasText: 'event: state' }).waitFor();
  },

  async 'every page fits a desktop and a phone, in light and dark, and has no serious finding of axe'() {
    const { jobs } = await main.call('GET', '/v1/jobs');
    const job = jobs.find(({ state: s }) => s === 'succeeded').id;
    await main.call('POST', '/v1/sessions', { session_id: 'web', policy: 'sweep' });
    const pages = ['jobs', `jobs/${job}`, `jobs/${job}?tab=configuration`, `jobs/${job}?tab=logs`, `jobs/${job}?tab=checkpoints`, `submit?from=${job}`, 'policies',
      'policies/web-seeds', 'policies/web-seeds?tab=history', 'player?against=sweep&slot=30', 'serving', 'console?operation=act', 'nowhere'];
    for (const [device, viewport] of [['desktop', DESKTOP], ['phone', PHONE]]) {
      for (const colorScheme of ['light', 'dark']) {
        const page = await open(main.url, { viewport, colorScheme });
        for (const name of pages) {
          await page.evaluate((hash) => { location.hash = hash; }, `#/${name}`);
          await page.locator('h1').waitFor();
          await until(`${name} is loaded`, async () => (await page.locator('.loading, .placeholder').count()) === 0);
          const [wide, inner] = await page.evaluate(() => [document.documentElement.scrollWidth, innerWidth]);
          assert.ok(wide <= inner, `${name} is wider than a ${device}: ${wide} > ${inner}`);
          // Colours are the same on both devices, so the rules are checked on each device in one theme only.
          if ((device === 'desktop') === (colorScheme === 'light')) problems.push(...(await findings(page, `${name}, ${device}, ${colorScheme}`)));
          if (pictures) await picture(page, `${name}-${device}-${colorScheme}`);
        }
        await page.context().close();
      }
    }
  },

  async 'links can be used by keyboard'() {
    const page = await open(main.url);
    await title(page, 'Jobs');
    await page.locator('body').press('Tab');
    assert.equal(await page.evaluate(() => document.activeElement.textContent), 'Skip to the content');
    await page.getByRole('link', { name: 'Policies' }).focus();
    await page.keyboard.press('Enter');
    await title(page, 'Policies');
  },

  async 'a server that stops is said to be unreachable, and found again'() {
    const server = await serve();
    const id = await server.submit('web-gone');
    const page = await open(`${server.url}/#/jobs/${id}`, { expected: /Failed to load resource|ERR_|net::/ });
    await title(page, 'web-gone');
    await server.stop();
    await page.getByRole('alert').filter({ hasText: 'The server does not answer' }).first().waitFor();
    await page.locator('.status-state', { hasText: 'not reachable' }).waitFor();
    await server.start();
    await page.locator('.status-state', { hasText: /^ready$/ }).waitFor();
    await until('the errors are gone', async () => (await page.getByRole('alert').count()) === 0);
    const missing = await open(`${server.url}/#/jobs/nothing`, { expected: /404/ });
    await missing.getByRole('alert').filter({ hasText: 'no job' }).waitFor();
  },

  async 'with a key: it is asked for, kept in the tab, and sent also with events'() {
    const server = await serve();
    server.key = /qdx_\S+/.exec(server.run('keys', 'create', '--name', 'web', '--scopes', 'read,act,jobs'))[0];
    await until('the server requires a key', async () => (await fetch(`${server.url}/v1/jobs`)).status === 401);
    const page = await open(server.url, { expected: /401/ });
    const dialog = page.getByRole('dialog');
    await dialog.getByText('This server requires an API key.').waitFor();
    await dialog.getByLabel('Key', { exact: true }).fill('qdx_wrong');
    await dialog.getByRole('button', { name: 'Use this key' }).click();
    await dialog.getByText('The server refuses this key').waitFor();
    await dialog.getByLabel('Key', { exact: true }).fill(server.key);
    await dialog.getByRole('button', { name: 'Use this key' }).click();
    await page.getByText('No jobs yet.').waitFor();
    const id = await server.submit('web-key');
    await page.goto(`${server.url}/#/jobs/${id}`);
    await until('events arrive', () => points(page));
    assert.equal(await page.evaluate(() => localStorage.length), 0, 'the key is not kept longer than the tab');
  },

  async '200 jobs of 2 000 rows each'() {
    const server = await serve();
    await server.reaches(await server.submit('web-many'), 'succeeded');
    await server.stop();
    execFileSync('python3', ['tests/web/many_jobs.py', join(server.data, 'qedgix.sqlite'), '200', '2000']);
    await server.start();
    const page = await open(`${server.url}/#/policies`);
    await title(page, 'Policies');
    const begin = Date.now();
    await page.goto(`${server.url}/?again#/jobs`);
    await page.locator('table.jobs tbody tr').nth(50).waitFor();
    const table = Date.now() - begin;
    await page.locator('.chart canvas').waitFor();
    console.log(`     table after ${table} ms, curves after ${Date.now() - begin} ms`);
    assert.ok((await points(page)) > 1000);
    await page.getByRole('button', { name: 'Show older jobs' }).click();
    await page.locator('table.jobs tbody tr').nth(150).waitFor();
  },
};

/** Serious findings of axe on a page. */
async function findings(page, name) {
  if (!(await page.evaluate(() => 'axe' in globalThis))) await page.evaluate(axeSource);
  const { violations } = await page.evaluate(() => globalThis.axe.run(document, { resultTypes: ['violations'] }));
  return violations.filter(({ impact }) => ['serious', 'critical'].includes(impact))
    .map(({ id, nodes }) => `axe: ${name}: ${id}: ${nodes.slice(0, 3).map((node) => `${node.html.slice(0, 160)} ${node.any[0]?.message ?? ''}`).join(' | ')}`);
}

async function picture(page, name) {
  mkdirSync(pictures, { recursive: true });
  await page.waitForTimeout(700);
  await page.screenshot({ path: join(pictures, `${name.replace(/[^a-z0-9]+/gi, '-').replace(/[0-9a-f]{8}-[0-9a-f-]{27}/, 'ID')}.png`), fullPage: !name.startsWith('console') });
}

let failed = 0;
const only = process.env.QEDGIX_WEB_ONLY;
const started = Date.now();
for (const [name, test] of Object.entries(tests)) {
  if (only && !name.includes(only)) continue;
  const begin = Date.now();
  problems.length = 0;
  let error = null;
  try {
    await test();
    if (problems.length) throw new Error([...new Set(problems)].join('\n'));
  } catch (e) {
    error = e;
    failed += 1;
  }
  for (const context of browser.contexts()) {
    if (error && pictures) for (const page of context.pages()) await picture(page, `failed-${name.slice(0, 20)}`).catch(() => {});
    await context.close();
  }
  console.log(`${error ? 'FAIL' : 'ok  '} ${name} (${((Date.now() - begin) / 1000).toFixed(1)} s)`);
  if (error) console.log(String(error.stack ?? error).replace(/^/gm, '     '));
}
await browser.close();
await Promise.all(servers.map((server) => server.close()));
console.log(`tests of the dashboard: ${failed ? `${failed} failed` : 'all passed'} in ${((Date.now() - started) / 1000).toFixed(0)} s`);
process.exit(failed ? 1 : 0);
