"""Flights that are fitted together: clocks that differ a little, and no flight twice."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from quad_sysid.errors import BadInputError
from quad_sysid.model import AxisModel, Parameter
from quad_sysid.pipeline.evaluate import evaluate
from quad_sysid.pipeline.together import together
from quad_sysid.record import GainChange, Record

PPM_250 = 1.0 + 250e-6


@pytest.fixture(scope='module')
def flights(flown: Callable[..., Record], axis_type: type) -> tuple[Record, Record]:
    return flown(axis_type(), 21), flown(axis_type(), 22)


def test_clocks_that_differ_by_250_ppm_are_one_rate(flights):
    first, second = flights
    found = together([first, second.at_interval(first.dt * PPM_250)])
    assert found[1].dt == first.dt
    assert not any('taken as' in line for line in found[1].warnings)
    assert [found[1].span(s) for s in second.segments] == [second.span(s) for s in second.segments]


def test_a_difference_of_a_thousandth_is_told_and_of_a_hundredth_refused(flights):
    first, second = flights
    told = together([first, second.at_interval(first.dt * 1.001)])[1]
    assert "taken as the first bag's 250 Hz" in told.warnings[-1]
    with pytest.raises(BadInputError, match='one sample rate'):
        together([first, second.at_interval(first.dt * 1.01)])


def test_segments_and_gains_keep_their_samples_at_another_interval(flights):
    one = replace(flights[0], gains=(GainChange(0.0, {}), GainChange(8.0, {'roll.rate.kp': 1.0})))
    other = one.at_interval(one.dt * 1.004)
    assert [other.span(s) for s in other.segments] == [one.span(s) for s in one.segments]
    assert other.gains[1].time_s == pytest.approx(8.0 * 1.004, rel=1e-12)


def test_evaluate_takes_a_clock_that_differs_and_gives_the_same_figures(flights):
    one = flights[0]
    values = {'gain': 450.0, 'lag': 0.042, 'delay': 0.01, 'damping': 0.4, 'bias': 0.0}
    model = AxisModel(
        'roll', one.dt, None, tuple(Parameter(n, v, None, '') for n, v in values.items()),
        noise_rms=0.005, correction=(0.3, 0.0, 0.0, 0.0),
    )
    straight = evaluate(model, one)
    found = evaluate(model, one.at_interval(one.dt * PPM_250))
    assert found.before == pytest.approx(straight.before, rel=0.01)
    with pytest.raises(BadInputError, match="sample rate must be the model's"):
        evaluate(model, one.at_interval(one.dt * 1.02))


def test_a_flight_given_twice_is_refused_whole_in_part_or_copied(flights):
    one, other = flights
    later = round(12.0 / one.dt)
    part = replace(one, source='part', rates=one.rates[later:], control=one.control[later:],
                   angles=None, battery_v=None, attitude_setpoint=None,
                   t0_ns=one.t0_ns + round(12.0e9))
    for twice in (one, part, replace(one, t0_ns=one.t0_ns + 10**15), one.at_interval(0.004001)):
        with pytest.raises(BadInputError, match='same measurement') as caught:
            together([other, one, twice])
        assert '\n' not in str(caught.value)
    assert len(together([one, other])) == 2


def test_rest_alone_is_not_the_same_measurement(flights):
    one, other = flights
    rest = [replace(r, rates=np.zeros_like(r.rates)) for r in (one, other)]
    assert len(together(rest)) == 2
