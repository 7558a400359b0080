"""The `sensor_watch` node: what shakes the aircraft, live in `/diagnostics`. Wiring only."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from sensor_msgs.msg import Imu

from quad_bridge import ros_node
from quad_bridge.diagnostics import OK, WARN, Status, diagnostic_array
from quad_bridge.qos import EVENT, STREAM
from quad_bridge.sensors.vibration import Vibration, strongest

SAMPLES = 1024
"""Four seconds at 250 Hz."""
STANDS_OUT = 0.3
"""Share of the power from which a line is more than noise."""


class SensorWatch(Node):  # type: ignore[misc]
    """See the module."""

    def __init__(self) -> None:
        super().__init__('sensor_watch')
        ros_node.refuse_unknown(self, ('gyro_filter_hz',))
        self._filter_hz = ros_node.integer(
            self, 'gyro_filter_hz', 42, (1, 1000), "cutoff of the STM32's gyro filter, Hz"
        )
        self._stamps: deque[float] = deque(maxlen=SAMPLES)
        self._samples: deque[tuple[float, ...]] = deque(maxlen=SAMPLES)
        self._diagnostics = self.create_publisher(DiagnosticArray, 'diagnostics', EVENT)
        self.create_subscription(Imu, 'imu/data', self._on_imu, STREAM)
        self.create_timer(1.0, self._on_report)

    def close(self) -> None:
        """Nothing is held open."""

    def _on_imu(self, message: Any) -> None:
        rate, felt = message.angular_velocity, message.linear_acceleration
        self._stamps.append(message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec)
        self._samples.append((rate.x, rate.y, rate.z, felt.x, felt.y, felt.z))

    def _on_report(self) -> None:
        samples = np.array(self._samples, dtype=float).reshape(-1, 6)
        steps = np.diff(np.array(self._stamps))
        rate_hz = 1.0 / float(np.median(steps)) if len(steps) and np.median(steps) > 0.0 else 0.0
        entries = [
            vibration_status(name, unit, strongest(part, rate_hz, self._filter_hz))
            for name, unit, part in (
                ('vibration of the rates', 'rad/s', samples[:, :3]),
                ('vibration of the accelerations', 'm/s²', samples[:, 3:]),
            )
        ]
        now = self.get_clock().now().to_msg()
        self._diagnostics.publish(diagnostic_array(self.get_name(), '', now, entries))


def vibration_status(name: str, unit: str, found: Vibration | None) -> Status:
    """What the spectrum says; a line that the filter lets through is a warning."""
    if found is None:
        return Status(name, OK, 'not enough of /imu/data yet')
    values = {
        'peak (Hz)': f'{found.frequency_hz:.1f}',
        f'amplitude ({unit})': f'{found.amplitude:.4g}',
        'axis': found.axis,
        'share of what shakes (%)': f'{100 * found.share:.0f}',
        'gain of the filter there': f'{found.filter_gain:.2f}',
    }
    if found.share < STANDS_OUT:
        return Status(name, OK, 'no line stands out', values)
    text = f'{found.frequency_hz:.1f} Hz on {found.axis}, {found.amplitude:.3g} {unit}'
    if found.covered:
        return Status(name, OK, f'{text}; the filter covers it', values)
    return Status(name, WARN, f'{text}; the filter does not cover it', values)


def main() -> None:
    """Run the node until it is interrupted; exit status 2 where its parameters are wrong."""
    ros_node.run(SensorWatch, 'sensor_watch')
