"""The `identification` node: identifies each complete bag, reports, and designs gains.

Wiring only: session.run does the work, in its own thread so that the node keeps responding. Only
bags below `folder` are read, and gains are sent only for one that the logger has begun and
completed since this node began: anybody can say something on /logger/bag.
"""

from __future__ import annotations

import json
import threading
import time
from collections import deque
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import ParameterDescriptor, ParameterEvent
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from std_srvs.srv import Trigger

from quad_bridge.errors import QuadBridgeError
from quad_bridge.lockstep import clock
from quad_bridge.nodes import ros_node
from quad_bridge.nodes.conversion import event_message, values_of
from quad_bridge.nodes.diagnostics import diagnostic_array
from quad_bridge.nodes.managed_node import MAX_BYTES, answered
from quad_bridge.nodes.qos import EVENT, HEARD
from quad_bridge.status import ERROR, OK, WARN, Status
from quad_bridge.topics import AIRCRAFT_LOG
from quad_sysid import session
from quad_sysid.errors import QuadSysidError
from quad_sysid.files import free_folder
from quad_sysid.result import Result

PARAMETERS = ('out', 'axes', 'auto_update', 'train', 'validate', 'inertia', 'folder', 'bag')
LOGGER, BRIDGE = 'bag_logger', 'serial_bridge'
MAX_BAGS = 100
"""That wait, or are remembered: more than that is a flood."""


LOG_COMES = "the autopilot's own log comes after the landing; ~/identify does not wait for it"
EARLIER = 'the bag was complete before this node began'


