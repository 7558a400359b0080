"""The black-box models of docs/python.md and docs/identify.md fit as well as the command's do."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from flown_axis import SHORT, Axis, fly

import quad_sysid as qs

DOCS = Path(__file__).resolve().parents[2] / 'docs'
ALIKE_PCT = 5.0
"""The command takes the data about the base's equilibrium, the pages about the training's mean."""


@pytest.fixture(scope='module')
def flight() -> qs.Record:
    """A centre of mass off the axis, so that command and rate have means."""
    return fly(Axis(bias=8.0), 5, SHORT)


@pytest.fixture(scope='module')
def of_the_command(flight: qs.Record) -> dict[str, float]:
    """Structure → the fit on the validation segments that `identify` prints, per cent."""
    models = qs.identify(flight, 'roll', effects=()).report['axes']['roll']['models']
    fits = [(m['structure'], m['fit_validation_pct']['prbs']) for m in models
            if m['approach'] == 'direct']
    return {structure: max(f for s, f in fits if s == structure) for structure, _ in fits}


def test_the_example_for_scripts(flight: qs.Record, of_the_command: dict[str, float]) -> None:
    page = (DOCS / 'python.md').read_text().partition('## Black-box models')[2]
    lines = re.findall(r'```python\n(.*?)```', page, re.DOTALL)[0].splitlines()
    names: dict[str, Any] = {'qs': qs, 'flight': flight}
    answers = {}
    for line in lines:
        if re.match(r'\w+(, \w+)? = ', line):
            exec(line, names)  # noqa: S102
        else:
            answers[line.partition('(')[0]] = eval(line, names)  # noqa: S307
    fits = dict(zip(('BJ', 'ARX'), answers['qs.compare'], strict=True))
    for structure, fit in fits.items():
        assert fit > of_the_command[structure] - ALIKE_PCT, structure
