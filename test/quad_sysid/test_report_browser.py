"""The page in a real browser at desktop and phone width: sizes, no sideways scroll, no errors."""

import html
import json
import re
import shutil
import subprocess

import pytest
from probe import PATIENCE_S

from quad_sysid.pipeline.answer import AxisAnswer
from quad_sysid.report import canvas, document, plots
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

pytestmark = pytest.mark.skipif(not BROWSER, reason='no Chromium here (apt-get install chromium)')


def look(text: str, folder, width: int, *, dark: bool) -> dict:
    """What the browser measured; raises where it logged an error."""
    path = folder / 'page.html'
    path.write_text(text.replace('</body>', MEASURE))
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
