"""The tests' one participant in ROS: a process of its own that hears, publishes and calls.

Its process takes one JSON object per line and answers in lines; `Probe` is its client. No
test imports rclpy: a fault in the middleware ends the probe and one test, never the run.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nursery import Nursery

PATIENCE_S = 500.0
"""A bound on whatever is waited for, so long that no busy machine reaches it; measures nothing."""
RUN = 'import faulthandler, probe; faulthandler.enable(); probe.main()'
TRIGGER = 'std_srvs/srv/Trigger'
EVENT = 'rcl_interfaces/msg/ParameterEvent'
KINDS = {bool: (1, 'bool_value'), int: (2, 'integer_value'), float: (3, 'double_value'),
         str: (4, 'string_value')}  # fmt: skip
"""Of a parameter: its number and field in rcl_interfaces/msg/ParameterValue."""


# ---- the client ------------------------------------------------------------------------------


class Probe:
    """A participant in the ROS domain of the environment. What it has heard are plain objects with
    the fields of the messages; NaN is NaN, a byte is a number."""

    def __init__(self, folder: Path, nursery: Nursery) -> None:
        self._said = (folder / 'probe.stderr').open('w+', encoding='utf-8')
        theirs, ours = os.pipe()
        answers, told = os.pipe()
        self._asks, self._tells = os.fdopen(ours, 'w'), os.fdopen(answers)
        streams = theirs, told, self._said.fileno()
        self._process = nursery.fork(['rclpy', 'probe'], RUN, [], streams)
        for number in (theirs, told):
            os.close(number)
        self.pid = self._process.pid
        self._heard: dict[str, list[Any]] = {}
        self._answers: dict[int, Any] = {}
        self._ended = False
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def listen(self, topic: str, *, reliable: bool = True) -> list[Any]:
        """A list that grows with what is heard on the topic; its type is the contract's."""
        heard = self._heard.setdefault(f'topic {topic}', [])
        self._do('listen', topic=topic, kind=kind_of(topic), reliable=reliable)
        return heard

    def diagnostics(self, name: str, key: str = '', *, since_ns: int = 0) -> str:
        """The last message under this name in /diagnostics, or a value of it; empty before.

        `since_ns`: a time of this machine's clock; what was said earlier may be of another state.
        """
        heard = self._heard.get('topic /diagnostics')
        for array in reversed(self.listen('/diagnostics') if heard is None else heard):
            for status in array.status if stamp_ns(array) >= since_ns else ():
                if status.name == name:
                    values = {pair.key: pair.value for pair in status.values}
                    return str(values.get(key, '') if key else status.message)
        return ''

    def advertise(self, topic: str) -> None:
        """Have a publisher, which a first message needs so that somebody can know of it."""
        self._do('advertise', topic=topic, kind=kind_of(topic))

    def publish(self, topic: str, *messages: Mapping[str, Any], every_s: float = 0.0) -> None:
        """Say messages one after the other; `every_s`: the one message again and again.

        A message is a mapping of the fields that are not zero or empty; one that has a stamp has
        that of now, unless another is given.
        """
        self._do('publish', topic=topic, messages=messages, every_s=every_s, kind=kind_of(topic))

    def silence(self, topic: str) -> None:
        self._do('silence', topic=topic)

    def say_until(
        self, condition: Callable[[], object], topic: str, message: Mapping[str, Any]
    ) -> None:
        """Say a command until it has been heeded.

        On a busy machine one alone may be too old when it is read, or meet a link that is quiet.
        """
        self.publish(topic, message, every_s=0.5)
        self.until(condition, f'an answer to {topic}')
        self.silence(topic)

    def deliver(self, topic: str, *messages: Mapping[str, Any]) -> None:
        """Say messages, and wait until they wait at whoever listens."""
        self.publish(topic, *messages)
        self._do('delivered', topic=topic)

    def listeners(self, topic: str) -> int:
        return int(self._do('listeners', topic=topic))

    def opened(self, node: str) -> dict[str, set[str]]:
        """What a node publishes, hears, offers and calls, by full name."""
        return {what: set(names) for what, names in vars(self._do('opened', node=node)).items()}

    def nodes(self) -> list[str]:
        return [str(name) for name in self._do('nodes')]

    def meet(self, *topics: str) -> None:
        """Wait until somebody listens to each of these topics of ours."""
        for topic in topics:
            self.advertise(topic)
        self.until(lambda: all(self.listeners(topic) for topic in topics), f'ears for {topics}')

    def ask(self, service: str, kind: str = TRIGGER, **request: Any) -> Future[Any]:
        """Call a service as soon as it is there; the answer comes when it comes."""
        return self._send('ask', service=service, kind=kind, request=request)

    def call(self, service: str, kind: str = TRIGGER, **request: Any) -> Any:
        return self.answer(self.ask(service, kind, **request))

    def answer(self, answer: Any) -> Any:
        self.until(answer.done, answer.words)
        return answer.result()

    def serve(self, service: str, kind: str, **answer: Any) -> list[Any]:
        """Offer a service that always answers this; a list that grows with what is asked."""
        heard = self._heard.setdefault(f'service {service}', [])
        self._do('serve', service=service, kind=kind, response=answer)
        return heard

    def set_gains(self, values: Mapping[str, Any]) -> Future[Any]:
        """Ask the bridge for gains; its answer's `result` has `successful` and `reason`."""
        kind = 'rcl_interfaces/srv/SetParametersAtomically'
        wanted = event(values)['changed_parameters']
        return self.ask('/serial_bridge/set_gains', kind, parameters=wanted)

    def transition(self, node: str, number: int) -> bool:
        """Ask a lifecycle node for a transition (1 configure … 4 deactivate); whether it went."""
        kind = 'lifecycle_msgs/srv/ChangeState'
        return bool(self.call(f'{node}/change_state', kind, transition={'id': number}).success)

    def until(
        self, condition: Callable[[], object], what: object = '', *, pause_s: float = 0.01
    ) -> None:
        """Wait for a condition, however long a busy machine may take."""
        end_s = time.monotonic() + PATIENCE_S
        while not condition():
            assert not self._ended, f'the probe has ended: {self.words()[-2000:]}'
            assert time.monotonic() < end_s, f'never: {what}; {self._where()}'
            time.sleep(pause_s)

    def _where(self) -> str:
        """What the process was at, which ends with that."""
        self._process.send_signal(signal.SIGABRT)
        self._process.wait(PATIENCE_S)
        return self.words()[-2000:]

    def words(self) -> str:
        """What the probe itself, or the middleware in it, has said on stderr."""
        self._said.seek(0)
        return self._said.read()

    def close(self) -> int:
        """End the process; its exit status."""
        with contextlib.suppress(BrokenPipeError):
            self._asks.close()
        try:
            return self._process.wait(PATIENCE_S)
        finally:
            self._process.kill()
            self._reader.join()
            self._tells.close()
            self._said.close()

    def _do(self, name: str, **about: Any) -> Any:
        return self.answer(self._send(name, **about))

    def _send(self, name: str, **about: Any) -> Future[Any]:
        number = len(self._answers)
        self._answers[number] = answer = Future()
        answer.words = f'{name} {about}'
        try:
            self._asks.write(json.dumps({'do': name, 'number': number, **about}) + '\n')
            self._asks.flush()
        except OSError as error:
            raise AssertionError(f'the probe has ended: {self.words()[-2000:]}') from error
        return answer

    def _read(self) -> None:
        for line in self._tells:
            told = json.loads(line, object_hook=lambda pairs: SimpleNamespace(**pairs))
            if hasattr(told, 'number'):
                answer = self._answers[told.number]
                if hasattr(told, 'error'):
                    answer.set_exception(AssertionError(f'{answer.words}: {told.error}'))
                else:
                    answer.set_result(told.result)
            else:
                self._heard[told.heard].append(told.message)
        self._ended = True


