"""A node's timers, streams and stamps: on real clocks, or in lockstep with the virtual STM32.

In lockstep publishers and subscriptions of a stream report by themselves how far they are. What
time it is in a process, and who waits for whom, is in lockstep.py.
"""

from __future__ import annotations

import functools
import struct
from collections.abc import Callable
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.time import Time

from quad_bridge.lockstep import STREAMS, Participant, Timer
from quad_bridge.lockstep import clock as here
from quad_bridge.nodes.qos import STREAM

_STAMP = struct.Struct('<iI')


class TimedNode:
    """Mix it in before rclpy's Node: in lockstep, timers and `get_clock` are simulated."""

    @property
    def simulated(self) -> bool:
        """Whether time is simulated, be it by `use_sim_time` or in lockstep."""
        node: Any = self
        return here().simulated or bool(node.get_parameter('use_sim_time').value)

    def keep_time(self) -> None:
        """Let the executor run what is due in simulated time. Call it once, after rclpy's part."""
        node: Any = self
        time = here()
        if isinstance(time, Participant):
            time.on_due = node.create_guard_condition(time.step).trigger

    def get_clock(self) -> Any:
        """The clock of rclpy; in lockstep one with `now` only."""
        return _Now() if here().simulated else super().get_clock()  # type: ignore[misc]

    def create_publisher(self, kind: Any, topic: str, *others: Any, **more: Any) -> Any:
        """A publisher of rclpy; in lockstep it reports what it publishes."""
        publisher: Any = super().create_publisher(kind, topic, *others, **more)  # type: ignore[misc]
        stream = _contract(topic)
        if here().simulated and stream in STREAMS:
            published = functools.partial(here().published, stream)
            publisher.publish = _then(publisher.publish, published)
        return publisher

    def create_subscription(
        self, kind: Any, topic: str, callback: Any, qos: Any, **more: Any
    ) -> Any:
        """A subscription of rclpy; in lockstep a stream loses nothing."""
        stream = _contract(topic)
        if here().simulated and stream in STREAMS:
            callback = _then(callback, functools.partial(here().handled, stream))
            qos = STREAM if qos.reliability != STREAM.reliability else qos
        return super().create_subscription(kind, topic, callback, qos, **more)  # type: ignore[misc]

    def destroy_subscription(self, subscription: Any) -> bool:
        """Destroy a subscription; the lockstep no longer waits for it."""
        here().forget(_contract(subscription.topic_name))
        return bool(super().destroy_subscription(subscription))  # type: ignore[misc]

    def create_timer(self, period_s: float, callback: Any, *, clock: Any = None) -> Any:
        """A timer of rclpy, by default on the steady clock; in lockstep on the simulated time.

        A node's own clock stands still for as long as the system clock was set back.
        """
        time = here()
        if isinstance(time, Participant):
            return time.timer(period_s, callback)
        steady = clock or Clock(clock_type=ClockType.STEADY_TIME)
        return super().create_timer(period_s, callback, clock=steady)  # type: ignore[misc]

    def destroy_timer(self, timer: Any) -> bool:
        """Destroy a timer of rclpy or of the lockstep."""
        time = here()
        if isinstance(time, Participant) and isinstance(timer, Timer):
            time.remove(timer)
            return True
        return bool(super().destroy_timer(timer))  # type: ignore[misc]


class _Now:
    """Simulated time as a clock of ROS."""

    def now(self) -> Any:
        return Time(nanoseconds=here().now_ns(), clock_type=ClockType.ROS_TIME)


def _contract(topic: str) -> str:
    """The contract's name of a topic, whatever the namespace it is in."""
    return next((stream for stream in STREAMS if f'/{topic}'.endswith(stream)), topic)


def _then(act: Callable[..., None], tell: Callable[[int], None]) -> Callable[..., None]:
    """`act` on a message of a stream, then `tell` gets its stamp."""

    @functools.wraps(act)  # rclpy looks at its arguments
    def done(message: Any, *about: Any) -> None:
        act(message, *about)
        if isinstance(message, (bytes, memoryview)):  # which begins with its header
            sec, nanosec = _STAMP.unpack_from(message, 4)
            tell(int(sec) * 1_000_000_000 + int(nanosec))
        else:
            tell(nanoseconds(message.header.stamp))

    return done


def nanoseconds(stamp: Any) -> int:
    """A `builtin_interfaces/Time` in ns."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
