// Time series that zoom: linked rows on canvases, from int16 samples or their lowest and highest
// per bin. Nothing is loaded. Fires 'zoom-select' {start, end} where the group's mode is not zoom.
'use strict';
(() => {
const LOST = -32768, LEFT = 64, RIGHT = 8, BOTTOM = 20;
const decode = text => {
  const raw = atob(text), bytes = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
  return new Int16Array(bytes.buffer);
};
const ticks = (low, high, most) => {
  const raw = (high - low) / Math.max(most, 1), power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map(k => k * power).find(s => s >= raw) || power * 10;
  const out = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) out.push(k * step);
  return out.length < 2 ? ticks(low, high, 2 * most) : [out, step];  // one alone shows no scale
};
const text = (v, step) => v.toFixed(Math.max(0, Math.min(6, -Math.floor(Math.log10(step) + 1e-9))));

class Group {
  constructor(box) {
    this.box = box; this.data = JSON.parse(box.querySelector('script').textContent);
    this.mode = 'zoom'; this.a = 0; this.b = this.data.length_s; this.marks = this.data.marks || [];
    for (const row of this.data.rows) for (const line of row.lines) line.values = decode(line.data);
    this.rows = this.data.rows.map(row => this.add(row));
    this.say = document.createElement('p'); this.say.className = 'small zoomsay';
    this.say.setAttribute('aria-live', 'polite'); box.append(this.say);
    this.buttons(); this.keys(); this.resize();
    new ResizeObserver(() => this.resize()).observe(box);
    matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => this.draw());
  }
  add(row) {
    const head = document.createElement('div'); head.className = 'zoomhead';
    head.append(row.label + ' ');
    row.lines.forEach(line => {
      const item = document.createElement('span'); item.textContent = line.name;
      item.style.borderBottom = '3px solid var(' + line.colour + ')'; head.append(item);
    });
    const canvas = document.createElement('canvas'); canvas.className = 'zoomrow';
    this.box.append(head, canvas); this.mouse(canvas); return {row, canvas};
  }
  buttons() {
    const bar = document.createElement('div'); bar.className = 'zoombar';
    for (const [label, title, act] of [['+', 'zoom in', () => this.zoom(0.5)],
      ['−', 'zoom out', () => this.zoom(2)], ['←', 'earlier', () => this.pan(-0.3)],
      ['→', 'later', () => this.pan(0.3)], ['all', 'all of it', () => this.view(0, this.data.length_s)]]) {
      const button = document.createElement('button'); button.type = 'button';
      button.textContent = label; button.title = title; button.setAttribute('aria-label', title);
      button.onclick = act; bar.append(button);
    }
    this.box.prepend(bar);
  }
  keys() {
    this.box.tabIndex = 0; this.box.setAttribute('role', 'group');
    this.box.addEventListener('keydown', e => {
      if (e.target !== this.box) return;
      const act = {ArrowLeft: () => this.pan(-0.2), ArrowRight: () => this.pan(0.2),
        '+': () => this.zoom(0.7), '=': () => this.zoom(0.7), '-': () => this.zoom(1.4),
        '0': () => this.view(0, this.data.length_s)}[e.key];
      if (act) { act(); e.preventDefault(); }
    });
  }
  time(canvas, x) { return this.a + (x - LEFT) / (canvas.clientWidth - LEFT - RIGHT) * (this.b - this.a); }
  mouse(canvas) {
    const fingers = new Map(); let from = null, pinch = 0;
    canvas.addEventListener('wheel', e => {
      if (!e.ctrlKey && !e.altKey && document.activeElement !== this.box) return;
      e.preventDefault(); this.zoom(e.deltaY > 0 ? 1.25 : 0.8, this.time(canvas, e.offsetX));
    }, {passive: false});
    canvas.addEventListener('pointerdown', e => {
      this.box.focus({preventScroll: true}); fingers.set(e.pointerId, e.offsetX);
      if (e.pointerType === 'touch') { if (fingers.size === 2) pinch = this.spread(fingers); return; }
      canvas.setPointerCapture(e.pointerId); from = {x: e.offsetX, pan: e.shiftKey || e.button === 1, a: this.a, b: this.b};
    });
    canvas.addEventListener('pointermove', e => {
      if (e.pointerType === 'touch' && fingers.has(e.pointerId)) {
        const last = fingers.get(e.pointerId); fingers.set(e.pointerId, e.offsetX);
        if (fingers.size === 2) {
          const now = this.spread(fingers), [p, q] = [...fingers.values()];
          if (now > 5 && pinch > 5) this.zoom(pinch / now, this.time(canvas, (p + q) / 2));
          pinch = now;
        } else this.pan((last - e.offsetX) / (canvas.clientWidth - LEFT - RIGHT));
        return;
      }
      if (from && from.pan) {
        const move = (from.x - e.offsetX) / (canvas.clientWidth - LEFT - RIGHT) * (from.b - from.a);
        this.view(from.a + move, from.b + move); return;
      }
      if (from) { this.drag = [this.time(canvas, from.x), this.time(canvas, e.offsetX)]; this.draw(); }
      this.read(this.time(canvas, e.offsetX));
    });
    const up = e => {
      fingers.delete(e.pointerId);
      if (!from) return;
      const [a, b] = [this.time(canvas, from.x), this.time(canvas, e.offsetX)].sort((p, q) => p - q);
      const far = Math.abs(e.offsetX - from.x) > 4, pan = from.pan; from = null; this.drag = null;
      if (far && !pan) this.select(a, b); else this.draw();
    };
    canvas.addEventListener('pointerup', up); canvas.addEventListener('pointercancel', up);
    canvas.addEventListener('dblclick', () => this.view(0, this.data.length_s));
  }
  spread(fingers) { const [p, q] = [...fingers.values()]; return Math.abs(p - q); }
  select(a, b) {
    a = Math.max(0, a); b = Math.min(this.data.length_s, b);
    if (this.mode === 'zoom') this.view(a, b);
    else { this.draw(); this.box.dispatchEvent(new CustomEvent('zoom-select', {bubbles: true, detail: {mode: this.mode, start: a, end: b}})); }
  }
  zoom(factor, around) {
    const c = around === undefined ? (this.a + this.b) / 2 : around;
    this.view(c - (c - this.a) * factor, c + (this.b - c) * factor);
  }
  pan(share) { const w = (this.b - this.a) * share; this.view(this.a + w, this.b + w); }
  view(a, b) {
    const all = this.data.length_s, width = Math.min(all, Math.max(b - a, 10 * this.data.dt));
    this.a = Math.max(0, Math.min(a, all - width)); this.b = this.a + width; this.draw();
  }
  resize() {
    for (const {canvas} of this.rows) {
      const ratio = window.devicePixelRatio || 1;
      canvas.width = Math.round(canvas.clientWidth * ratio); canvas.height = Math.round(canvas.clientHeight * ratio);
    }
    this.draw();
  }
  read(t) {
    const parts = this.rows.map(({row}) => row.label + ': ' + row.lines.map(line => {
      const i = Math.floor(t / (this.data.dt * line.every)) * (line.every > 1 ? 2 : 1), v = line.values[i];
      return line.name + ' ' + (v === undefined || v === LOST ? '–' : (line.offset + v * line.scale).toPrecision(3));
    }).join(', '));
    this.say.textContent = t.toFixed(3) + ' s; ' + parts.join('; ');
  }
  range(line) {
    const pair = line.every > 1 ? 2 : 1, bin = this.data.dt * line.every;
    const i = Math.max(0, Math.floor(this.a / bin) - 1), j = Math.min(line.values.length / pair, Math.ceil(this.b / bin) + 1);
    return [i, j, pair, bin];
  }
  draw() { if (!this.due) this.due = requestAnimationFrame(() => { this.due = 0; this.rows.forEach(r => this.paint(r)); }); }
  paint({row, canvas}) {
    const g = canvas.getContext('2d'), ratio = window.devicePixelRatio || 1;
    const w = canvas.clientWidth, h = canvas.clientHeight, style = getComputedStyle(this.box);
    const colour = name => style.getPropertyValue(name).trim() || '#888';
    g.setTransform(ratio, 0, 0, ratio, 0, 0); g.clearRect(0, 0, w, h);
    let low = Infinity, high = -Infinity;
    for (const line of row.lines) {
      const [i, j, pair] = this.range(line);
      for (let k = i * pair; k < j * pair; k++) {
        const v = line.values[k]; if (v === LOST) continue;
        const y = line.offset + v * line.scale; if (y < low) low = y; if (y > high) high = y;
      }
    }
    if (!(high > low)) { const c = isFinite(low) ? low : 0; low = c - 1; high = c + 1; }
    const pad = 0.05 * (high - low); low -= pad; high += pad;
    const width = w - LEFT - RIGHT, height = h - BOTTOM - 4;
    const X = t => LEFT + (t - this.a) / (this.b - this.a) * width, Y = v => 4 + (high - v) / (high - low) * height;
    g.font = '11px system-ui, sans-serif'; g.strokeStyle = colour('--grid'); g.fillStyle = colour('--ink'); g.lineWidth = 1;
    const [ys, ystep] = ticks(low, high, Math.max(2, Math.floor(height / 34)));
    g.textAlign = 'right'; g.textBaseline = 'middle';
    for (const v of ys) { g.beginPath(); g.moveTo(LEFT, Y(v)); g.lineTo(LEFT + width, Y(v)); g.stroke(); g.fillText(text(v, ystep), LEFT - 4, Y(v)); }
    const [xs, xstep] = ticks(this.a, this.b, Math.max(2, Math.floor(width / 80)));
    g.textAlign = 'center'; g.textBaseline = 'top';
    for (const t of xs) { g.beginPath(); g.moveTo(X(t), 4); g.lineTo(X(t), 4 + height); g.stroke(); g.fillText(text(t, xstep) + (t === xs[xs.length - 1] ? ' s' : ''), X(t), h - BOTTOM + 5); }
    g.save(); g.beginPath(); g.rect(LEFT, 4, width, height); g.clip();
    const least = 4 * this.marks.length < width ? 1 : 0;  // so many that they overlap would add up to opaque
    const shade = (a, b, name) => { g.globalAlpha = 0.15; g.fillStyle = colour(name); g.fillRect(X(a), 4, Math.max(least, X(b) - X(a)), height); g.globalAlpha = 1; };
    for (const m of this.marks) shade(m.start, m.end, m.colour);
    if (this.drag) shade(Math.min(...this.drag), Math.max(...this.drag), '--blue');
    for (const line of row.lines) {
      const [i, j, pair, bin] = this.range(line);
      g.strokeStyle = colour(line.colour); g.lineWidth = 1.2; g.beginPath();
      let pen = false;
      if (j - i <= 2 * width) {
        for (let k = i; k < j; k++) for (let q = 0; q < pair; q++) {
          const v = line.values[k * pair + q]; if (v === LOST) { pen = false; continue; }
          const x = X(k * bin), y = Y(line.offset + v * line.scale);
          if (pen) g.lineTo(x, y); else g.moveTo(x, y); pen = true;
        }
      } else {
        const per = (j - i) / width;
        for (let p = 0; p < width; p++) {
          let lo = Infinity, hi = -Infinity;
          for (let k = Math.floor(i + p * per) * pair, e = Math.floor(i + (p + 1) * per) * pair; k < e; k++) {
            const v = line.values[k]; if (v === LOST) continue; if (v < lo) lo = v; if (v > hi) hi = v;
          }
          if (hi < lo) { pen = false; continue; }
          const x = X((i + (p + 0.5) * per) * bin), y1 = Y(line.offset + lo * line.scale), y2 = Y(line.offset + hi * line.scale);
          if (pen) g.lineTo(x, y1); else g.moveTo(x, y1); g.lineTo(x, y2); pen = true;
        }
      }
      g.stroke();
    }
    g.restore();
  }
}
document.querySelectorAll('.zoom').forEach(box => { box.group = new Group(box); });
// Within the app's frame: it says what a drag selects, and is told what was selected.
if (window.parent !== window) {
  const groups = [...document.querySelectorAll('.zoom')].map(box => box.group);
  const own = groups.map(g => g.marks);
  addEventListener('message', e => {
    if (e.source !== window.parent || !e.data || !e.data.zoom) return;
    groups.forEach((g, k) => {
      g.mode = e.data.mode || 'zoom'; const drawn = e.data.marks || []; // they replace what was proposed in the same colour
      g.marks = own[k].filter(m => !drawn.some(d => d.colour === m.colour)).concat(drawn); g.draw();
    });
  });
  addEventListener('zoom-select', e => window.parent.postMessage({zoomSelect: e.detail}, '*'));
  window.parent.postMessage({zoomReady: groups.length}, '*');
}
})();
