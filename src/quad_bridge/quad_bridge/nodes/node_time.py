"""A node's timers and stamps: on real clocks, or in lockstep with the virtual STM32.

What time it is in a process, and who waits for whom, is in lockstep.py.
"""

from __future__ import annotations

import struct
from typing import Any

from rclpy.clock import ClockType
from rclpy.time import Time

from quad_bridge.lockstep import Participant, Timer, clock

_STAMP = struct.Struct('<iI')


class TimedNode:
    """Mix it in before rclpy's Node: in lockstep, timers and `get_clock` are simulated."""

    @property
    def simulated(self) -> bool:
        """Whether time is simulated, be it by `use_sim_time` or in lockstep."""
        node: Any = self
        return clock().simulated or bool(node.get_parameter('use_sim_time').value)

    def keep_time(self) -> None:
        """Let the executor run what is due in simulated time. Call it once, after rclpy's part."""
        node: Any = self
        time = clock()
        if isinstance(time, Participant):
            time.on_due = node.create_guard_condition(time.step).trigger

    def get_clock(self) -> Any:
        """As rclpy's; only `now` in lockstep."""
        return _Now() if clock().simulated else super().get_clock()  # type: ignore[misc]

    def create_timer(
        self, timer_period_sec: float, callback: Any, *others: Any, **more: Any
    ) -> Any:
        """As rclpy's; in lockstep whatever its clock."""
        time = clock()
        if isinstance(time, Participant):
            return time.timer(timer_period_sec, callback)
        return super().create_timer(timer_period_sec, callback, *others, **more)  # type: ignore[misc]

    def destroy_timer(self, timer: Any) -> bool:
        """As rclpy's."""
        time = clock()
        if isinstance(time, Participant) and isinstance(timer, Timer):
            time.remove(timer)
            return True
        return bool(super().destroy_timer(timer))  # type: ignore[misc]


class _Now:
    """Simulated time as a clock of ROS."""

    def now(self) -> Any:
        return Time(nanoseconds=clock().now_ns(), clock_type=ClockType.ROS_TIME)


def stamp_of(raw: bytes | memoryview) -> int:
    """`header.stamp` of a serialised message that begins with a header, ns."""
    sec, nanosec = _STAMP.unpack_from(raw, 4)
    return int(sec) * 1_000_000_000 + int(nanosec)


def nanoseconds(stamp: Any) -> int:
    """A `builtin_interfaces/Time` in ns."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