def kind_of(topic: str) -> str:
    """The type of a topic of the contract, whatever its namespace."""
    from quad_bridge.topics import TOPIC_TYPES

    known = {**TOPIC_TYPES, '/clock': 'rosgraph_msgs/msg/Clock'}
    return next((kind for name, kind in known.items() if topic.endswith(name)), '')


def event(values: Mapping[str, Any], now_ns: int = 0) -> dict[str, Any]:
    """A ParameterEvent with these values, as `publish` takes it."""
    kinds = {name: KINDS[type(value)] for name, value in values.items()}
    return {
        'changed_parameters': [
            {'name': name, 'value': {'type': kinds[name][0], kinds[name][1]: value}}
            for name, value in values.items()
        ],
        'stamp': stamp(now_ns)['stamp'],
    }


def content(message: Any) -> dict[str, Any]:
    """Names and values of a ParameterEvent that was heard or read in a bag."""
    fields = dict(KINDS.values())
    return {p.name: getattr(p.value, fields[p.value.type]) for p in message.changed_parameters}


def entries(arrays: Sequence[Any]) -> dict[str, SimpleNamespace]:
    """The last diagnostics of each name: level, message, and its values by key."""
    return {
        status.name: SimpleNamespace(
            level=status.level, message=status.message,
            values={pair.key: pair.value for pair in status.values},
        )
        for array in list(arrays)
        for status in array.status
    }  # fmt: skip


