"""The `monitor` node: a dashboard in the terminal during a flight. Wiring only.

On a terminal the screen is rewritten and a bell rings when enough data are in; piped, it prints a
block of lines every few seconds.
"""

from __future__ import annotations

import math
import sys
import time
from collections import deque
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Vector3Stamped
from rcl_interfaces.msg import ParameterEvent
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import BatteryState, Imu

from quad_bridge.arguments import say
from quad_bridge.errors import BadInputError
from quad_bridge.gains.table import AXES
from quad_bridge.monitor import view
from quad_bridge.monitor.coverage import BAND, Pairs, coverage
from quad_bridge.nodes import ros_node
from quad_bridge.nodes.node_time import nanoseconds
from quad_bridge.nodes.qos import EVENT, HEARD, STREAM
from quad_bridge.wire.axes import angles_of

MIN_NEW = 250  # cycles between two looks at the coverage
CLEAR, HOME, BELL = '\x1b[2J', '\x1b[H\x1b[J', '\a'
NUMBERS = {
    'band_low_rad_s': (BAND[0], 'low end of the band that is to be covered, rad/s', (0.01, 100.0)),
    'band_high_rad_s': (BAND[1], 'its high end, rad/s', (0.1, 1000.0)),
    'validation_s': (
        10.0, 'validation that is to be flown before "stop now", s', (0.0, 600.0)
    ),
}  # fmt: skip
"""Name: default, description, range."""


class Monitor(Node):  # type: ignore[misc]
    """See the module."""

    def __init__(self) -> None:
        super().__init__('monitor')
        ros_node.refuse_unknown(self, [*NUMBERS, 'every_s'])
        numbers = {name: ros_node.declared(self, name, *rest) for name, rest in NUMBERS.items()}
        self._band = numbers['band_low_rad_s'], numbers['band_high_rad_s']
        if not self._band[0] < self._band[1]:
            raise BadInputError(
                'parameter band_low_rad_s', f'is not below band_high_rad_s {self._band[1]:g}',
                f'{self._band[0]:g}', 'lower it',
            )
        self._validation_s = numbers['validation_s']
        period_s = ros_node.declared(self, 'every_s', 5, 'between blocks when piped, s', (1, 3600))
        self._terminal = sys.stdout is not None and sys.stdout.isatty()
        self._state = view.State(target_band=self._band)
        self._pairs, self._stamps = Pairs(), deque[int](maxlen=250)
        self._step_s = 0.004
        self._role, self._axis, self._new, self._text = '', '', 0, ''
        self.create_subscription(DiagnosticArray, 'diagnostics', self._on_diagnostics, EVENT)
        self.create_subscription(Imu, 'imu/data', self._on_imu, STREAM)
        self.create_subscription(BatteryState, 'battery', self._on_battery, STREAM)
        self.create_subscription(Vector3Stamped, 'excitation/applied', self._on_applied, STREAM)
        self.create_subscription(ParameterEvent, 'excitation/segment', self._on_segment, HEARD)
        self.create_subscription(ParameterEvent, 'logger/bag', self._on_bag, HEARD)
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # whatever becomes of simulated time
        self.create_timer(0.5 if self._terminal else period_s, self._show, clock=steady)
        self.create_timer(1.0, self._look, clock=steady)

    def begin(self) -> None:
        """Clear the screen."""
        if self._terminal:
            say(CLEAR)

    def close(self) -> None:
        """Leave the last screen where it stands."""

    def _on_diagnostics(self, message: Any) -> None:
        now = time.monotonic()
        for status in message.status:
            values = {item.key: item.value for item in status.values}
            self._state.entries[status.name] = view.Entry(
                int.from_bytes(status.level, 'little'), status.message, values, now
            )

    def _on_imu(self, message: Any) -> None:
        stamp = nanoseconds(message.header.stamp)
        self._stamps.append(stamp)
        self._state.imu_at_s = time.monotonic()
        q, rate = message.orientation, message.angular_velocity
        roll, pitch, yaw = map(math.degrees, angles_of((q.w, q.x, q.y, q.z)))
        is_measured = message.orientation_covariance[0] >= 0.0  # REP-145: -1 where it is not
        self._state.angles_deg = (roll, pitch, yaw) if is_measured else (math.nan,) * 3
        if self._role == 'train':
            self._pairs.rate(stamp, (rate.x, rate.y, rate.z)[AXES.index(self._axis)])

    def _on_applied(self, message: Any) -> None:
        if self._role == 'train':
            v = message.vector
            self._pairs.excitation(nanoseconds(message.header.stamp),
                                   (v.x, v.y, v.z)[AXES.index(self._axis)])
            self._state.trained_s += self._step_s
            self._new += 1
        elif self._role == 'validation':
            self._state.validated_s += self._step_s

    def _on_battery(self, message: Any) -> None:
        self._state.battery_v, self._state.battery_at_s = message.voltage, time.monotonic()

    def _on_segment(self, message: Any) -> None:
        values = {p.name: p.value.string_value for p in message.changed_parameters}
        self._role, axis = values.get('segment', ''), values.get('axis', '')
        if axis in AXES and axis != self._axis:
            if self._state.suffices(self._validation_s):
                self._state.done.add(self._axis)
            self._axis = axis
            self._begin_anew()
        if self._axis not in AXES or axis not in AXES:
            self._role = ''
        self._state.segment = values

    def _on_bag(self, message: Any) -> None:
        values = {p.name: p.value.string_value for p in message.changed_parameters}
        previous, self._state.bag = self._state.bag, values.get('path', '')
        self._state.bag_state, self._state.bag_at_s = values.get('state', ''), time.monotonic()
        if previous != self._state.bag:  # what it does not hold does not help it
            self._state.done.clear()
            self._begin_anew()

    def _begin_anew(self) -> None:
        self._pairs.clear()
        self._state.coverage, self._text = None, ''
        self._state.trained_s = self._state.validated_s = 0.0

    def _look(self) -> None:
        if self._new >= MIN_NEW:
            self._new = 0
            parts, dt = self._pairs.parts()
            if dt > 0.0 and not self._state.covered:
                self._state.coverage = coverage(parts, dt, self._state.reachable_band(self._band))
        if len(self._stamps) > 1:
            step_s = 1e-9 * float(np.median(np.diff(np.array(self._stamps))))
            if step_s > 0.0:
                self._step_s, self._state.rate_hz = step_s, 1.0 / step_s
        text = self._state.call(self._validation_s)
        if text and text != self._text:
            self._text = text
            self._write(BELL if self._terminal else f'{text}\n')

    def _show(self) -> None:
        text = '\n'.join(self._state.lines(time.monotonic()))
        self._write(f'{HOME}{text}\n\n{self._text}\n' if self._terminal else f'{text}\n\n')

    def _write(self, text: str) -> None:
        if not say(text):
            raise ExternalShutdownException  # nobody looks


def main() -> None:
    """Run the node until it is interrupted; exit status 2 where its parameters are wrong."""
    ros_node.run(Monitor, 'monitor')
