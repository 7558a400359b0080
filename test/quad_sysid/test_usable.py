"""What cannot be answered or tested is said in words, by the command as it is run."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from quad_sysid.bags import write_bag
from quad_sysid.cli import main
from quad_sysid.contract import MIXER
from quad_sysid.errors import NotInformativeError
from quad_sysid.greybox.data import axis_data
from quad_sysid.pipeline.usable import check_usable
from quad_sysid.record import Record
from quad_sysid.report import text

Change = Callable[[Record], dict[str, object]]


@pytest.fixture(scope='module')
def flight(flown: Callable[..., Record], axis_type: type) -> Record:
    return flown(axis_type(), 11)


def relay(record: Record) -> dict[str, object]:
    """Motors that are thrown from one limit to the other."""
    motors = np.where(record.control[:, 1:2] * MIXER[:, 1] > 0.0, 1.0, 0.0)
    return {'motors': motors, 'control': motors @ MIXER / 4.0}


def clipped(record: Record) -> dict[str, object]:
    """A gyro whose range is far too small."""
    return {'rates': np.clip(record.rates, -0.3, 0.3)}


def flat_out(record: Record) -> dict[str, object]:
    """All motors full throughout."""
    ones = np.ones((record.n, 4))
    return {'motors': ones, 'control': ones @ MIXER / 4.0}


def resting(record: Record) -> dict[str, object]:
    """Nothing but the last bits of a gyro, and hardly a command."""
    rng = np.random.default_rng(1)
    steps = 0.001 * rng.integers(-1, 2, record.rates.shape)
    command = np.zeros_like(record.control)
    command[:, 0], command[:, 1] = 0.5, 1e-5 * rng.standard_normal(record.n)
    return {'rates': steps, 'control': command, 'motors': None}


def silent(record: Record) -> dict[str, object]:
    return {'rates': np.zeros_like(record.rates)}


@pytest.mark.parametrize(
    ('change', 'words'),
    [
        (relay, 'all motors stand at their limits (0 or 1) during 100 % of the training'),
        (flat_out, 'all motors stand at their limits'),
        (clipped, 'the gyro is at its limit; widen its range'),
        (silent, 'the measured rate is constant'),
        (resting, 'do not show what half a second of motion owes them'),
    ],
)
def test_the_command_says_why_and_ends_with_3(
    flight: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str], change: Change, words: str
) -> None:
    bag = write_bag(replace(flight, **change(flight)), tmp_path / 'flight')
    status = main(['identify', str(bag), '--axis', 'roll', '--quiet', '--out',
                   str(tmp_path / 'out')])
    said = capsys.readouterr().err
    assert (status, words in said, str(bag) in said) == (3, True, True), said
    axis = json.loads((tmp_path / 'out' / 'report.json').read_text())['axes']['roll']
    assert axis['verdict'] == 'cannot_tell'
    assert words in axis['reason']


def test_a_good_flight_is_usable(flight: Record) -> None:
    check_usable(axis_data([flight], 'roll'))


def test_a_few_moments_at_the_limits_are_no_reason(flight: Record) -> None:
    often = np.sort(np.abs(flight.rates[:, 0]))[int(0.9 * flight.n)]
    rates = np.clip(flight.rates, -often, often)
    check_usable(axis_data([replace(flight, rates=rates)], 'roll'))
    more = np.sort(np.abs(flight.rates[:, 0]))[int(0.6 * flight.n)]
    rates = np.clip(flight.rates, -more, more)
    with pytest.raises(NotInformativeError, match='gyro is at its limit'):
        check_usable(axis_data([replace(flight, rates=rates)], 'roll'))


def test_effects_whose_topics_are_missing_are_left_out_and_told(
    flight: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bare = replace(flight, angles=None, battery_v=None, attitude_setpoint=None, gains=())
    bag = write_bag(bare, tmp_path / 'flight')
    status = main(['identify', str(bag), '--axis', 'roll', '--out', str(tmp_path / 'out')])
    printed = capsys.readouterr().out
    assert status == 0
    report = json.loads((tmp_path / 'out' / 'report.json').read_text())
    axis = report['axes']['roll']
    reasons = {item['name']: item['because'] for item in axis['not_tested']}
    assert reasons['pendulum_stiffness'] == 'the bag holds no orientation'
    assert reasons['shape:angle'] == 'the bag holds no orientation'
    assert reasons['battery_sag'] == 'the bag holds no battery voltage'
    assert 'hardly turns' in reasons['gyroscopic_coupling']
    assert not {t['name'] for t in axis['tried']} & {'pendulum_stiffness', 'battery_sag'}
    told = ' '.join(printed.split())  # as the terminal's width breaks it
    pattern = 'not tested: pendulum_stiffness, [^:]+(:[^:]+)*: the bag holds no orient'
    assert re.search(pattern, told)
    assert text.lines(report)
