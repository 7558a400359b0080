"""Commands that move the aircraft tell its rate; a feedback's noise and strangers' do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from flown_axis import DT, SHORT, Axis, fly

from quad_sysid.foresight import improvement, tell

N = 6000
WHOLE = ((0, N),)


@pytest.mark.parametrize(('gyro_noise', 'amplitude'), [(0.005, 0.2), (0.005, 0.02), (0.05, 0.05)])
def test_flights_that_a_fit_answers_are_told(gyro_noise, amplitude):
    """Also where the noise is of the motion's size; without knowing the reference."""
    record = fly(Axis(gyro_noise=gyro_noise), 3, replace(SHORT, amplitude=amplitude))
    assert improvement(record.rates[:, 0], record.control, ((250, 4500),), DT) > 1.3


@pytest.mark.parametrize('seed', range(2))
@pytest.mark.parametrize('kind', ['feedback', 'strangers', 'still'])
def test_what_does_not_turn_the_axis_does_not_tell(seed, kind):
    """`feedback`: a held axis, whose commands are its gyro's filtered noise and its change."""
    rng = np.random.default_rng(seed)
    noise = np.convolve(rng.standard_normal(N + 2), (0.3, 0.5, 0.2), mode='valid')
    command = -0.07 * noise - 0.3 * np.diff(noise, prepend=0.0)
    if kind != 'feedback':
        command = rng.standard_normal(N) if kind == 'strangers' else np.zeros(N)
    commands = np.column_stack([np.full(N, 0.5), command])
    assert improvement(noise, commands, WHOLE, DT) == pytest.approx(1.0, abs=0.02)
    assert not tell(noise, commands, WHOLE, DT)


def test_spans_too_short_tell_nothing():
    rng = np.random.default_rng(0)
    command = rng.standard_normal(N)
    rate = np.cumsum(np.roll(command, 4)) * DT  # a delay of some cycles, as motors have
    assert tell(rate, command[:, None], WHOLE, DT)
    for spans in ((), ((0, 30),), ((0, 60), (100, 160))):
        assert improvement(rate, command[:, None], spans, DT) == 1.0
