"""The `bag_logger` node: subscribes raw, hands the bytes to a Recording, says where the bag is."""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Collection
from datetime import datetime, timezone
from functools import partial
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import ParameterEvent
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import String
from std_srvs.srv import Trigger

from quad_bridge.errors import BadInputError, QuadBridgeError
from quad_bridge.lockstep import STREAMS, clock
from quad_bridge.log.disk import MB, free_bytes
from quad_bridge.log.recording import Gaps, Recording, RecordingStatus, recording_status
from quad_bridge.log.writer import Limits, free_paths, new_bag
from quad_bridge.nodes import conversion, description, diagnostics, ros_node
from quad_bridge.nodes.managed_node import Aside, ManagedNode, answered, relative, waiting
from quad_bridge.nodes.qos import EVENT, STATE, STREAM, adapted, offered
from quad_bridge.status import WARN, Status
from quad_bridge.topics import TOPIC_TYPES

NUMBERS = {
    'queue_messages': (50_000, 'messages that may wait for the disk', (100, 10_000_000)),
    'queue_mb': (64, 'MB of messages that may wait for the disk', (1, 100_000)),
    'split_mb': (0, 'a new file in the bag after so many MB, 0 for never', (0, 1_000_000)),
    'split_s': (0, 'a new file in the bag after so many seconds, 0 for never', (0, 86_400)),
    'reserve_mb': (200, 'MB of free disk without which no recording starts', (0, 1_000_000)),
}
"""Integer parameters: default, description, range."""
LOOK_S = 0.02  # between two looks for messages; the middleware holds seconds of them
NAMES = ('folder', 'prefix', 'topics', 'autostart', 'managed', description.PARAMETER, *NUMBERS)


