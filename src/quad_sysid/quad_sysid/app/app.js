// The page of quad-sysid app: files, jobs, and the report of the chosen job in a sandboxed frame.
'use strict';
const $ = id => document.getElementById(id);
const chosen = new Set(); let shown = 0, mode = 'zoom', files = [], known = '', ended = null, last = Promise.resolve();
const say = text => { $('say').textContent = text; };
async function ask(path, options) {
  let answer;
  try { answer = await fetch(path, options); } catch (e) {
    throw new Error('no answer: start quad-sysid app again, and open the address that it prints');
  }
  if (!answer.ok) {
    let why = await answer.text() || answer.statusText;
    try { why = JSON.parse(why).error || why; } catch (e) { /* plain text */ }
    throw new Error(why);
  }
  return answer;
}
const guarded = act => async (...given) => { try { await act(...given); } catch (e) { say(e.message); } };
async function listFiles() {
  files = await (await ask('/files')).json();
  const list = $('files'); list.replaceChildren();
  for (const name of [...chosen]) if (!files.some(f => f.path === name)) chosen.delete(name);
  for (const file of files) {
    const item = document.createElement('li'), label = document.createElement('label');
    const box = document.createElement('input'); box.type = 'checkbox'; box.checked = chosen.has(file.path);
    box.onchange = () => {
      if (box.checked) chosen.add(file.path); else chosen.delete(file.path);
      clearWindows();
    };
    label.append(box, ' ' + file.path + ' '); const more = document.createElement('span');
    more.className = 'small'; more.textContent = file.kind + ', ' + (file.megabytes < 0.1 ? Math.ceil(1e3 * file.megabytes) + ' kB' : file.megabytes.toFixed(1) + ' MB');
    label.append(more); item.append(label); list.append(item);
  }
  const note = !files.length ? 'no logs here yet' : files.length >= 500 ? 'there are more: start the app on a smaller folder' : '';
  if (note) list.append(Object.assign(document.createElement('li'), {textContent: note}));
}
const upload = guarded(async picked => {
  const done = [], paths = [], most = +$('drop').dataset.most;
  for (const file of picked) {
    say('reading in ' + file.name);
    try {
      // a browser loses the answer of a server that hangs up while it sends
      if (file.size > most) throw new Error(file.name + ': larger than ' + (most / 1e6).toFixed(0) + ' MB: start quad-sysid app with a larger --most-mb');
      const answer = await ask('/upload?name=' + encodeURIComponent(file.name), {method: 'POST', body: file});
      const path = (await answer.json()).path; paths.push(path);
      done.push(path === file.name ? path + ' is there' : file.name + ' is there as ' + path);
    } catch (e) { done.push(e.message); }
  }
  say(done.join('; ') || 'no log was dropped: drop files, or a folder that holds them');
  if (paths.length) { chosen.clear(); paths.forEach(path => chosen.add(path)); clearWindows(); }
  await listFiles();
});
async function within(entry) { // the files of what is dropped: of folders those with data, at any depth
  if (entry.isFile) return [await new Promise((take, fail) => entry.file(take, fail))];
  const reader = entry.createReader(), found = [];
  for (let some; (some = await new Promise((take, fail) => reader.readEntries(take, fail))).length;) found.push(...some);
  return (await Promise.all(found.filter(one => one.name !== 'metadata.yaml').map(within))).flat();
}
const start = (kind, given) => () => {
  const body = {kind, files: [...chosen], axis: $('axis').value, to: $('to').value, scale: $('scale').value.trim(), ...(given && given())};
  if (kind === 'identify') { body.train = $('train').value.trim(); body.validate = $('validate').value.trim(); }
  last = last.then(guarded(async () => { // one after the other: the answer to an earlier one may come later
    const job = await (await ask('/jobs', {method: 'POST', body: JSON.stringify(body)})).json();
    shown = job.number; known = ''; say(job.title + ' was put into the queue'); await listJobs();
  }));
};
const rows = new Map(); // the line of each job: never made anew, or a press and the keyboard's place on it were lost
function row(job) {
  const item = document.createElement('li'), open = document.createElement('button'), state = document.createElement('span');
  open.textContent = job.title; open.onclick = () => { shown = job.number; known = ''; listJobs(); };
  state.className = 'small'; item.append(open, state);
  const stop = document.createElement('button'); stop.textContent = 'stop';
  stop.setAttribute('aria-label', 'stop ' + job.title);
  stop.onclick = guarded(async () => { await ask('/jobs/' + job.number + '/stop', {method: 'POST'}); await listJobs(); });
  const bar = document.createElement('progress'); bar.setAttribute('aria-label', 'progress of ' + job.title);
  return {item, state, stop, bar};
}
const goesOn = job => job.state === 'waiting' || job.state === 'running';
async function listJobs() {
  const jobs = await (await ask('/jobs')).json();
  if (!shown && jobs.length) shown = jobs[0].number; // a new tab begins with the latest
  for (const [number, {item}] of rows) if (!jobs.some(job => job.number === number)) { item.remove(); rows.delete(number); }
  for (const job of [...jobs].reverse()) {
    if (!rows.has(job.number)) { rows.set(job.number, row(job)); $('jobs').prepend(rows.get(job.number).item); }
    const {item, state, stop, bar} = rows.get(job.number);
    state.textContent = ' ' + job.state + (job.seconds ? ', ' + job.seconds.toFixed(0) + ' s' : '')
      + (job.left === null ? '' : job.left > 0 ? ', about ' + job.left.toFixed(0) + ' s left' : ', longer than usual')
      + (job.doing && job.state !== 'done' ? ': ' + job.doing : '') + ' ';
    for (const [part, wanted] of [[stop, ['running', 'waiting']], [bar, ['running']]]) {
      if (!wanted.includes(job.state)) part.remove(); else if (!part.isConnected) item.append(part);
    }
    if (job.left > 0) bar.value = job.seconds / (job.seconds + job.left); else bar.removeAttribute('value');
    if (job.number === shown) await show(job);
  }
  const now = jobs.filter(job => !goesOn(job)).map(job => job.number).join();
  if (now !== ended) { ended = now; await listFiles(); } // what it wrote, whichever is shown
}
async function show(job) {
  const key = job.number + job.state + job.pages.join();
  if (key === known) return;
  known = key; $('title').textContent = job.title + (goesOn(job) ? ', ' + job.state : ''); $('hint').hidden = true;
  const tabs = $('tabs'); tabs.replaceChildren();
  const view = guarded(async page => {
    const text = page ? '' : await (await ask('/jobs/' + job.number + '/text')).text();
    if (key !== known) return; // another job was chosen meanwhile
    const table = !page && job.kind === 'import' && job.state === 'done' && columns(job, text);
    const frame = $('frame').cloneNode(); // in a frame that stays, the browser's Back would bring another job's page
    delete frame.dataset.traces; frame.src = page ? '/jobs/' + job.number + '/' + page : 'about:blank';
    frame.hidden = !page; $('text').hidden = !!page || table; $('menus').hidden = !table;
    $('frame').replaceWith(frame); $('text').querySelector('pre').textContent = text;
  });
  for (const page of [...job.pages, '']) {
    const tab = document.createElement('button'); tab.textContent = page ? 'page' : 'text';
    tab.onclick = () => view(page); tabs.append(tab);
  }
  if (goesOn(job)) { for (const id of ['frame', 'text', 'menus']) $(id).hidden = true; return; } // another job's
  await view(job.state === 'done' || job.state === 'no answer' ? job.pages[0] || '' : '');
}
function columns(job, text) { // the menus of a table whose columns were listed
  let found; try { found = JSON.parse(text); } catch (e) { return false; }
  const axes = ['roll', 'pitch', 'yaw'], roles = [['', '']];
  for (const option of Object.keys(found.units)) {
    if (option === 'motors') for (let k = 1; k <= 8; k++) roles.push(['motor ' + k, option]);
    else if (['time', 'thrust', 'battery'].includes(option)) roles.push([option, option]);
    else if (!['acceleration', 'velocity', 'position'].includes(option)) axes.forEach(axis => roles.push([option + ', ' + axis, option]));
  }
  const body = $('menus').querySelector('tbody'); body.replaceChildren();
  const menu = (values, value, label) => {
    const one = document.createElement('select'); one.setAttribute('aria-label', label);
    values.forEach(v => one.append(new Option(v.replace('_', ' ') || '–', v))); one.value = value; return one;
  };
  for (const column of found.columns) {
    const row = body.insertRow(); row.dataset.column = column.name;
    for (const text of [column.name, column.lowest, column.highest]) row.insertCell().textContent = text;
    const role = menu(roles.map(r => r[0]), column.role, 'what ' + column.name + ' is');
    const cell = row.insertCell(); cell.append(role); const where = row.insertCell();
    const unit = value => {
      const option = roles.find(r => r[0] === role.value)[1];
      where.replaceChildren(menu(['', ...(found.units[option] || [])], value, 'unit of ' + column.name));
    };
    unit(column.unit); role.onchange = () => unit('');
  }
  if (found.refused) say('as guessed the import refuses it: ' + found.refused);
  $('take').onclick = start('import', () => ({files: job.files, columns: [...body.rows].map(row => [row.dataset.column, ...[...row.querySelectorAll('select')].map(s => s.value)])}));
  return true;
}
const span = id => { const m = /^\s*([\d.]+)\s*:\s*([\d.]+)\s*$/.exec($(id).value); return m && [+m[1], +m[2]]; };
function tell() {
  const marks = [];
  for (const [id, colour] of [['train', '--blue'], ['validate', '--orange']]) {
    const found = span(id); if (found) marks.push({start: found[0], end: found[1], colour});
  }
  $('frame').contentWindow.postMessage({zoom: true, mode, marks}, '*');
}
function clearWindows() { $('train').value = $('validate').value = ''; tell(); } // they were those of other flights
addEventListener('message', e => {
  if (e.source !== $('frame').contentWindow || !e.data) return;
  if (e.data.zoomReady !== undefined) { $('frame').dataset.traces = e.data.zoomReady; tell(); }
  const s = e.data.zoomSelect;
  if (s && (s.mode === 'train' || s.mode === 'validate') && isFinite(s.start) && isFinite(s.end)) {
    $(s.mode).value = s.start.toFixed(2) + ':' + s.end.toFixed(2); tell();
  }
});
for (const id of ['train', 'validate']) $(id).oninput = tell;
document.querySelectorAll('input[name=mode]').forEach(one => { one.onchange = () => { mode = one.value; tell(); }; });
$('file').onchange = () => { upload([...$('file').files]); $('file').value = ''; }; // or the same file again were no change
const drop = $('drop');
for (const name of ['dragover', 'dragleave', 'drop']) addEventListener(name, e => {
  e.preventDefault(); drop.classList.toggle('over', name === 'dragover');
  if (name === 'drop') {
    const all = [...e.dataTransfer.items].map(one => one.webkitGetAsEntry()).filter(Boolean);
    guarded(async () => upload((await Promise.all(all.map(within))).flat()))();
  }
});
for (const kind of ['look', 'columns', 'inspect', 'import', 'schedule', 'identify', 'compare', 'export']) $(kind).onclick = start(kind);
$('copy').onclick = () => {
  getSelection().selectAllChildren($('text').querySelector('pre')); document.execCommand('copy'); say('copied');
};
document.onvisibilitychange = guarded(listFiles);
guarded(listJobs)(); setInterval(guarded(listJobs), 1000);
