"""CONTRIBUTING.md's worked changes and docs/extend.md's files, in a copy of the project, used."""

import os
import re
import shutil
from pathlib import Path

from node_process import python

ROOT = Path(__file__).resolve().parents[2]
CHANGES = re.findall(r'```diff\n(.*?)```', (ROOT / 'CONTRIBUTING.md').read_text(), re.DOTALL)
FILES = re.findall(r'```(?:python|yaml)\n# ([\w./]+)\n(.*?)```',
                   (ROOT / 'docs' / 'extend.md').read_text(), re.DOTALL)


def applied(place: Path, change: str) -> list[str]:
    """Apply a change whose hunks have no line numbers; returns the tests that it adds."""
    for file in re.split(r'^--- ', change, flags=re.MULTILINE)[1:]:
        name, *hunks = file.split('@@\n')
        path = place / name.strip()
        text = path.read_text() if path.exists() else ''
        for hunk in hunks:
            lines = hunk.splitlines(keepends=True)
            old = ''.join(line[1:] for line in lines if line[0] in ' -')
            new = ''.join(line[1:] for line in lines if line[0] in ' +')
            assert not old or text.count(old) == 1, f'{name.strip()}: {old!r}'
            text = text.replace(old, new) if old else f'{text}\n\n{new}'
        path.write_text(text.lstrip())
    return re.findall(r'^\+def (test_\w+)', change, re.MULTILINE)


USES = """
import math
import quad_sysid as qs
from flown_axis import SHORT, Axis, fly
from my_controller import design
from my_effects import Cogging
from quad_bridge.virtual.simulation import fly as simulated
from quad_sysid.pipeline import identify

def test_what_the_page_adds(monkeypatch):
    monkeypatch.setattr(identify, '_black_boxes', lambda *_: 'left out')
    assert {!r} in qs.__file__
    axis = Axis(torque=lambda _t, _rate, angle: -4.0 * math.sin(12.0 * angle))
    found = qs.identify(fly(axis, 5, SHORT), 'roll', effects=(Cogging(),), designer=design)
    assert [effect.name for effect in found.effects] == ['cogging']
    assert {{name.removeprefix('roll.') for name in found.gains}} == {{
        'angle.kp', 'rate.kd', 'rate.ki', 'rate.kp'}}
    assert found.gains['roll.rate.kp'] > 0.0
    assert simulated('whoop', [], 0.1, 1).profile.airframe.mass_kg == 0.03
"""


def test_what_the_pages_change_and_add_works(tmp_path: Path) -> None:
    """All in one process, whose packages are the copy's: they do not meet."""
    for package in ('quad_bridge', 'quad_sysid'):
        shutil.copytree(ROOT / 'src' / package / package, tmp_path / 'src' / package / package)
    shutil.copytree(ROOT / 'test', tmp_path / 'test')
    shutil.copy(ROOT / 'pyproject.toml', tmp_path)
    (tmp_path / 'firmware').symlink_to(ROOT / 'firmware')
    tests = [test for change in CHANGES for test in applied(tmp_path, change)]
    assert (len(tests), len(CHANGES), len(FILES)) == (5, 5, 3)
    files = sorted({name for change in CHANGES
                    for name in re.findall(r'^--- (test/\S+)', change, re.MULTILINE)})
    for name, text in FILES:
        path = tmp_path / 'src' / name.partition('/')[0] / name if '/' in name else tmp_path / name
        path.write_text(text)
    (tmp_path / 'test/test_page.py').write_text(USES.format(str(tmp_path)))
    paths = [tmp_path, *(tmp_path / 'src' / name for name in ('quad_bridge', 'quad_sysid')),
             os.environ.get('PYTHONPATH', '')]
    done = python('-m', 'pytest', '-q', '-n', '0', '-p', 'no:cacheprovider', '-k',
                  ' or '.join([*tests, 'page_adds']), *files, 'test/test_page.py', cwd=tmp_path,
                  env={'PYTHONPATH': os.pathsep.join(map(str, paths))})
    assert '6 passed' in done.stdout, (done.stdout + done.stderr)[-3000:]
    assert done.returncode == 0
