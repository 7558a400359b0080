"""Bounds, steps and polarity: what must never reach an aircraft is refused by name."""

import dataclasses

import pytest

from quad_sysid.estimate.stored import estimate_of
from quad_sysid.loop.cascade import TUNED, CascadeGains
from quad_tuning.bounds import (
    check_bounds,
    check_finite,
    check_polarity,
    reachable,
    steps_to,
)
from quad_tuning.errors import DesignRefusedError


@pytest.mark.parametrize(
    ('check', 'gains', 'said'),
    [
        *((check_finite, {'roll.rate.kp': value}, r'roll\.rate\.kp: must be finite')
          for value in (float('nan'), float('inf'), -float('inf'), True)),
        *((check_bounds, gains, 'must lie in') for gains in (
            {'roll.angle.kp': 16.0}, {'roll.rate.kp': -0.01}, {'roll.rate.kd': 0.03})),
        (check_bounds, {'roll.rate.output_limit': 0.3}, 'roll.rate.output_limit'),
        (lambda _: reachable('angle_kp', 40.0), {}, 'further than'),
    ],
)
def test_what_must_never_reach_an_aircraft_is_refused_by_name(check, gains, said):
    with pytest.raises(DesignRefusedError, match=said):
        check(gains)


def test_a_large_change_goes_in_steps_within_the_limit():
    active = CascadeGains.default('roll')
    wanted = dataclasses.replace(active, angle_kp=14.0, rate_kd=0.0)
    path = steps_to(wanted, active)
    assert path[-1] == wanted
    assert len(path) >= 3
    assert reachable('angle_kp', 3.0) == pytest.approx((1.5, 6.0), rel=2e-4)
    now = active
    for following in path:
        for field in TUNED:
            low, high = reachable(field, getattr(now, field))
            assert low <= getattr(following, field) <= high
        now = following
    with pytest.raises(DesignRefusedError, match='outside the hard bounds'):
        steps_to(dataclasses.replace(active, angle_kp=20.0), active)


def test_an_axis_driven_by_another_ones_command_is_refused(model):
    def crossed(fraction):
        return estimate_of('cross_axis_input', (fraction,), 'other axis 1', std=0.01)

    check_polarity(model(effects=[crossed(0.1)]))
    with pytest.raises(DesignRefusedError, match="motors' order"):
        check_polarity(model(effects=[crossed(-0.9)]))
