"""The sensor watch as a process: a shaking /imu/data comes out as a line in /diagnostics."""

import math

import pytest
from probe import entries, stamp

pytest.importorskip('diagnostic_msgs.msg', reason='needs the ROS 2 message packages')

from quad_bridge.diagnostics import OK, WARN
from quad_bridge.sensor_status import vibration_status
from quad_bridge.sensors.vibration import Vibration

WATCHED = 'sensor_watch: vibration of the rates'


@pytest.mark.parametrize(
    ('vibration', 'level', 'words'),
    [
        (Vibration(33.0, 0.2, 0.8, 'x', 0.85), WARN,
         '33.0 Hz on x, 0.2 rad/s; the filter does not cover it'),
        (Vibration(110.0, 0.2, 0.8, 'x', 0.14), OK, '110.0 Hz on x'),
        (Vibration(33.0, 0.2, 0.1, 'x', 0.85), OK, 'no line'),
        (None, OK, 'not enough'),
    ],
)  # fmt: skip
def test_a_line_that_the_filter_lets_through_is_a_warning(vibration, level, words):
    told = vibration_status('rates', 'rad/s', vibration)
    assert told.level == level
    assert words in told.message


def test_a_vibration_is_told_live(probe, start):
    watch = start('sensor_watch')
    told = probe.listen('/diagnostics')
    probe.meet('/imu/data')
    shaken = [
        {'header': stamp(4_000_000 * k),
         'angular_velocity': {'y': 0.3 * math.sin(2 * math.pi * 40.0 * k * 0.004)}}
        for k in range(4000)
    ]  # fmt: skip
    probe.publish('/imu/data', *shaken[:1000])
    probe.publish('/imu/data', *shaken[1000:])
    probe.until(lambda: 'Hz on y' in getattr(entries(told).get(WATCHED), 'message', ''))
    found = entries(told)[WATCHED]
    assert found.message.startswith(('40.', '39.'))
    assert found.level == WARN
    assert watch.end() == 0
