"""docs/gallery.md: its examples run in order; the ones that need files run where they are."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flown_axis import SHORT, Axis, fly

import quad_sysid as qs

ROOT = Path(__file__).resolve().parents[2]
BLOCKS = re.findall(r'```python\n(.*?)```', (ROOT / 'docs/gallery.md').read_text(), re.DOTALL)
EMPS = ROOT / '../shared/data/emps'


@pytest.mark.long
@pytest.mark.usefixtures('quick')
def test_the_simulated_machines():
    names: dict[str, Any] = {}
    for block in BLOCKS:
        if not block.startswith('# needs'):
            exec(block, names)  # noqa: S102
    design = names['design']
    assert np.abs(design.u).max() <= 1.0
    assert design.largest_rate <= 6.0


@pytest.mark.long
def test_emps_in_ten_lines(monkeypatch):
    """The makers' 0.370 m/s² per V; at most 0.40 of the error, as by the bag."""
    if not EMPS.exists():
        pytest.skip('shared/data/emps is not beside this checkout')
    monkeypatch.chdir(EMPS)
    (block,) = (block for block in BLOCKS if 'DATA_EMPS' in block)
    names: dict[str, Any] = {'qs': qs, 'np': np}
    exec(block, names)  # noqa: S102
    model, unseen = names['result'].model, names['unseen']
    gain = model.parameters['gain']
    assert (gain.unit, gain.value) == ('m/s² per V', pytest.approx(35.150652 / 95.0, rel=0.05))
    found = qs.evaluate(model, unseen)
    assert found.after < 0.40 * found.before


@pytest.mark.usefixtures('quick')
def test_a_flight_as_a_table(tmp_path, monkeypatch):
    """As the page says, with no time to search, which takes seconds and is said."""
    flight = fly(Axis(), 5, SHORT)
    table = np.column_stack([
        flight.time_s, flight.control[:, 0], flight.control[:, 1],
        np.rad2deg(flight.rates[:, 0]), flight.rates[:, 1], np.rad2deg(flight.angles[:, 0]),
        np.rad2deg(flight.attitude_setpoint[:, 0]), flight.battery_v])
    np.savetxt(tmp_path / 'flight.csv', table, delimiter=',', comments='',
               header='t,U1,U2,p,q,roll,roll_ref,volts')
    monkeypatch.chdir(tmp_path)
    (block,) = (block for block in BLOCKS if 'flight.csv' in block)
    names: dict[str, Any] = {'qs': qs, 'np': np}
    exec(block.replace('seconds=120', 'seconds=0'), names)  # noqa: S102
    result = names['result']
    assert result.verdict == 'not_searched'
    untried = {one['name']: one['because'] for one in result.report['axes']['roll']['not_tested']}
    assert untried['coulomb_friction'] == 'the search had 0 s: it was not tried'
    (line,) = (line for line in result.answer.warnings if 'ended early' in line)
    assert line.startswith('roll: the search had 0 s and ended early: what it names may ')
    model = result.model
    degree = model.parameters['gain']
    assert degree.unit == 'deg/s² per unit command'
    assert degree.value == pytest.approx(np.rad2deg(450.0), rel=0.03)
    assert (tmp_path / 'out/model.json').exists()
