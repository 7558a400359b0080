"""The demo's summary tells what the report and the figures say, in lines that fit."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from quad_sysid.loop.figures import SquareFigures
from quad_tuning.demo.summary import FlightSummary, Outcome, lines, number

REPORT = {
    'verdict': 'effects_added',
    'effects': [
        {
            'name': 'coulomb_friction',
            'probability': 0.93,
            'parameters': [{'name': 'torque', 'value': 0.4876, 'std': 0.0123, 'unit': 'rad/s²'}],
        }
    ],
    'base': {
        'parameters': [
            {'name': 'gain', 'value': 131.23, 'std': 1.2, 'unit': 'rad/s²'},
            {'name': 'lag', 'value': 0.0451, 'std': None, 'unit': 's'},
            {'name': 'delay', 'value': 0.0123, 'std': 0.001, 'unit': 's'},
        ]
    },
    'error': {'metric': 'rms of the rate', 'unit': 'rad/s', 'before': 0.2, 'after': 0.05},
}


def square(rise_time_s: float, overshoot_pct: float, rms_deg: float) -> SquareFigures:
    return SquareFigures(
        rise_time_s, overshoot_pct, 1.0, 0.0, rms_error_rad=math.radians(rms_deg), edges=4,
        step_rad=0.4,
    )  # fmt: skip


@pytest.fixture
def outcome() -> Outcome:
    gains = {'roll.angle.kp': 3.0, 'roll.rate.kp': 0.0745, 'roll.rate.d_filter_hz': 30.0}
    first = FlightSummary(Path('flight_1'), 66.2, gains, square(0.512, 23.4, 4.56))
    second = FlightSummary(
        Path('flight_2'), 25.0, {**gains, 'roll.angle.kp': 4.25}, square(0.311, 8.1, 3.33)
    )
    return Outcome(
        axis='roll', first=first, second=second, report=REPORT,
        unseen={'before': 0.3, 'after': 0.06}, acknowledged_after_s=0.42,
        folder=Path('demo_out'), files=[('the report', Path('demo_out/report.html'))],
        seconds=180.0,
    )  # fmt: skip


def test_every_figure_stands_in_it(outcome: Outcome) -> None:
    text = '\n'.join(lines(outcome))
    for said in (
        'effects_added', 'coulomb_friction (probability 0.93)', 'torque 0.4876 ± 0.01 rad/s²',
        '0.2000 before, 0.0500 after (0.25)', '0.3000 before, 0.0600 after (0.20)', 'report.html',
        'acknowledged 420 ms after sending',
    ):  # fmt: skip
        assert said in text
    table = {line.split()[-4]: line.split()[-3:] for line in lines(outcome) if 'roll.' in line}
    assert table == {
        'roll.angle.kp': ['3', '4.25', '1/s'], 'roll.rate.kp': ['0.0745', '0.0745', 's/rad']
    }
    assert any(line.endswith('23.4       8.1') for line in lines(outcome))


def test_it_fits_a_terminal(outcome: Outcome) -> None:
    assert max(map(len, lines(outcome))) <= 80
    assert 18 <= len(lines(outcome)) <= 30


def test_a_parameter_without_standard_error_says_none() -> None:
    assert number({'name': 'lag', 'value': 0.0451, 'std': None, 'unit': 's'}) == 'lag 0.0451 s'
    assert number({'name': 'x', 'value': 2.0, 'std': float('nan'), 'unit': '1'}) == 'x 2'
