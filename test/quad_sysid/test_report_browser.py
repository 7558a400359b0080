"""The page in a real browser at desktop and phone width: sizes, no sideways scroll, no errors."""

import dataclasses
import html
import json
import re
import shutil
import subprocess

import numpy as np
import pytest
from probe import PATIENCE_S

from quad_sysid.loop.cascade import CascadeGains, margins, open_loop
from quad_sysid.loop.from_model import loop_plant
from quad_sysid.loop.linear import WIDE, loops_of
from quad_sysid.loop.simulation import simulate_cascade
from quad_sysid.model import AxisModel, Parameter
from quad_sysid.pipeline.answer import AxisAnswer
from quad_sysid.report import canvas, document, plots, sliders
from quad_sysid.report.html import page

NAMES = ('chromium', 'chromium-browser', 'google-chrome')
BROWSER = next((name for name in NAMES if shutil.which(name)), '')
MEASURE = """<script>window.addEventListener('load', () => {
const boxes = [...document.querySelectorAll('figure svg')].map(s => {
  const r = s.getBoundingClientRect(); return [r.width, r.height]; });
const fonts = [...document.querySelectorAll('figure svg text')].map(
  t => t.getBoundingClientRect().height);
document.body.dataset.measured = JSON.stringify({boxes, smallest: Math.min(...fonts),
  page: document.documentElement.scrollWidth, window: window.innerWidth,
  ink: getComputedStyle(document.querySelector('figure svg text')).fill,
  paper: getComputedStyle(document.body).backgroundColor});
});</script></body>"""

pytestmark = [pytest.mark.browser, pytest.mark.skipif(
    not BROWSER, reason='no Chromium here (apt-get install chromium)')]


def look(text: str, folder, width: int, *, dark: bool, measure: str = MEASURE) -> dict:
    """What the browser measured; raises where it logged an error."""
    path = folder / 'page.html'
    path.write_text(text.replace('</body>', measure))
    done = subprocess.run(
        [BROWSER, '--headless', '--no-sandbox', '--disable-gpu', '--disable-dev-shm-usage',
         '--disable-background-networking', f'--user-data-dir={folder / "profile"}',
         f'--blink-settings=preferredColorScheme={0 if dark else 1}', '--enable-logging=stderr',
         f'--window-size={width},2000', '--dump-dom', path.as_uri()],
        capture_output=True, text=True, timeout=PATIENCE_S, check=True,
    )
    assert 'CONSOLE' not in done.stderr
    found = re.search(r'data-measured="([^"]*)"', done.stdout)
    assert found, done.stderr[-500:]
    return json.loads(html.unescape(found.group(1)))


@pytest.fixture(scope='module')
def text() -> str:
    """A page with two figures of two heights and a wide table; no fit is needed to lay it out."""
    answer = AxisAnswer('roll', 250.0, (), 'cannot_tell', 'too short')
    tree = document.document({'roll': answer}, ['bag'])
    tree['axes']['roll']['models'] = [
        {'structure': 'ARX', 'orders': {'na': 10, 'nb': 10, 'nk': 5}, 'approach': 'direct',
         'fit_train_pct': 99.0, 'fit_validation_pct': {'prbs': 90.0, 'square': 80.0},
         'residual_white': False, 'residual_uncorrelated_with_input': True, 'causal': True,
         'passed_first_step': False, 'eliminated_because': 'residual is not white ' * 5},
    ]
    pictures = {}
    for name, height in (('bode', 4.3), ('signals', 3.0)):
        figure, (one,) = canvas.panels(height_in=height)
        one.plot([0.0, 1.0], [0.0, 1.0], label='line')
        one.set_xlabel('time, s')
        one.set_ylabel('rate, rad/s')
        canvas.legend(one)
        pictures[name] = canvas.Picture(name, name, 'words', figure)
    return page(tree, {'roll': answer}, {'roll': plots.Gallery(pictures)})


@pytest.mark.parametrize(('width', 'dark'), [(1280, False), (520, True)])
def test_figures_have_their_size_and_the_page_does_not_scroll_sideways(
    text, tmp_path, width, dark
):
    found = look(text, tmp_path, width, dark=dark)
    assert len(found['boxes']) == 2
    # in the order of the page: signals, then bode
    for (w, h), inches in zip(found['boxes'], (3.0, 4.3), strict=True):
        assert w > 380
        assert h / w == pytest.approx(inches / canvas.WIDTH_IN, rel=0.02)
    assert found['page'] <= found['window']
    assert found['smallest'] >= 9.0
    paper = sum(int(v) for v in re.findall(r'\d+', found['paper'])[:3]) / 3
    ink = sum(int(v) for v in re.findall(r'\d+', found['ink'])[:3]) / 3
    low, high = (paper, ink) if dark else (ink, paper)
    assert low < 60
    assert high > 180


def test_sliders_redraw_the_step_and_the_margins_of_the_simulated_loop(tmp_path):
    values = {'gain': 450.0, 'lag': 0.043, 'delay': 0.008, 'damping': 0.4, 'bias': 0.0}
    flown = CascadeGains(4.0, 0.07, 0.05, 0.0012, d_filter_hz=35.0)
    model = AxisModel('roll', 0.004, 42.0,
                      tuple(Parameter(n, v, None, '') for n, v in values.items()),
                      active_gains=flown.to_mapping('roll', constants=True))
    move = """<script>addEventListener('load', () => {
    const box = document.querySelector('.tryout');
    box.querySelectorAll('input').forEach((one, i) => {
      one.value = [0.4, -0.3, 0.5, 0.2][i]; one.oninput(); });
    const found = {...box.tryout.found}; found.step = [...found.step];
    document.body.dataset.measured = JSON.stringify(found); });</script></body>"""
    made = f'<html><body>{sliders.sliders(model, {})}{sliders.script()}</body></html>'
    found = look(made, tmp_path, 390, dark=False, measure=move)
    factors = 2.0 ** np.array([0.4, -0.3, 0.5, 0.2])
    names = ('angle_kp', 'rate_kp', 'rate_ki', 'rate_kd')
    gains = dataclasses.replace(flown, **{
        name: factor * getattr(flown, name) for name, factor in zip(names, factors, strict=True)})
    plant = loop_plant(model)
    step = simulate_cascade(plant, gains, np.full(300, 0.2), model.dt).angle / 0.2
    assert np.allclose(found['step'], step, atol=2e-3)
    omega = np.geomspace(0.5, 0.999 * np.pi / model.dt, 2000)
    loops = loops_of([(plant, WIDE)])
    of = margins(open_loop(gains, loops.response(omega), omega, model.dt), omega)
    assert found['phase'] == pytest.approx(of.phase_margin_deg[0], abs=0.5)
    assert found['gain'] == pytest.approx(of.gain_margin_db[0], abs=0.1)
    assert found['cross'] == pytest.approx(of.crossover_rad_s[0], rel=0.01)
    assert found['worst'] == pytest.approx(of.peak_sensitivity[0], rel=0.01)
