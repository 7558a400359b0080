"""CONTRIBUTING.md's worked changes and docs/extend.md's files, in a copy of the project, used."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from node_process import python

ROOT = Path(__file__).resolve().parents[2]
CHANGES = re.findall(r'```diff\n(.*?)```', (ROOT / 'CONTRIBUTING.md').read_text(), re.DOTALL)
FILES = re.findall(r'```(?:python|yaml)\n# ([\w./]+)\n(.*?)```',
                   (ROOT / 'docs' / 'extend.md').read_text(), re.DOTALL)


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    for package in ('quad_bridge', 'quad_sysid'):
        shutil.copytree(ROOT / 'src' / package / package, tmp_path / 'src' / package / package)
    shutil.copytree(ROOT / 'test', tmp_path / 'test')
    shutil.copy(ROOT / 'pyproject.toml', tmp_path)
    (tmp_path / 'firmware').symlink_to(ROOT / 'firmware')
    return tmp_path


def python_in(place: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """What Python with these words does where the copy's packages are the installed ones."""
    paths = [place, *(place / 'src' / name for name in ('quad_bridge', 'quad_sysid')),
             place / 'test', os.environ.get('PYTHONPATH', '')]
    return python(*words, cwd=place, env={'PYTHONPATH': os.pathsep.join(map(str, paths))})


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


def test_each_worked_change_works(copy: Path) -> None:
    """All in one process: they do not meet."""
    tests = [test for change in CHANGES for test in applied(copy, change)]
    assert len(tests) == len(CHANGES) == 5
    files = sorted({name for change in CHANGES
                    for name in re.findall(r'^--- (test/\S+)', change, re.MULTILINE)})
    done = python_in(copy, '-m', 'pytest', '-q', '-n', '0', '-p', 'no:cacheprovider',
                     '-k', ' or '.join(tests), *files)
    assert '5 passed' in done.stdout, (done.stdout + done.stderr)[-3000:]
    assert done.returncode == 0


USES = """
import math
import quad_sysid as qs
from flown_axis import SHORT, Axis, fly
from my_controller import design
from my_effects import Cogging
from quad_bridge.virtual.simulation import fly as simulated
from quad_sysid.pipeline import identify
identify._black_boxes = lambda *_: 'left out'  # no black-box models
assert {!r} in qs.__file__
axis = Axis(torque=lambda _t, _rate, angle: -4.0 * math.sin(12.0 * angle))
found = qs.identify(fly(axis, 5, SHORT), 'roll', effects=(Cogging(),), designer=design)
print([effect.name for effect in found.effects])
print(sorted(found.gains), found.gains['roll.rate.kp'] > 0.0)
print(simulated('whoop', [], 0.1, 1).profile.airframe.mass_kg)
"""
SAYS = """['cogging']
['roll.angle.kp', 'roll.rate.kd', 'roll.rate.ki', 'roll.rate.kp'] True
0.03
"""


def test_what_the_page_adds_works(copy: Path) -> None:
    assert len(FILES) == 3
    for name, text in FILES:
        path = copy / 'src' / name.partition('/')[0] / name if '/' in name else copy / name
        path.write_text(text)
    done = python_in(copy, '-c', USES.format(str(copy)))
    assert (done.stdout, done.returncode) == (SAYS, 0), done.stderr[-2000:]
