// Sliders of the gains of an axis: its step, margins and noise from the found model, at once.
// The controller is that of loop/kernels.py, the margins are those of loop/cascade.py.
'use strict';
(() => {
class Tryout {
  constructor(box) {
    this.box = box; this.d = JSON.parse(box.querySelector('script').textContent);
    const cols = row => Float64Array.from(row), d = this.d;
    this.a = d.a.map(cols); this.b = cols(d.b); this.c = d.c.map(cols);
    this.gains = d.flown.slice(); this.inputs = [];
    this.before = this.step(d.flown); this.noise = this.margins(d.flown).noise;
    d.names.forEach((name, i) => { if (d.flown[i] > 0) this.slider(name, i); });
    const bar = document.createElement('div'); bar.className = 'zoombar';
    for (const [label, values] of [['as flown', d.flown], ['as designed', d.designed]]) if (values) {
      const button = document.createElement('button'); button.type = 'button'; button.textContent = label;
      button.onclick = () => { this.gains = values.slice(); this.show(); }; bar.append(button);
    }
    const drawing = document.createElement('div');
    drawing.innerHTML = '<svg viewBox="0 0 440 170" role="img" '
      + 'aria-label="simulated step: as flown and with the gains of the sliders"></svg>';
    this.svg = drawing.firstChild;
    this.say = document.createElement('p'); this.say.setAttribute('aria-live', 'polite');
    this.text = document.createElement('pre'); this.text.tabIndex = 0;
    box.append(bar, this.svg, this.say, this.text); this.show();
  }
  slider(name, i) {
    const label = document.createElement('label'), input = document.createElement('input');
    input.type = 'range'; input.min = -2; input.max = 2; input.step = 0.02; input.dataset.gain = name;
    const value = document.createElement('output');
    input.oninput = () => { this.gains[i] = this.d.flown[i] * 2 ** +input.value; this.show(); };
    label.append(name + ' ', input, ' ', value); this.box.append(label); this.inputs.push([input, value, i]);
  }
  controller(gains) {
    const k = this.d.constants, [akp, kp, ki, kd] = gains;
    const m = {target: 0, error: 0, integral: 0, d: 0, last: 0, out: 0, n0: 0, n1: 0, was: 0};
    const low = (key, x, w) => { if (w >= 1) return x; m[key] += w * (x - m[key]); return m[key]; };
    const clip = (x, l) => Math.min(Math.max(x, -l), l);
    return (reference, angle, rate, added) => {
      const target = low('target', clip(akp * (reference - angle), k.rate_limit) + added, k.target_weight);
      const error = low('error', target - rate, k.error_weight);
      m.integral = clip(m.integral + ki * error * k.dt, k.integrator_limit);
      let now = k.d_on_error > 0 ? -error : rate;
      if (k.notch < 1) {
        const seen = k.notch * now + m.n0;
        m.n0 = k.notch_turn * (now - seen) + m.n1; m.n1 = k.notch * now - k.notch_keep * seen; now = seen;
      }
      m.d += k.d_weight * ((now - m.last) / k.dt - m.d); m.last = now;
      const forward = k.kff * target + k.kff_slope * (added - m.was) / k.dt; m.was = added; // of the stick alone
      return clip(low('out', kp * error + m.integral - kd * m.d + forward, k.output_weight), k.output_limit);
    };
  }
  step(gains) {
    const {a, b, c, d} = this, n = b.length, act = this.controller(gains), held = d.flown[0] > 0;
    let x = new Float64Array(n), y = new Float64Array(n); const out = new Float64Array(d.steps);
    for (let k = 0; k < d.steps; k++) {
      let rate = 0, angle = 0;
      for (let j = 0; j < n; j++) { rate += c[0][j] * x[j]; angle += c[1][j] * x[j]; }
      out[k] = (held ? angle : rate) / d.size;
      const u = act(held ? d.size : 0, angle, rate, held ? 0 : d.size * Math.min(1, (k + 1) * d.dt / d.rise_s));
      for (let i = 0; i < n; i++) { let s = b[i] * u; const row = a[i]; for (let j = 0; j < n; j++) s += row[j] * x[j]; y[i] = s; }
      [x, y] = [y, x];
    }
    return out;
  }
  margins(gains) {
    const d = this.d, [akp, kp, ki, kd] = gains, on = d.constants.d_on_error > 0, w = d.omega;
    let phase = Infinity, gain = Infinity, worst = 0, cross = NaN, noise = 0, span = 0;
    for (let p = 0; p < d.rate.re.length; p++) {
      let lowBefore = 0, angleBefore = 0, turn = 0;
      for (let f = 0; f < w.length; f++) {
        let er = 0, ei = 0, tr = 0, ti = 0;
        [kp, ki, kd].forEach((g, i) => {
          const re = g * d.parts.re[i][f], im = g * d.parts.im[i][f]; er += re; ei += im;
          if (i < 2 || on) { tr += re; ti += im; }
        });
        const Tr = d.target.re[f], Ti = d.target.im[f];
        const ar = akp * (Tr * tr - Ti * ti + d.constants.kff * d.forward.re[f]);
        const ai = akp * (Tr * ti + Ti * tr + d.constants.kff * d.forward.im[f]);
        const Pr = d.rate.re[p][f], Pi = d.rate.im[p][f], Ar = d.angle.re[p][f], Ai = d.angle.im[p][f];
        const re = -(Pr * er - Pi * ei + Ar * ar - Ai * ai), im = -(Pr * ei + Pi * er + Ar * ai + Ai * ar);
        const away = Math.hypot(1 + re, im), low = Math.log(Math.hypot(re, im) || 1e-300);
        worst = Math.max(worst, 1 / away);
        if (p === 0 && f) {
          const part = w[f] - w[f - 1]; noise += part * (er * er + ei * ei) / (away * away); span += part;
        }
        let at = Math.atan2(im, re) + turn;
        if (f) {
          while (at - angleBefore > Math.PI) { at -= 2 * Math.PI; turn -= 2 * Math.PI; }
          while (at - angleBefore < -Math.PI) { at += 2 * Math.PI; turn += 2 * Math.PI; }
          if ((lowBefore > 0) !== (low > 0)) {
            const s = lowBefore / (lowBefore - low), here = angleBefore + s * (at - angleBefore), full = 2 * Math.PI;
            phase = Math.min(phase, Math.abs(((here % full) + full) % full - Math.PI) * 180 / Math.PI);
            if (lowBefore > 0) cross = Math.max(cross || 0, Math.exp(Math.log(w[f - 1]) + s * Math.log(w[f] / w[f - 1])));
          }
          const t0 = (angleBefore - Math.PI) / (2 * Math.PI), t1 = (at - Math.PI) / (2 * Math.PI);
          if (Math.floor(t0) !== Math.floor(t1)) {
            const s = (Math.max(Math.floor(t0), Math.floor(t1)) - t0) / (t1 - t0);
            gain = Math.min(gain, Math.abs(lowBefore + s * (low - lowBefore)) * 20 / Math.LN10);
          }
        }
        lowBefore = low; angleBefore = at;
      }
    }
    return {phase, gain, worst, cross, noise: Math.sqrt(noise / span)};
  }
  figures(y) {
    const n = y.length, tail = y.slice(Math.floor(0.8 * n)), end = tail.reduce((s, v) => s + v, 0) / tail.length;
    const first = v => { const k = y.findIndex(x => x >= v * end); return k < 0 ? NaN : k * this.d.dt; };
    const swing = Math.max(...tail) - Math.min(...tail), top = Math.max(...y);
    return {rise: first(0.9) - first(0.1), over: 100 * Math.max(0, top / end - 1), restless: !(swing < 0.5) || !isFinite(swing)};
  }
  show() {
    const begun = performance.now(), now = this.step(this.gains), m = this.margins(this.gains), s = this.figures(now);
    for (const [input, value, i] of this.inputs) {
      const factor = this.gains[i] / this.d.flown[i];
      input.value = Math.log2(factor); value.textContent = +this.gains[i].toPrecision(3) + ', × ' + factor.toFixed(2);
    }
    const top = Math.min(3, Math.max(1.3, ...now, ...this.before)) * 1.05, low = Math.max(-1, Math.min(0, ...now));
    const X = k => 40 + 390 * k / now.length, Y = v => 10 + 130 * (top - v) / (top - low);
    const every = Math.max(1, Math.floor(now.length / 400));
    const path = (y, colour) => {
      let text = '';
      for (let k = 0; k < y.length; k += every) text += (k ? 'L' : 'M') + X(k).toFixed(1) + ' ' + Y(Math.max(-5, Math.min(9, y[k]))).toFixed(1);
      return '<path d="' + text + '" fill="none" stroke="var(' + colour + ')" stroke-width="1.4"/>';
    };
    const words = (x, y, text, how) => '<text x="' + x + '" y="' + y + '" font-size="10" fill="var(--ink)" text-anchor="' + how + '">' + text + '</text>';
    let drawn = '';
    for (const v of [0, 1]) drawn += '<path d="M40 ' + Y(v) + 'H430" stroke="var(--grid)"/>' + words(34, Y(v) + 3, v, 'end');
    const seconds = this.d.steps * this.d.dt;
    for (let t = 0; t < seconds; t += 0.2) drawn += words(X(t / this.d.dt), 155, t.toFixed(1), 'middle');
    drawn += words(430, 168, 'time after the step, s', 'end') + words(428, 20, 'blue: these gains, grey: as flown', 'end');
    this.svg.innerHTML = drawn + path(this.before, '--muted') + path(now, '--blue');
    const n = (v, digits, unit) => isFinite(v) ? v.toFixed(digits) + unit : 'none';
    this.say.textContent = s.restless || m.phase < 1 ? 'Does not settle with these gains.' :
      'Rise ' + n(1e3 * s.rise, 0, ' ms') + ', overshoot ' + n(s.over, 0, ' %') + '; crossover ' + n(m.cross, 1, ' rad/s')
      + ', phase margin ' + n(m.phase, 0, '°') + ', gain margin ' + n(m.gain, 1, ' dB') + ', peak of sensitivity '
      + m.worst.toFixed(2) + '; noise in the command × ' + (m.noise / this.noise).toFixed(2) + '.';
    this.text.textContent = this.inputs.map(([,, i]) => this.d.names[i] + ': ' + +this.gains[i].toPrecision(4)).join('\n');
    this.found = {...m, ...s, step: now, redraw_ms: performance.now() - begun};
  }
}
document.querySelectorAll('.tryout').forEach(box => { box.tryout = new Tryout(box); });
})();