def stamp(nanoseconds: int) -> dict[str, Any]:
    sec, nanosec = divmod(nanoseconds, 10**9)
    return {'stamp': {'sec': sec, 'nanosec': nanosec}, 'frame_id': 'base_link'}


def stamp_ns(message: Any) -> int:
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


# ---- the process -----------------------------------------------------------------------------


class Server:
    """Does in ROS's executor what the lines from stdin say."""

    def __init__(self, rclpy: Any) -> None:
        from rclpy.duration import Duration
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

        from quad_bridge.topics import LATCHED

        self._latched, self._profile = LATCHED, QoSProfile
        self._reliability, self._durability = ReliabilityPolicy, DurabilityPolicy
        self._patience = Duration(seconds=PATIENCE_S)
        self.node = rclpy.create_node('probe', start_parameter_services=False)
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self._guard = self.node.create_guard_condition(self._work)
        self._lines: list[str] = []
        self._publishers: dict[str, tuple[Any, type]] = {}
        self._timers: dict[str, Any] = {}
        self._clients: dict[str, Any] = {}
        self._waiting: list[tuple[Any, Any, int]] = []
        self.node.create_timer(0.02, self._turn)
        self.done = False

    def read(self) -> None:
        """Hand every line to the executor; its end is the process'."""
        for line in sys.stdin:
            self._lines.append(line)
            self._guard.trigger()
        self.done = True
        self._guard.trigger()

    def _turn(self) -> None:
        """What a guard condition failed to wake up for, and services that have come meanwhile."""
        self._work()
        self._call()

    def _work(self) -> None:
        while self._lines:
            about = json.loads(self._lines.pop(0))
            number, do = about.pop('number'), about.pop('do')
            try:
                if do == 'ask':
                    self.ask(number, **about)
                else:
                    tell(number=number, result=getattr(self, do)(**about))
            except Exception as error:  # noqa: BLE001  (it is told to the test)
                tell(number=number, error=f'{type(error).__name__}: {error}')

    def _qos(self, topic: str, *, reliable: bool = True) -> Any:
        latched = any(topic.endswith(name) for name in self._latched)
        policy, lasting = self._reliability, self._durability
        return self._profile(
            depth=1000 if reliable or not latched else 10,
            reliability=policy.RELIABLE if reliable else policy.BEST_EFFORT,
            durability=lasting.TRANSIENT_LOCAL if latched else lasting.VOLATILE,
        )

    def listen(self, topic: str, kind: str, reliable: bool) -> None:
        def heard(message: Any) -> None:
            tell(heard=f'topic {topic}', message=plain(message))

        qos = self._qos(topic, reliable=reliable)
        self.node.create_subscription(interface(kind), topic, heard, qos)

    def advertise(self, topic: str, kind: str) -> None:
        if topic not in self._publishers:
            made = interface(kind)
            publisher = self.node.create_publisher(made, topic, self._qos(topic))
            self._publishers[topic] = publisher, made

    def publish(self, topic: str, kind: str, messages: list[Any], every_s: float) -> None:
        self.advertise(topic, kind)
        publisher, made = self._publishers[topic]
        for values in messages:
            def say(values: Mapping[str, Any] = values) -> None:
                self._say(publisher, made, values)

            say()
            if every_s:
                self.silence(topic)
                self._timers[topic] = self.node.create_timer(every_s, say)

    def _say(self, publisher: Any, made: type, values: Mapping[str, Any]) -> None:
        message = filled(made(), values)
        place = getattr(message, 'header', message)
        if hasattr(place, 'stamp') and not (place.stamp.sec or place.stamp.nanosec):
            place.stamp = self.node.get_clock().now().to_msg()
        publisher.publish(message)

    def serve(self, service: str, kind: str, response: Any) -> None:
        def asked(request: Any, answer: Any) -> Any:
            tell(heard=f'service {service}', message=plain(request))
            return filled(answer, response)

        self.node.create_service(interface(kind), service, asked)

    def silence(self, topic: str) -> None:
        if topic in self._timers:
            self.node.destroy_timer(self._timers.pop(topic))

    def delivered(self, topic: str) -> None:
        self._publishers[topic][0].wait_for_all_acked(self._patience)

    def listeners(self, topic: str) -> int:
        if topic in self._publishers:
            return int(self._publishers[topic][0].get_subscription_count())
        return int(self.node.count_subscribers(topic))

    def nodes(self) -> list[str]:
        found = self.node.get_node_names_and_namespaces()
        return [f'{space.rstrip("/")}/{name}' for name, space in found if name != 'probe']

    def opened(self, node: str) -> dict[str, list[str]]:
        own, (space, _, name) = self.node, node.rpartition('/')
        whose = name, space or '/'
        if whose not in own.get_node_names_and_namespaces():  # nobody has heard of it yet
            return {'publishes': [], 'hears': [], 'offers': [], 'calls': []}
        found = {
            'publishes': own.get_publisher_names_and_types_by_node(*whose),
            'hears': own.get_subscriber_names_and_types_by_node(*whose),
            'offers': own.get_service_names_and_types_by_node(*whose),
            'calls': own.get_client_names_and_types_by_node(*whose),
        }
        return {what: [topic for topic, _ in pairs] for what, pairs in found.items()}

    def ask(self, number: int, service: str, kind: str, request: Any) -> None:
        made = interface(kind)
        if service not in self._clients:
            self._clients[service] = self.node.create_client(made, service)
        question = filled(made.Request(), request)
        self._waiting.append((self._clients[service], question, number))
        self._call()

    def _call(self) -> None:
        """Ask those that are there by now."""
        for one in list(self._waiting):
            client, question, number = one
            if client.service_is_ready():
                self._waiting.remove(one)
                client.call_async(question).add_done_callback(
                    lambda future, number=number: tell(number=number,
                                                       result=plain(future.result())))


