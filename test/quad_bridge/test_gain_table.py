"""One table says what a gain is; what is generated from it is what is committed."""

import runpy
from pathlib import Path

import pytest

from quad_bridge.gains import table

MADE = runpy.run_path(str(Path(__file__).parents[2] / 'tools/gain_tables.py'))


@pytest.mark.parametrize(('file', 'text'), [('HEADER', 'header'), ('PAGE', 'page')])
def test_the_committed_file_is_the_generated_one(file, text):
    assert MADE[file].read_text(encoding='utf-8') == MADE[text](), 'run tools/gain_tables.py'


def test_wire_names_fit_and_are_unique():
    assert len(table.CONTRACT_NAMES) == len(table.WIRE_NAMES)
    assert all(len(wire) <= 16 and wire.isascii() for wire in table.WIRE_NAMES.values())
    for axis in table.AXES:
        for gain in ('angle.kp', 'rate.kp', 'rate.ki', 'rate.kd', 'rate.d_filter_hz'):
            assert f'{axis}.{gain}' in table.WIRE_NAMES


def test_a_bound_lies_inside_what_the_firmware_takes_and_a_start_inside_both():
    for name in table.SETTABLE:
        low, high = table.ROWS[name].limits
        assert all(low <= start <= high for start in table.ROWS[name].start), name
    for name, bound in table.DEFAULT_BOUNDS.items():
        low, high = table.ROWS[name].limits
        assert low <= bound.lower < bound.upper <= high, name
        if not table.switch_of(name):  # what is switched off starts at 0
            axis, _ = table.split(name)
            starts = table.ROWS[name].start
            start = starts[table.AXES.index(axis) % len(starts) if axis else 0]
            assert bound.lower <= start <= bound.upper, name
