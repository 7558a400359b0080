"""How all nodes begin and end: arguments, parameters with descriptors, one executor, exit.

No topics here.
"""

from __future__ import annotations

import contextlib
import difflib
import inspect
import itertools
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import rclpy
import yaml
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.logging import LoggingSeverity, get_logger_level, set_logger_level
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions

from quad_bridge.arguments import complain, one_line, say
from quad_bridge.errors import BadInputError, QuadBridgeError
from quad_bridge.nodes.fence import Fence

T = TypeVar('T', str, bool, int, float, list[str])
IDLE_POLL_S, LOOK_S = 1.0, 0.02  # how often, and for how long, events are looked at
WAKE_S = 0.5  # how long a signal may wait: rclpy's wait does not return for one
RCLError = rclpy_implementation.RCLError
WRONG = (QuadBridgeError, ParameterException, NameValidationException)
"""Errors that a wrong parameter or name makes a node's constructor raise."""
_OF_THE_LIBRARY = re.compile(r'^failed to initialize \w+: |, at \S+:\d+')
_FORMS = {
    'remap rule': 'write -r FROM:=TO; names have letters, digits and _, and begin with no digit',
    'parameter override rule': "write -p NAME:=VALUE, an empty value as ''",
}
_ROS_OWN = ('use_sim_time', 'qos_overrides.', 'start_type_description_service')
_KINDS: dict[type, str] = {
    bool: 'true or false', int: 'a whole number', float: 'a number with a decimal point',
    str: 'a text', list: 'a list of texts',
}  # fmt: skip
"""What a parameter must be, by the type of its default."""


def overrides(node: Any) -> dict[str, Any]:
    """Parameters set by files, the command line or the node's maker, declared or not."""
    with node.handle:
        parameters = node.handle.get_parameters(Parameter)
    overrides = getattr(node, 'own_overrides', {})
    return {name: parameter.value for name, parameter in parameters.items()} | overrides


class RarePolling(ReentrantCallbackGroup):  # type: ignore[misc]
    """Entities that the executor looks at for a moment every second.

    rclpy waits for two events of QoS at each publisher and subscription, and pays for each of them
    with every message that the node receives.
    """

    def __init__(self) -> None:
        super().__init__()
        self._next_s = self._until_s = 0.0

    def can_execute(self, entity: Any) -> bool:
        """Whether it is looked at now."""
        del entity
        now_s = time.monotonic()
        if now_s >= self._next_s:
            self._next_s, self._until_s = now_s + IDLE_POLL_S, now_s + LOOK_S
        return now_s < self._until_s


def poll_rarely(*entities: Any) -> None:
    """Have the executor look seldom at the events of publishers and subscriptions."""
    for entity in entities:
        for handler in getattr(entity, 'event_handlers', ()):
            handler.callback_group = _RARELY
            _RARELY.add_entity(handler)


_RARELY = RarePolling()


def refuse_unknown(node: Any, known: Iterable[str]) -> None:
    """Raise BadInputError for a set parameter that the node does not have."""
    names = set(known)
    for name in overrides(node):
        if name not in names and not name.startswith(_ROS_OWN):
            near = difflib.get_close_matches(name, names, cutoff=0.7)
            groups = sorted({re.sub(r'\..*', '.*', name) for name in names})
            remedy = f'is it {near[0]}?' if near else f'known are {", ".join(groups)}'
            raise BadInputError(f'parameter {name}', 'is unknown', remedy=remedy)


def declared(
    node: Any, name: str, default: T, description: str, limits: tuple[float, float] | None = None
) -> T:
    """Declare a read-only parameter of the default's type, with its range; its value.

    Raises BadInputError where what was set does not fit.
    """
    descriptor = ParameterDescriptor(description=description, read_only=True)
    if limits is not None and isinstance(default, float):
        span = FloatingPointRange(from_value=limits[0], to_value=limits[1], step=0.0)
        descriptor.floating_point_range = [span]
    elif limits is not None:
        low, high = (int(limit) for limit in limits)
        descriptor.integer_range = [IntegerRange(from_value=low, to_value=high, step=1)]
    try:
        value: Any = node.declare_parameter(name, default, descriptor).value
    except ParameterException as error:
        span = '' if limits is None else ' in {:.10g} .. {:.10g}'.format(*limits)
        raise BadInputError(f'parameter {name}', f'must be {_KINDS[type(default)]}{span}',
                            repr(overrides(node).get(name)), description) from error  # fmt: skip
    return type(default)(value)


def refuse_arguments(name: str) -> None:
    """Raise BadInputError for what no node takes: rclpy ignores what is not behind --ros-args."""
    is_own, own = True, list[str]()
    for word in sys.argv[1:]:
        if word in {'--ros-args', '--'}:
            is_own = word == '--'
        elif is_own:
            own.append(word)
    if {'-h', '--help'} & set(own):
        prefixes = os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)
        where = f'share/*/config/{name}.yaml'
        files = [path for prefix in prefixes for path in Path(prefix).glob(where)]
        say(f'usage: {name} [--ros-args -p NAME:=VALUE … --params-file FILE.yaml]\n'
            + ''.join(f'parameters, with their meaning: {path}\n' for path in files[:1]))
        sys.exit()
    if own:
        remedy = 'parameters stand behind --ros-args: --ros-args -p NAME:=VALUE'
        raise BadInputError(f'argument {own[0]}', 'is unknown', remedy=remedy)