class IdentificationNode(Node):  # type: ignore[misc]
    """Topics, services and the worker around session.run."""

    def __init__(self) -> None:
        super().__init__('identification')
        ros_node.refuse_unknown(self, PARAMETERS)
        self._out = ros_node.declared(
            self, 'out', '', 'folder of the report; empty: <bag>_identified beside the bag'
        )
        self._auto_update = ros_node.declared(
            self, 'auto_update', False, 'send gains that are better and safe to the bridge'
        )
        folder = ros_node.declared(
            self, 'folder', '.', "the logger's: bags that do not lie below it are not read"
        )
        self._folder = Path(folder).expanduser().resolve()
        words = 'what ~/identify reads, below the folder; empty: the newest bag there'
        self.declare_parameter('bag', '', ParameterDescriptor(description=words))
        self._options = _options(self)
        self._bag = ''
        self._recordings: deque[str] = deque(maxlen=MAX_BAGS)
        """Recordings that the logger began since this node did, the latest."""
        self._unsure: dict[str, str] = {}  # the latest, while its publisher has no name yet
        self._known_bags: dict[str, str] = {}  # bags, and why their gains are not sent
        self._queue: deque[str] = deque()
        self._log: dict[str, Any] = {}  # what the bridge says of an autopilot's own log
        self._values: dict[str, str] = {'state': 'waiting'}
        self._level = OK
        self._progress = ''  # the worker's last line; the executor shows it
        self._worker: threading.Thread | None = None
        self._outcome: Result | str | None = None
        self._start_ns = time.time_ns()  # by the middleware's clock, whatever that of the flight
        self._gains = self.create_client(SetParametersAtomically, f'{BRIDGE}/set_gains')
        self._diagnostics = self.create_publisher(DiagnosticArray, 'diagnostics', EVENT)
        self.create_subscription(ParameterEvent, 'logger/bag', self._on_bag, HEARD, raw=True)
        name = AIRCRAFT_LOG.removeprefix('/')
        self.create_subscription(ParameterEvent, name, self._on_log, HEARD)
        self.create_service(Trigger, '~/identify', self._on_identify)
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # simulated time stands still meanwhile
        self.create_timer(0.2, self._collect, clock=steady)
        self.create_timer(1.0, self._report, clock=steady)
        self.get_logger().info('waits for /logger/bag to say complete')

    def _on_bag(self, data: bytes, info: Any) -> None:
        if len(data) > MAX_BYTES:
            return
        event = deserialize_message(data, ParameterEvent)
        values = values_of(event.changed_parameters)
        bag, state = str(values.get('path', '')), values.get('state')
        earlier, stranger = info['source_timestamp'] < self._start_ns, self._stranger(event.node)
        if state == 'recording' and not earlier:
            if not stranger:
                self._recordings.append(bag)
            elif all('UNKNOWN' in one for one in self._publishers_of('/logger/bag')):
                self._unsure = {bag: event.node}
        if state != 'complete' or bag in self._known_bags:
            return
        if not self._ours(Path(bag)):
            why = f'{bag}: not read: it does not lie below the parameter folder ({self._folder})'
            self.get_logger().warning(why, throttle_duration_sec=1.0)
            self._say(WARN, state='waiting', reason=why)
            return
        if earlier:
            # the logger repeats its last ones to whoever comes late; the newest may be of use
            before = {bag for bag, why in self._known_bags.items() if why == EARLIER}
            self._queue = deque(bag for bag in self._queue if bag not in before)
        unseen = '' if bag in self._recordings else \
            'its recording has not begun since this node did'
        self._queue_up(bag, EARLIER if earlier else stranger or unseen)
        if not earlier:
            self._start_next()

    def _queue_up(self, bag: str, why: str) -> None:
        """Let a bag wait for its identification; `why` its gains are not sent."""
        if len(self._queue) >= MAX_BAGS:
            self.get_logger().warning(f'{bag}: not read: {MAX_BAGS} bags wait already')
            return
        self._known_bags[bag] = why
        self._queue.append(bag)
        done = [one for one in self._known_bags if one not in {*self._queue, self._bag}]
        for one in done[: max(0, len(done) - MAX_BAGS)]:  # whose gains were sent long ago
            del self._known_bags[one]

    def _on_log(self, event: Any) -> None:
        """Take how far the bridge is with an autopilot's log; a stranger's word counts nothing."""
        if not self._stranger(event.node, AIRCRAFT_LOG, BRIDGE):
            self._log = values_of(event.changed_parameters)

    def _stranger(self, node: str, topic: str = '/logger/bag', by: str = LOGGER) -> str:
        """Why what was said on a topic may not be that node's; empty if it is."""
        bridge = f'{self.get_namespace().rstrip("/")}/{by}'
        sources = self._publishers_of(topic)
        if node == bridge and sources == [bridge]:
            return ''
        publishers = ', '.join(sorted({node, *sources} - {bridge})) or 'another of that name'
        return f'{bridge} is not the only publisher of {topic}: {publishers}'

    def _publishers_of(self, topic: str) -> list[str]:
        """The nodes that publish a topic; the middleware may not know a name yet."""
        name = self.resolve_topic_name(topic.removeprefix('/'))
        return [
            f'{publisher.node_namespace.rstrip("/")}/{publisher.node_name}'
            for publisher in self.get_publishers_info_by_topic(name)
        ]

    def _ours(self, bag: Path) -> bool:
        try:
            return bag.resolve().is_relative_to(self._folder)
        except (OSError, RuntimeError, ValueError):
            return False

    def _on_identify(self, request: Any, response: Any) -> Any:
        """Identify a bag below the folder; its gains are not sent, whoever asks."""
        del request
        if self._worker is not None:
            return answered(response, False, f'{self._bag} is still being identified')
        name = str(self.get_parameter('bag').value)
        bag = self._folder / name if name else self._newest()
        if bag is None or not self._ours(bag):
            where = name or 'no bag'
            return answered(response, False, f'{where} below {self._folder}: see parameter bag')
        self._known_bags[str(bag)] = 'it was asked for by ~/identify'
        self._queue.appendleft(str(bag))
        self._start_next(at_once=True)
        return answered(response, True, f'identifying {bag}')

    def _newest(self) -> Path | None:
        bags = [path.parent for path in self._folder.glob('**/metadata.yaml')]
        return max(bags, key=lambda path: path.stat().st_mtime, default=None)

    def _start_next(self, *, at_once: bool = False) -> None:
        if self._worker is not None or not self._queue:
            return
        if self._log.get('state') in {'expected', 'fetching'} and not at_once:
            if self._values.get('reason') != LOG_COMES:
                self._say(OK, state='waiting', reason=LOG_COMES)
            return
        self._bag = self._queue.popleft()
        self._progress = ''
        self._say(OK, state='identifying', bag=self._bag)
        self.get_logger().info(f'identifying {self._bag}; /diagnostics shows how far it is')
        clock().hold()
        self._worker = threading.Thread(target=self._work, args=(self._bag,), daemon=True)
        self._worker.start()

    def _work(self, bag: str) -> None:
        """Runs outside the executor; leaves its result for `_collect`."""
        try:
            default = Path(bag).with_name(f'{Path(bag).stem}_identified')
            folder = free_folder(Path(self._out) if self._out else default)
            self._outcome = session.run([self._better(bag)], folder, self._options, self._on_line)
        except QuadSysidError as error:
            self._outcome = str(error)
        except Exception as error:  # noqa: BLE001 - a fault here must not take the node down
            self.get_logger().error(f'identification failed: {error!r}')
            self._outcome = f'fault of the program: {error!r}'

    def _on_line(self, line: str) -> None:
        self._progress = line

    def _better(self, bag: str) -> str:
        """The bag, or one of the autopilot's own log of the same flight, which is faster."""
        values = self._log
        path, offset_s = str(values.get('path', '')), values.get('offset_s')
        if values.get('state') != 'complete' or not isinstance(offset_s, float):
            return bag
        from quad_sysid.imports.log_of_flight import joined

        out = free_folder(Path(bag).with_name(f'{Path(bag).stem}_log'))
        try:
            merged = str(joined(Path(bag), Path(path), offset_s, out))
        except QuadSysidError as error:
            self.get_logger().warning(f'the bag alone is used: {error}')
            return bag
        self.get_logger().info(f"{merged}: the bag with the autopilot's own log in it")
        return merged

    def _collect(self) -> None:
        if self._outcome is None:
            self._start_next()
            return
        outcome, bag = self._outcome, self._bag
        self._outcome, self._worker = None, None
        if isinstance(outcome, str):
            self.get_logger().error(outcome)
            self._say(ERROR, state='failed', reason=outcome, bag=bag)
        else:
            self._tell(outcome, bag)
        clock().release()
        self._start_next()

    def _tell(self, outcome: Result, bag: str) -> None:
        """Publish the result, and what was done with the gains."""
        verdicts = {axis: answer.verdict for axis, answer in outcome.answers.items()}
        shown = ', '.join(f'{axis} {verdict}' for axis, verdict in verdicts.items())
        self.get_logger().info(f'{bag}: {shown}; report in {outcome.folder}')
        update = self._update(outcome, bag)
        self._say(
            OK if outcome.answered else WARN,
            state='done', reason=outcome.reasons or f'done; gains: {update}', bag=bag,
            report=f'{outcome.folder}/report.json', update=update,
            gains=json.dumps(outcome.gains or {}), **verdicts,
        )

    def _update(self, outcome: Result, bag: str) -> str:
        """Send the gains if auto_update is on; returns what was done, or why not."""
        for axis, reason in outcome.refusals().items():
            self.get_logger().warning(f'{axis}: no gains: {reason}')
        gains = outcome.gains
        if not gains:
            return 'none: ' + '; '.join(outcome.refusals().values())
        shown = ', '.join(f'{name} {value:.4g}' for name, value in gains.items())
        sends = f'quad-tune send {outcome.folder}/report.json sends them: {shown}'
        if not self._auto_update:
            self.get_logger().info(f'gains not sent: auto_update is off; {sends}')
            return 'not sent: auto_update is off'
        why = self._known_bags.get(bag, '')
        if not why and not self._gains.service_is_ready():
            why = f'no bridge offers {self._gains.srv_name}'
        if why:
            self.get_logger().warning(f'gains not sent: {why}; {sends}')
            return f'not sent: {why}'
        values: dict[str, float | str] = {
            **gains, 'source': f'identification of {bag}', 'bag': bag,
            'model': f'{outcome.folder}/model.json', **outcome.sent_with(),
        }  # fmt: skip
        event = event_message(values, '/identification', 0)
        request = SetParametersAtomically.Request(parameters=event.changed_parameters)
        self._gains.call_async(request).add_done_callback(self._on_answer)
        self.get_logger().info(f'gains sent: {shown}')
        return 'sent'

    def _on_answer(self, future: Any) -> None:
        """Show what the bridge has answered beside the answers."""
        answer = future.result().result
        words = answer.reason or 'in force, on trial'
        words = words if answer.successful else f'refused: {words}'
        text, log = f'gains: {words}', self.get_logger()
        if answer.successful:  # rclpy wants one severity for each line of code
            log.info(text)
        else:
            log.error(text)
        if self._values.get('update') == 'sent':
            level = self._level if answer.successful else WARN
            self._say(level, **{**self._values, 'update': f'sent: {words}',
                                'reason': f'done; gains: {words}'})  # fmt: skip

    def _say(self, level: int, **values: str) -> None:
        self._level, self._values = level, values
        self._report()

    def _report(self) -> None:
        publishers = self._publishers_of('/logger/bag') if self._unsure else []
        if any('UNKNOWN' not in one for one in publishers):
            self._recordings.extend(bag for bag, node in self._unsure.items()
                                    if not self._stranger(node))
            self._unsure = {}
        text, values = self._values.get('reason', self._values['state']), self._values
        if values['state'] == 'identifying' and self._progress:
            text, values = f'{text}: {self._progress}', {**values, 'progress': self._progress}
        status = Status('identification', self._level, text, values)
        self._diagnostics.publish(diagnostic_array(self, '', [status]))

    def close(self) -> None:
        """Do nothing: an identification that still runs ends with the process."""


def _options(node: Any) -> dict[str, Any]:
    """Options from the parameters; a wrong one ends the node before any flight."""
    descriptor = ParameterDescriptor(
        description='axes to identify; empty: those that the bag excites', read_only=True
    )
    axes = node.declare_parameter('axes', [''], descriptor).value
    texts = {
        'train': ros_node.declared(node, 'train', '', 'A:B, s; empty: as the bag says'),
        'validate': ros_node.declared(node, 'validate', '', 'A:B, s; empty: as the bag says'),
        'inertia': ros_node.declared(node, 'inertia', '', 'IX,IY,IZ, kg m²; adds torques in N m'),
    }
    try:
        return session.keywords([name for name in axes if name], **texts)
    except QuadSysidError as error:
        words = str(error).replace('--', '')  # options of the command are parameters here
        raise QuadBridgeError(f'parameter {words}') from error


def main() -> None:
    """Spin until interrupted."""
    ros_node.run(IdentificationNode, 'identification')
