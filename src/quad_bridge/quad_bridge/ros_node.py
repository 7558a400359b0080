"""How the nodes of this package begin and end: parameters with descriptors, one executor, exit.

No topics here.
"""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import rclpy
from rcl_interfaces.msg import IntegerRange, ParameterDescriptor
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from quad_bridge.errors import BadInputError, QuadBridgeError
from quad_bridge.sparing import Sparing

WAKE_S = 0.1
"""How long a signal may wait: rclpy's wait does not return for one."""
MOST_IN_A_ROW = 1000
"""Failures without anything that works between them: it is ROS itself that fails."""
LONGEST = 500
"""Characters of a fault that are logged."""
_ROS_OWN = ('use_sim_time', 'qos_overrides.', 'start_type_description_service')


def overrides(node: Any) -> dict[str, Any]:
    """What files and the command line set, declared or not; name to value."""
    given = node._parameter_overrides  # noqa: SLF001  (rclpy has no public way to ask)
    return {name: parameter.value for name, parameter in given.items()}


def refuse_unknown(node: Any, known: Iterable[str]) -> None:
    """Raise BadInputError for a set parameter that the node does not have."""
    names = set(known)
    for name in overrides(node):
        if name not in names and not name.startswith(_ROS_OWN):
            raise BadInputError(
                f'parameter {name}',
                'is unknown',
                remedy=f'known are {", ".join(sorted(names))}',
            )


def text(node: Any, name: str, default: str, description: str) -> str:
    """Declare a read-only string parameter and return its value."""
    descriptor = ParameterDescriptor(description=description, read_only=True)
    return str(node.declare_parameter(name, default, descriptor).value)


def choice(
    node: Any, name: str, options: tuple[str, ...], description: str, *, no: str = ''
) -> str:
    """Declare a string parameter of a few values, the first being the default.

    Where `no` is given, false stands for it: YAML takes a plain `off` for that. Raises
    BadInputError.
    """
    descriptor = ParameterDescriptor(
        description=f'{description}: {", ".join(options)}', read_only=True, dynamic_typing=True
    )
    value = node.declare_parameter(name, options[0], descriptor).value
    value = no if no and value is False else value
    if value not in options:
        where = f'parameter {name}'
        raise BadInputError(where, f'must be one of {", ".join(options)}', repr(value))
    return value


def flag(node: Any, name: str, default: bool, description: str) -> bool:
    """Declare a read-only bool parameter and return its value."""
    descriptor = ParameterDescriptor(description=description, read_only=True)
    return bool(node.declare_parameter(name, default, descriptor).value)


def integer(node: Any, name: str, default: int, limits: tuple[int, int], description: str) -> int:
    """Declare a read-only integer parameter with its range and return its value."""
    descriptor = ParameterDescriptor(
        description=description,
        read_only=True,
        integer_range=[IntegerRange(from_value=limits[0], to_value=limits[1], step=1)],
    )
    return int(node.declare_parameter(name, default, descriptor).value)


def steady_timer(node: Any, period_s: float, callback: Callable[[], None]) -> Any:
    """Create a timer that runs whatever becomes of the system's clock, or of simulated time.

    A node's own clock stands still for as long as the system clock was set back. (The timers of
    a ManagedNode are of this kind without it.)
    """
    return node.create_timer(period_s, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))


class Fence:
    """Keeps a node alive when one of its callbacks fails: logs the fault and counts it.

    `log` takes one line. What fails without end is not kept: `take` raises it again.
    """

    def __init__(self, log: Callable[[str], None]) -> None:
        self.failed = 0
        """Callbacks that have raised."""
        self._log = log
        self._in_a_row = 0
        self._sparing = Sparing()

    def take(self, error: Exception) -> None:
        """Note what a callback has raised."""
        self.failed += 1
        self._in_a_row += 1
        if self._in_a_row > MOST_IN_A_ROW:
            raise error
        frame = traceback.extract_tb(error.__traceback__)[-1]
        words = f'{type(error).__name__}: {" ".join(str(error).split())[:LONGEST]}'
        where = f'{Path(frame.filename).name}:{frame.lineno}'
        if self._sparing.allow(where + words, time.monotonic()):
            self._log(f'a callback failed and was left out: {words} ({where})')

    def passed(self) -> None:
        """Note that one has not failed."""
        self._in_a_row = 0

    def around(self, callback: Callable[..., None]) -> Callable[..., None]:
        """`callback`, for a thread of its own, that never raises."""

        def fenced(*args: Any) -> None:
            try:
                callback(*args)
            except Exception as error:  # noqa: BLE001  (whatever it is, the thread goes on)
                with contextlib.suppress(Exception):
                    self.take(error)
            else:
                self.passed()

        return fenced


def run(factory: Callable[[], Any], name: str) -> None:
    """Spin one node until SIGINT or SIGTERM, then call its `close` while ROS still works.

    A callback that fails is logged and left out. Exit status 2, with one line on stderr, where
    the parameters are wrong.
    """
    stopping = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopping.set())
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = None
    try:
        node = factory()
        begin = getattr(node, 'begin', None)
        if begin is not None:
            begin()
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        fence = getattr(node, 'fence', None) or Fence(node.get_logger().error)
        while not stopping.is_set():
            _spin_once(executor, fence)
    except ExternalShutdownException:
        pass
    except (QuadBridgeError, ParameterException) as error:
        sys.stderr.write(f'{name}: {" ".join(str(error).split())}\n')
        sys.exit(2)
    finally:
        if node is not None:
            node.close()
            node.destroy_node()
        rclpy.try_shutdown()


def _spin_once(executor: Any, fence: Fence) -> None:
    try:
        executor.spin_once(timeout_sec=WAKE_S)
    except ExternalShutdownException:
        raise
    except Exception as error:  # noqa: BLE001  (a node in flight does not end for one message)
        fence.take(error)
    else:
        fence.passed()