def begin_ros() -> None:
    """Take what stands behind --ros-args; signals are the caller's.

    Raises BadInputError, in one line, where it is no argument of ROS or a file cannot be read.
    """
    for name, value in itertools.pairwise(sys.argv):
        if name == '--params-file':
            try:
                Path(value).read_bytes()
            except OSError as error:
                what = f'cannot be read ({error.strerror})'
                where = f'--params-file {value}'
                raise BadInputError(where, what, remedy='check the path') from error
    set_logger_level('rcl', LoggingSeverity.FATAL)  # it says the same, in lines of its own
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    except rclpy_implementation.UnknownROSArgsError as error:
        raise BadInputError('--ros-args', 'unknown argument', str(error)) from error
    except RCLError as error:
        words = _plain(error)
        remedy = next((remedy for kind, remedy in _FORMS.items() if kind in words), '')
        words = words.partition(' Error: ')[0].rstrip('.') if remedy else words
        raise BadInputError('--ros-args', words, remedy=remedy) from error
    finally:
        if get_logger_level('rcl') == LoggingSeverity.FATAL:
            set_logger_level('rcl', LoggingSeverity.UNSET)


def _plain(error: Exception) -> str:
    """One line of an error: what rcl says without the places in its own source."""
    return _OF_THE_LIBRARY.sub('', one_line(error))


def _with_file(words: str) -> str:
    """An error about a parameter, with the file in front in which that was set."""
    name = re.match(r'parameter (\S+): ', words)
    if name is None or any(word.startswith(f'{name[1]}:=') for word in sys.argv):
        return words
    with contextlib.suppress(OSError, ValueError, yaml.YAMLError):
        for option, file in reversed(list(itertools.pairwise(sys.argv))):  # the last one counts
            tree = yaml.safe_load(Path(file).read_text()) if option == '--params-file' else None
            if any(path.endswith(f'.ros__parameters.{name[1]}') for path in _paths(tree)):
                return f'{file}: {words}'
    return words


def _paths(tree: object, above: str = '') -> Iterator[str]:
    """The dotted paths of all values in a YAML tree."""
    if not isinstance(tree, dict):
        yield above
        return
    for key, below in tree.items():
        yield from _paths(below, f'{above}.{key}')


def tell_unused(node: Any) -> None:
    """Warn where parameter files hold nothing for this node."""
    if '--params-file' in sys.argv and not overrides(node):
        name = node.get_fully_qualified_name()
        text = f'the parameter files set nothing of {name}: root them at "{name}:" or "/**:"'
        node.get_logger().warning(text)


def run(factory: Callable[[], Any], name: str) -> NoReturn:
    """Spin one node until SIGINT, SIGTERM, SIGHUP or its own `exit_status`; then end the process.

    SIGHUP comes where the terminal closes, or its ssh breaks off; what `nohup` began ignores it.

    Nodes of its list `inside`, if it has one, spin with it; they begin before it and end after.
    The node's `close` runs while ROS still works; then executor, node and context end in this
    order, whatever failed before. A callback that fails is logged and left out. Exit status 2,
    with one line on stderr, where arguments or parameters are wrong or the node cannot begin.
    """
    stopping = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, lambda *_: stopping.set())
    status: int | None = None
    try:
        with contextlib.ExitStack() as ending:
            ending.callback(rclpy.try_shutdown)
            refuse_arguments(name)
            begin_ros()
            node = factory()
            nodes = [*getattr(node, 'inside', ()), node]
            for other in nodes:
                ending.callback(other.destroy_node)
            fence = getattr(node, 'fence', None) or Fence(node.get_logger().error)
            executor = SingleThreadedExecutor()
            ending.callback(executor.shutdown, timeout_sec=0)
            for other in nodes:
                poll_rarely(*other.publishers, *other.subscriptions)  # rclpy's own too
                for service in other.services:
                    service.callback = answering(service.callback, fence)
                executor.add_node(other)
                ending.callback(fence.around(other.close))
            tell_unused(node)
            for other in nodes:
                getattr(other, 'begin', bool)()
            while status is None:
                _spin_once(executor, fence)
                status = 0 if stopping.is_set() else getattr(node, 'exit_status', None)
    except ExternalShutdownException:
        status = 0
    except (*WRONG, RCLError, OSError) as error:
        complain(f'{name}: {_with_file(_plain(error))}\n')
        status = 2
    _leave(status or 0)


def answering(callback: Callable[..., Any], fence: Fence) -> Callable[..., Any]:
    """A service's callback that answers though it fails: whoever asked would wait for ever."""

    async def answer(request: Any, response: Any) -> Any:
        try:
            reply = callback(request, response)
            return await reply if inspect.isawaitable(reply) else reply
        except Exception as error:  # noqa: BLE001  (whatever it is, it is answered)
            _fail(response, f'the service failed: {one_line(error)}', error)
            if not isinstance(response, ChangeState.Response):  # a transition that does not fit
                fence.take(error)
            return response

    return answer


def _fail(response: Any, words: str, error: Exception) -> None:
    """Fill in that it failed; raises `error` where a response has no place for that."""
    response = getattr(response, 'result', response)  # as in rcl_interfaces
    for success, reason in (('success', 'message'), ('successful', 'reason')):
        if hasattr(response, success):
            setattr(response, success, False)
            if hasattr(response, reason):
                setattr(response, reason, words)
            return
    raise error


def _leave(status: int) -> NoReturn:
    """End the process; a thread that still computes or waits is not waited for.

    The interpreter's own end would meet such a thread in the middle of compiled code and abort.
    """
    if threading.active_count() > 1:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError):
                stream.flush()
        os._exit(status)
    sys.exit(status)


def _spin_once(executor: Any, fence: Fence) -> None:
    try:
        executor.spin_once(timeout_sec=WAKE_S)
    except ExternalShutdownException:
        raise
    except Exception as error:  # noqa: BLE001  (a node in flight does not end for one message)
        fence.take(error)
    else:
        fence.passed()
