"""docs/extend.md: what it adds, added to a copy of the project as the page says, and used."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
BLOCK = re.compile(r'```(?:python|yaml)\n# ([\w./]+)\n(.*?)```', re.DOTALL)


@pytest.fixture(scope='module')
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Both packages, and the page's files where their first lines say."""
    place = tmp_path_factory.mktemp('copy')
    for package in ('quad_bridge', 'quad_sysid'):
        shutil.copytree(ROOT / 'src' / package / package, place / 'src' / package / package)
    (place / 'firmware').symlink_to(ROOT / 'firmware')
    blocks = BLOCK.findall((ROOT / 'docs' / 'extend.md').read_text())
    assert len(blocks) == 3
    for name, text in blocks:
        path = place / 'src' / name.partition('/')[0] / name if '/' in name else place / name
        path.write_text(text)
    return place


HEAD = """
import math
import numpy as np
import quad_sysid as qs
from flown_axis import SHORT, Axis, fly
from quad_sysid.pipeline import identify
identify._compared = lambda answer, *_: answer  # no black-box models
assert {!r} in qs.__file__
flight = fly(Axis(), 5, SHORT)
"""
USES = {
    'an effect': """
from my_effects import Cogging
axis = Axis(torque=lambda _t, _rate, angle: -4.0 * math.sin(12.0 * angle))
found = qs.identify(fly(axis, 5, SHORT), 'roll', effects=(*qs.EFFECTS[:4], Cogging()))
print([effect.name for effect in found.effects])
""",
    'an airframe': """
from quad_bridge.virtual.simulation import fly as simulated
print(simulated('whoop', [], 0.1, 1).profile.airframe.mass_kg)
""",
    'a controller': """
from my_controller import design
found = qs.identify(flight, 'roll', effects=(), designer=design)
print(sorted(found.gains), found.gains['roll.rate.kp'] > 0.0)
""",
}
SAYS = {
    'an effect': "['cogging']",
    'an airframe': '0.03',
    'a controller': "['roll.angle.kp', 'roll.rate.kd', 'roll.rate.ki', 'roll.rate.kp'] True",
}


def test_what_the_page_adds_works(copy: Path) -> None:
    """What each use prints, all in one process."""
    uses = '\n'.join(f'print("=", {added!r})\n{code}' for added, code in USES.items())
    done = subprocess.run(
        [sys.executable, '-c', HEAD.format(str(copy)) + uses], cwd=copy, capture_output=True,
        text=True, check=False, env={**os.environ, 'PYTHONPATH': os.pathsep.join(map(str, (
            copy, copy / 'src/quad_bridge', copy / 'src/quad_sysid', ROOT / 'test')))},
    )
    assert done.returncode == 0, done.stderr[-2000:]
    said = dict(part.strip().split('\n', 1) for part in done.stdout.split('= ')[1:])
    assert said == SAYS
