"""No gain passes that is unknown, not finite, out of bounds, too large a step or badly timed."""

import math

import pytest

from quad_bridge.errors import BadInputError, RefusedError
from quad_bridge.gain_gate import Bound, bound_from, check, numbers

BOUNDS = {'roll.angle.kp': Bound(0.3, 15.0, 4.0), 'roll.rate.ki': Bound(0.0, 2.0)}
ACTIVE = {'roll.angle.kp': 3.0, 'roll.rate.ki': 0.0, 'yaw.rate.kp': 0.2}


def test_good_gains_become_wire_writes():
    writes = check({'roll.angle.kp': 6.0, 'roll.rate.ki': 1.5}, ACTIVE, BOUNDS)
    assert writes == {'ROLL_ANG_KP': 6.0, 'ROLL_RATE_KI': 1.5}


@pytest.mark.parametrize(
    ('wanted', 'reason'),
    [
        ({'roll.angle.kp': math.nan}, 'must be finite: found nan'),
        ({'roll.angle.kp': math.inf}, 'must be finite: found inf'),
        ({'roll.angle.kp': 0.2}, r'must lie in 0\.3 \.\. 15: found 0\.2'),
        ({'roll.angle.kp': 15.1}, 'must lie in'),
        ({'roll.rate.ki': -1e-9}, 'must lie in'),
        ({'roll.angle.kp': 12.1}, 'factor of at most 4: found 3 to 12.1'),
        ({'roll.angle.kp': 0.7}, 'factor of at most 4'),
        ({'roll.angle.kq': 1.0}, 'no gain of this name'),
        ({'loop.rate_hz': 500.0}, 'no gain of this name'),
        ({'yaw.rate.kp': 0.2}, 'the configuration allows no change'),
        ({}, 'no gain in changed_parameters'),
    ],
)
def test_bad_gains_are_refused_by_name_and_value(wanted, reason):
    with pytest.raises(RefusedError, match=reason):
        check(wanted, ACTIVE, BOUNDS)


def test_one_bad_gain_holds_back_the_good_ones():
    with pytest.raises(RefusedError):
        check({'roll.angle.kp': 3.1, 'roll.rate.ki': 9.0}, ACTIVE, BOUNDS)


def test_nothing_passes_while_the_excitation_runs():
    with pytest.raises(RefusedError, match='while the excitation runs'):
        check({'roll.angle.kp': 3.1}, ACTIVE, BOUNDS, excitation_running=True)


def test_a_gain_that_was_never_reported_is_refused():
    with pytest.raises(RefusedError, match='has not reported it'):
        check({'roll.angle.kp': 3.1}, {}, BOUNDS)


@pytest.mark.parametrize('value', ['fast', True])
def test_only_numbers_are_gains(value):
    with pytest.raises(RefusedError, match=r'roll\.angle\.kp: must be a number'):
        numbers({'roll.angle.kp': value})


@pytest.mark.parametrize(
    'values', [[], [1.0], [2.0, 1.0], [0.0, 1.0, 0.5], [0.0, math.inf], [0.0, 1.0, math.nan]]
)
def test_bounds_that_make_no_sense_name_their_parameter(values):
    with pytest.raises(BadInputError, match=r'parameter bounds\.roll\.angle\.kp'):
        bound_from('roll.angle.kp', values)
