"""The `sensor_watch` node: what shakes an aircraft whose bridge does not say so. Wiring only.

The bridge watches its own control cycles; this is for another autopilot's, or a bag's, /imu/data.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from sensor_msgs.msg import Imu

from quad_bridge import ros_node
from quad_bridge.diagnostics import callback_entries, diagnostic_array
from quad_bridge.fence import Fence
from quad_bridge.qos import EVENT, STREAM
from quad_bridge.sensor_status import vibration_entries
from quad_bridge.sensors.window import SHAKING


class SensorWatch(Node):  # type: ignore[misc]
    """See the module."""

    def __init__(self) -> None:
        super().__init__('sensor_watch')
        ros_node.refuse_unknown(self, ('gyro_filter_hz',))
        self._filter_hz = ros_node.integer(
            self, 'gyro_filter_hz', 42, (1, 1000), "cutoff of the STM32's gyro filter, Hz"
        )
        self._stamps: deque[float] = deque(maxlen=SHAKING)
        self._samples: deque[tuple[float, ...]] = deque(maxlen=SHAKING)
        self._diagnostics = self.create_publisher(DiagnosticArray, 'diagnostics', EVENT)
        self.create_subscription(Imu, 'imu/data', self._on_imu, STREAM)
        self.fence = Fence(self.get_logger().error)
        ros_node.steady_timer(self, 1.0, self._on_report)

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
        entries = vibration_entries(rate_hz, samples, self._filter_hz)
        entries += callback_entries(self.fence.failed, self.fence.lately())
        now = self.get_clock().now().to_msg()
        self._diagnostics.publish(diagnostic_array(self.get_name(), '', now, entries))


def main() -> None:
    """Run the node until it is interrupted; exit status 2 where its parameters are wrong."""
    ros_node.run(SensorWatch, 'sensor_watch')