class BagLogger(ManagedNode):
    """See the module. Configured it has publishers and services, active it records when asked.

    Topics are looked for in the node's namespace; in the bag they have the contract's names.
    """

    def __init__(self, direct: Collection[str] = (), **options: Any) -> None:
        """`direct`: topics whose messages come by `take`, of a bridge in the same process."""
        super().__init__('bag_logger', **options)
        self._direct = frozenset(direct)
        ros_node.refuse_unknown(self, NAMES)
        self._folder = Path(ros_node.declared(self, 'folder', '.', 'where bags are written'))
        self._prefix = ros_node.declared(self, 'prefix', 'flight', 'how names of bags begin')
        if '/' in self._prefix or self._prefix.startswith('.'):
            raise BadInputError('parameter prefix', 'must be a plain name', self._prefix)
        numbers = {name: ros_node.declared(self, name, *rest) for name, rest in NUMBERS.items()}
        self._capacity = numbers['queue_messages'], numbers['queue_mb'] * MB
        self._limits = Limits(
            numbers['split_mb'] * MB, numbers['split_s'], numbers['reserve_mb'] * MB
        )
        self._topics = ros_node.declared(self, 'topics', list(TOPIC_TYPES), 'topics to record')
        for topic in self._topics:
            if topic not in TOPIC_TYPES:
                raise BadInputError('parameter topics', 'is not a topic of this project', topic)
        self._craft = description.declared_craft(self)
        self._descriptions: dict[bytes, bool] = {}  # descriptions heard, and whether they count
        self._recording: Recording | None = None
        self._subscribed: dict[str, tuple[Any, Any]] = {}
        self._aside = Aside()
        self._gaps: dict[str, Gaps] = {}
        self._numbered: set[str] = set()  # topics whose messages come with a publisher's number
        self._foreign: set[tuple[str, str]] = set()  # topics with a foreign type, reported once
        self._last = ''
        self._failed: RecordingStatus | None = None  # how the last recording ended, if it failed
        self._autostart = ros_node.declared(
            self, 'autostart', False, 'record from the start of the node'
        )
        self._simulated = self.simulated
        self._now_ns: Callable[[], int] = self._ros_now_ns if self._simulated else time.time_ns

    def configure(self) -> None:
        """Create what is published, and the services."""
        self.service(Trigger, '~/start', self._on_start)
        self.service(Trigger, '~/stop', self._on_stop)
        self._bag = self.publisher(ParameterEvent, '/logger/bag', STATE)
        self._diagnostics = self.publisher(DiagnosticArray, '/diagnostics', EVENT)

    def activate(self) -> None:
        """Report, and record where `autostart` says so."""
        self._waits = self._autostart
        self._start_by_itself()
        self.timer(1.0, self._on_report)
        self.timer(LOOK_S, self._look)

    def deactivate(self) -> None:
        """End a running recording and see that `/logger/bag` is delivered."""
        if self._recording is not None:
            self._stop(self._recording)
            self._bag.wait_for_all_acked(Duration(seconds=0.5))

    @property
    def _clock_runs(self) -> bool:
        """False where time is simulated and it is not known yet."""
        return self._ros_now_ns() > 0

    def _start_by_itself(self) -> None:
        """Start where `autostart` asked for it, once the clock runs."""
        if self._waits and self._clock_runs:
            self._waits = False
            self._start()

    def _ros_now_ns(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    def _on_start(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if not self.active:
            return answered(response, False, 'the node is not active')
        if self._recording is not None:
            path = self._recording.status.path
            return answered(response, False, f'already recording {path}')
        try:
            return answered(response, True, str(self._start()))
        except QuadBridgeError as error:
            self.get_logger().error(str(error))
            return answered(response, False, str(error))

    def _on_stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._recording is None:
            return answered(response, False, 'not recording')
        status = self._stop(self._recording)
        return answered(response, not status.failure, status.failure or str(status.path))

    def _start(self) -> Path:
        if not self._clock_runs:
            what = 'is set, and nothing comes on /clock'
            raise BadInputError('use_sim_time', what, remedy='start what publishes it')
        now = datetime.now(tz=timezone.utc)
        try:
            paths = free_paths(self._folder.absolute(), self._prefix, now)
            writer = new_bag(paths, self._limits)
        except OSError as error:
            where = str(error.filename or self._folder)
            raise BadInputError(where, f'cannot be used ({error.strerror})') from error
        path = writer.path
        self._recording, self._failed = Recording(writer, *self._capacity), None
        if self._craft is not None:
            self._recording.declare(description.TOPIC, TOPIC_TYPES[description.TOPIC], ())
            data = serialize_message(String(data=self._craft.to_urdf()))
            self._recording.put(description.TOPIC, self._now_ns(), data)
        for topic in self._topics:
            if topic not in self._direct:
                self._subscribe(topic)
        self._announce(path, 'recording')
        return path

    def _stop(self, recording: Recording) -> RecordingStatus:
        for topic, (subscription, _) in self._subscribed.items():
            self._take(topic, subscription)
            self.destroy_subscription(subscription)
        self._recording = None
        self._subscribed.clear()
        self._gaps.clear()
        self._numbered.clear()
        status = recording.stop()
        self._failed = status if status.failure else None
        self._announce(status.path, 'failed' if status.failure else 'complete', status.failure)
        return status

    def _subscribe(self, topic: str) -> None:
        """Subscribe as the topic's publishers offer; again where that has changed."""
        qos = adapted(topic, self._offers(topic))
        if topic in self._subscribed:
            subscription, previous = self._subscribed[topic]
            if previous == qos:
                return
            self._take(topic, subscription)
            self.destroy_subscription(subscription)
        package, _, kind = TOPIC_TYPES[topic].split('/')
        lost = SubscriptionEventCallbacks(message_lost=partial(self._lose, topic))
        is_waited_for = clock().simulated and topic in STREAMS
        subscription = self.create_subscription(
            getattr(importlib.import_module(f'{package}.msg'), kind), relative(topic),
            partial(self._receive, topic), qos, raw=True, event_callbacks=lost,
            callback_group=None if is_waited_for else self._aside,
        )  # fmt: skip
        ros_node.poll_rarely(subscription)
        self._subscribed[topic] = subscription, qos

    def _offers(self, topic: str) -> list[Any]:
        return list(self.get_publishers_info_by_topic(relative(topic)))

    def _tell_foreign(self, topic: str) -> None:
        """Warn once of publishers whose messages are not recorded, for their type."""
        for offer in self._offers(topic):
            offered = (topic, offer.topic_type)
            if offer.topic_type != TOPIC_TYPES[topic] and offered not in self._foreign:
                self._foreign.add(offered)
                self.get_logger().warning(
                    f'{topic}: a publisher has type {offer.topic_type}, which is not recorded; '
                    f'this project has {TOPIC_TYPES[topic]}'
                )

    def _look(self) -> None:
        """Record what has come since the last look; what wakes the executor is taken there."""
        for topic, (subscription, _) in self._subscribed.items():
            if subscription.callback_group is self._aside:
                self._take(topic, subscription)

    def _take(self, topic: str, subscription: Any) -> None:
        for data, info in waiting(subscription, STREAM.depth):
            self._receive(topic, data, info)

    def _receive(self, topic: str, data: bytes, info: dict[str, Any]) -> None:
        recording = self._recording
        if recording is not None and len(data) > description.MAX_BYTES:
            self.refused_large += 1
            recording.count_large()
            self.get_logger().warning(
                f'{topic}: a message of {len(data)} bytes is not recorded, at most '
                f'{description.MAX_BYTES} are', throttle_duration_sec=5.0,
            )  # fmt: skip
            return
        if recording is None or (topic == description.TOPIC and not self._describes(data)):
            return
        number = info.get('publication_sequence_number')
        if number is not None:
            self._numbered.add(topic)
            gaps = self._gaps.setdefault(topic, Gaps())
            lost = gaps.lost_before(number, lambda: len(self._offers(topic)))
            recording.count_lost(lost)
        arrival_ns = 0 if self._simulated else info.get('received_timestamp')
        self._put(recording, topic, data, arrival_ns or self._now_ns())

    def take(self, topic: str, data: bytes) -> None:
        """Record a message that is published in this process; in any thread."""
        recording = self._recording
        if recording is not None and topic in self._topics:
            self._put(recording, topic, data, self._now_ns())

    def _put(self, recording: Recording, topic: str, data: bytes, time_ns: int) -> None:
        if not recording.known(topic):
            recording.declare(topic, TOPIC_TYPES[topic], offered(self._offers(topic)))
        recording.put(topic, time_ns, data)

    def _describes(self, data: bytes) -> bool:
        """Whether a description counts; where it does not, that is said once."""
        if data not in self._descriptions:
            if len(self._descriptions) >= description.MAX_TEXTS:  # a flood
                return False
            text, own = deserialize_message(data, String).data, self._craft
            if own is None:
                words = description.why_ignored(text)
            elif text == own.to_urdf():  # of a bridge that was given the same
                words = ''
            else:
                words = 'the parameter robot_description holds: that of another node is left aside'
            self._descriptions[data] = own is None and not words
            if words:
                self.get_logger().warning(words)
        return self._descriptions[data]

    def _lose(self, topic: str, event: Any) -> None:
        """Count what the middleware reports, where messages are not numbered."""
        if self._recording is not None and topic not in self._numbered:
            self._recording.count_lost(event.total_count_change)

    def _announce(self, path: Path, state: str, reason: str = '') -> None:
        values = {'path': str(path), 'state': state, **({'reason': reason} if reason else {})}
        now_ns = self.get_clock().now().nanoseconds
        self._bag.publish(
            conversion.event_message(values, self.get_fully_qualified_name(), now_ns)
        )
        self._last = reason or f'{state}: {path}'
        if reason:  # rclpy wants one severity for each line of code
            self.get_logger().error(self._last)
        else:
            self.get_logger().info(self._last)

    def _on_report(self) -> None:
        try:
            self._start_by_itself()
        except QuadBridgeError as error:
            self.get_logger().error(str(error))
        status = self._failed
        if self._recording is not None:
            status = self._recording.status
            if status.failure:
                self._stop(self._recording)
            for topic in list(self._subscribed):
                self._subscribe(topic)
                self._tell_foreign(topic)
        entries = [recording_status(status, self._last, self._free())]
        if not self._clock_runs:
            text = 'time is simulated, and nothing comes on /clock: nothing is recorded'
            entries.append(Status('clock', WARN, text))
        entries += [*self.bounds(), *self.fence.entries()]
        self._diagnostics.publish(diagnostics.diagnostic_array(self, str(self._folder), entries))

    def _free(self) -> int | None:
        """Bytes; None where the folder is gone."""
        try:
            return free_bytes(self._folder)
        except OSError:
            return None


def main() -> None:
    """Run the node until it is interrupted; exit status 2 where its parameters are wrong."""
    ros_node.run(BagLogger, 'bag_logger')
