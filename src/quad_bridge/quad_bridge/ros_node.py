"""How the nodes of this package begin and end: parameters with descriptors, one executor, exit.

No topics here.
"""

from __future__ import annotations

import contextlib
import difflib
import itertools
import re
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
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.logging import LoggingSeverity, get_logger_level, set_logger_level
from rclpy.signals import SignalHandlerOptions

from quad_bridge.arguments import one_line
from quad_bridge.errors import BadInputError, QuadBridgeError
from quad_bridge.sparing import Sparing

WAKE_S = 0.1
"""How long a signal may wait: rclpy's wait does not return for one."""
MOST_IN_A_ROW = 1000
"""Failures without anything that works between them: it is ROS itself that fails."""
LONGEST = 500
"""Characters of a fault that are logged."""
RCLError = rclpy_implementation.RCLError
WRONG = (QuadBridgeError, ParameterException, NameValidationException)
"""What a wrong parameter or name makes a node's constructor raise."""
_OF_THE_LIBRARY = re.compile(r'^failed to initialize \w+: |, at \S+:\d+')
_FORMS = {
    'remap rule': 'write -r FROM:=TO; names have letters, digits and _, and begin with no digit',
    'parameter override rule': "write -p NAME:=VALUE, an empty value as ''",
}
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
            near = difflib.get_close_matches(name, names, cutoff=0.7)
            groups = sorted({re.sub(r'\..*', '.*', one) for one in names})
            remedy = f'is it {near[0]}?' if near else f'known are {", ".join(groups)}'
            raise BadInputError(f'parameter {name}', 'is unknown', remedy=remedy)


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
        self._told = 0
        self._log = log
        self._in_a_row: dict[int, int] = {}
        """By thread: the port goes on while ROS fails."""
        self._sparing = Sparing()

    def take(self, error: Exception) -> None:
        """Note what a callback has raised."""
        self.failed += 1
        thread = threading.get_ident()
        self._in_a_row[thread] = self._in_a_row.get(thread, 0) + 1
        if self._in_a_row[thread] > MOST_IN_A_ROW:
            raise error
        frame = traceback.extract_tb(error.__traceback__)[-1]
        words = f'{type(error).__name__}: {" ".join(str(error).split())[:LONGEST]}'
        where = f'{Path(frame.filename).name}:{frame.lineno}'
        if self._sparing.allow(where + words, time.monotonic()):
            self._log(f'a callback failed and was left out: {words} ({where})')

    def passed(self) -> None:
        """Note that one has not failed."""
        self._in_a_row[threading.get_ident()] = 0

    def lately(self) -> int:
        """How many have raised since this was last asked."""
        failed = self.failed
        new, self._told = failed - self._told, failed
        return new

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


def begin_ros() -> None:
    """Take what stands behind --ros-args; signals are the caller's.

    Raises BadInputError, in one line, where it is no argument of ROS or a file cannot be read.
    """
    for name, value in itertools.pairwise(sys.argv):
        if name == '--params-file':
            _readable(value)
    set_logger_level('rcl', LoggingSeverity.FATAL)  # it says the same, in lines of its own
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    except rclpy_implementation.UnknownROSArgsError as error:
        raise BadInputError('--ros-args', 'unknown argument', str(error)) from error
    except RCLError as error:
        raise BadInputError('--ros-args', *_told(_plain(error))) from error
    finally:
        if get_logger_level('rcl') == LoggingSeverity.FATAL:
            set_logger_level('rcl', LoggingSeverity.UNSET)


def _readable(file: str) -> None:
    try:
        with Path(file).open('rb') as stream:
            stream.read(1)
    except OSError as error:
        what = f'cannot be read ({error.strerror})'
        raise BadInputError(f'--params-file {file}', what, remedy='check the path') from error


def _told(words: str) -> tuple[str, None, str]:
    """What was wrong, and where rcl speaks of its lexer what would be right."""
    for kind, remedy in _FORMS.items():
        if kind in words:
            return words.partition(' Error: ')[0].rstrip('.'), None, remedy
    return words, None, ''


def _plain(error: Exception) -> str:
    """One line of an error: what rcl says without the places in its own source."""
    return _OF_THE_LIBRARY.sub('', one_line(error))


def tell_unused(node: Any) -> None:
    """Warn where parameter files were given and hold nothing of this node."""
    if '--params-file' in sys.argv and not overrides(node):
        name = node.get_fully_qualified_name()
        text = f'the parameter files hold nothing of {name}: root it at "{name}:" or "/**:"'
        node.get_logger().warning(text)


def run(factory: Callable[[], Any], name: str) -> None:
    """Spin one node until SIGINT or SIGTERM, then call its `close` while ROS still works.

    A callback that fails is logged and left out. Exit status 2, with one line on stderr, where
    arguments or parameters are wrong or the node cannot begin.
    """
    stopping = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopping.set())
    node = executor = None
    try:
        try:
            begin_ros()
            node = factory()
            tell_unused(node)
            begin = getattr(node, 'begin', None)
            if begin is not None:
                begin()
        except (*WRONG, RCLError, OSError) as error:
            sys.stderr.write(f'{name}: {_plain(error)}\n')
            sys.exit(2)
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        fence = getattr(node, 'fence', None) or Fence(node.get_logger().error)
        while not stopping.is_set():
            _spin_once(executor, fence)
    except ExternalShutdownException:
        pass
    finally:
        if node is not None:
            node.close()
            if executor is not None:
                executor.shutdown(timeout_sec=0)  # else its own end comes after ROS's
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
