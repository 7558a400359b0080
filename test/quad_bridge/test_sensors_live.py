"""What stands before a flight is estimated, subtracted and can be had back; or refused."""

from dataclasses import replace

import numpy as np
import pytest
from flight_controller import STILL, ZERO

from quad_bridge.errors import RefusedError
from quad_bridge.sensors.correction import as_sent, from_values
from quad_bridge.sensors.live import LiveSensors
from quad_bridge.status import OK, WARN
from quad_bridge.wire.axes import flip_body
from quad_bridge.wire.frames import Flag

BIAS = (0.012, -0.02, 0.004)
"""rad/s, FLU."""


class Aircraft:
    """An STM32 that stands still with a biased gyro, its bridge's sensors, and its bag."""

    def __init__(self, *, correct=True):
        self.sensors, self.cycle = LiveSensors(correct=correct), 0
        self.rng = np.random.default_rng(7)
        self.stamps, self.sent, self.published, self.told, self.said = [], [], [], [], []
        self.shake = lambda _t: 0.0

    def run(self, seconds, *, armed=False):
        for _ in range(round(250 * seconds)):
            time_us = 4000 * self.cycle
            gyro = np.array(BIAS) + 0.005 * self.rng.standard_normal(3)
            gyro[1] += self.shake(1e-6 * time_us)
            felt = np.array([0.0, 0.0, 9.80665]) + 0.05 * self.rng.standard_normal(3)
            frame = replace(
                STILL, time_us=time_us, cycle=self.cycle, gyro=flip_body(gyro),
                accel=flip_body(felt), flags=int(Flag.ARMED if armed else Flag.NONE),
            )  # fmt: skip
            self.sensors.cycle(frame)
            self.stamps.append(10**18 + 1000 * time_us)
            self.sent.append(flip_body(frame.gyro))
            bias = self.sensors.stamped(self.stamps[-1]).gyro_bias
            self.published.append(np.array(self.sent[-1]) - bias)
            if self.cycle % 12 == 0:
                wanted = self.sensors.wanted()
                if wanted is not None:
                    self.ask(wanted)
                self.told.append(from_values(self.status.values))
            self.cycle += 1

    def ask(self, wanted):
        try:
            self.said.append(self.sensors.estimate(wanted))
        except RefusedError as error:
            self.said.append(str(error))

    def stand(self, seconds=7.0, then_armed=0.1):
        """Stand still, then arm."""
        self.run(seconds)
        self.run(then_armed, armed=True)
        return self

    @property
    def status(self):
        return self.sensors.status()


def test_before_it_arms_the_bias_is_estimated_and_subtracted_and_can_be_had_back():
    one = Aircraft().stand(8.0, 3.0)
    (said,) = one.said
    assert 'at rest, arming' in said
    # 6 s of 0.005 rad/s: a standard error of 1.3e-4 rad/s, 2.2e-4 of the 2 s compared
    assert np.mean(one.published[-500:], axis=0) == pytest.approx(ZERO, abs=1e-3)
    assert one.sensors.current.gyro_bias == pytest.approx(BIAS, abs=6e-4)
    assert (one.status.level, one.status.message) == (OK, said)
    one.stand(7.0, 1.0)
    assert len({c.since_ns for c in one.told}) == 3  # nothing from the first stamp, two estimates
    back = as_sent(np.array(one.stamps), np.array(one.published), one.told)
    assert np.abs(back - np.array(one.sent)).max() < 1e-15
    assert np.abs(np.array(one.published) - np.array(one.sent)).max() > 0.01


def test_what_moves_or_stands_too_short_is_refused_and_the_earlier_estimate_stays():
    one = Aircraft().stand(1.0, 1.0)
    assert 'only 1.0 s of data' in one.status.message
    assert (one.status.level, one.sensors.current.gyro_bias) == (OK, ZERO)  # no fault of anybody
    one.stand(7.0, 0.5)
    before = one.sensors.current
    one.shake = lambda t: 0.1 * np.sin(4.0 * t)
    one.stand(7.0, 0.5)
    assert 'not estimated (arming): it turns: ' in one.said[-1]
    assert one.said[-1].endswith('the earlier one stays')
    assert one.sensors.current == before
    assert (one.status.level, len(one.said)) == (WARN, 3)