def interface(kind: str) -> Any:
    """The class of a message or service, from `package/msg/Name`."""
    package, group, name = kind.split('/')
    return getattr(importlib.import_module(f'{package}.{group}'), name)


def plain(value: Any) -> Any:
    if hasattr(value, 'get_fields_and_field_types'):
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, bytes):
        return value[0]
    if hasattr(value, 'tolist'):
        return value.tolist()
    return [plain(item) for item in value] if isinstance(value, list | tuple) else value


def filled(message: Any, values: Mapping[str, Any]) -> Any:
    kinds = message.get_fields_and_field_types()
    for name, value in values.items():
        setattr(message, name, content_of(kinds[name], getattr(message, name), value))
    return message


def content_of(kind: str, old: Any, value: Any) -> Any:
    if isinstance(value, dict):
        return filled(old, value)
    if isinstance(value, list) and '/' in kind:
        package, _, name = kind.removeprefix('sequence<').partition('>')[0].partition('/')
        made = interface(f'{package}/msg/{name}')
        return [filled(made(), item) for item in value]
    if kind == 'octet':
        return bytes([value])
    return float(value) if isinstance(old, float) else value


def tell(**words: Any) -> None:
    sys.stdout.write(json.dumps(words) + '\n')
    sys.stdout.flush()


def main() -> None:
    """Executor, node and context end in this order."""
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    from quad_bridge.start import listen_by_udp

    listen_by_udp()  # a busy machine starves it too
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    server = Server(rclpy)
    reader = threading.Thread(target=server.read)
    reader.start()
    while not server.done:
        server.executor.spin_once(timeout_sec=1.0)
    reader.join()  # its last word goes through the node
    server.executor.shutdown()
    server.node.destroy_node()
    rclpy.shutdown()
