"""The `identification` node: identifies each complete bag, reports, and designs gains.

Wiring only: session.run does the work, in its own thread so that the node keeps responding.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import ParameterDescriptor, ParameterEvent
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from std_srvs.srv import Trigger

from quad_bridge.errors import QuadBridgeError
from quad_bridge.lockstep import clock
from quad_bridge.nodes import ros_node
from quad_bridge.nodes.conversion import event_message, parameters
from quad_bridge.nodes.diagnostics import diagnostic_array
from quad_bridge.nodes.qos import EVENT, STATE
from quad_bridge.status import ERROR, OK, WARN, Status
from quad_sysid import session
from quad_sysid.errors import QuadSysidError
from quad_sysid.result import Result

PARAMETERS = ('out', 'axes', 'auto_update', 'train', 'validate', 'inertia')


class IdentificationNode(Node):  # type: ignore[misc]
    """Topics, services and the worker around session.run."""

    def __init__(self) -> None:
        super().__init__('identification')
        ros_node.refuse_unknown(self, PARAMETERS)
        self._out = ros_node.declared(
            self, 'out', '', 'folder of the report; empty: <bag>_identified beside the bag'
        )
        self._auto_update = ros_node.declared(
            self, 'auto_update', False, 'publish gains that are better and safe'
        )
        self._wanted = _wanted(self)
        self._bag = ''
        self._seen: set[str] = set()
        self._earlier: set[str] = set()  # complete before this node began, and not asked for
        self._queue: deque[str] = deque()
        self._values: dict[str, str] = {'state': 'waiting'}
        self._level = OK
        self._worker: threading.Thread | None = None
        self._outcome: Result | str | None = None
        self._begun_ns = time.time_ns()  # by the middleware's clock, whatever that of the flight
        self._gains = self.create_publisher(ParameterEvent, 'gains/update', EVENT)
        self._diagnostics = self.create_publisher(DiagnosticArray, 'diagnostics', EVENT)
        self.create_subscription(ParameterEvent, 'logger/bag', self._on_bag, STATE)
        self.create_service(Trigger, '~/identify', self._on_identify)
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # simulated time stands still meanwhile
        self.create_timer(0.2, self._collect, clock=steady)
        self.create_timer(1.0, self._report, clock=steady)
        self.get_logger().info('waits for /logger/bag to say complete')

    def _on_bag(self, event: Any, info: Any) -> None:
        said = parameters(event)
        bag = str(said.get('path', '')) if said.get('state') == 'complete' else ''
        if not bag or bag in self._seen:
            return
        self._seen.add(bag)
        earlier = info['source_timestamp'] < self._begun_ns
        if earlier:
            # the logger repeats its last ones to whoever comes late; the newest may be of use
            self._queue = deque(one for one in self._queue if one not in self._earlier)
            self._earlier.add(bag)
        self._queue.append(bag)
        if not earlier:
            self._start_next()

    def _on_identify(self, request: Any, response: Any) -> Any:
        del request
        if self._worker is not None:
            response.success, response.message = False, f'{self._bag} is still being identified'
        elif not self._bag:
            response.success, response.message = False, 'no complete bag on /logger/bag yet'
        else:
            self._earlier.discard(self._bag)
            self._queue.append(self._bag)
            self._start_next()
            response.success, response.message = True, f'identifying {self._bag}'
        return response

    def _start_next(self) -> None:
        if self._worker is not None or not self._queue:
            return
        self._bag = self._queue.popleft()
        self._say(OK, state='identifying', bag=self._bag)
        clock().hold()
        self._worker = threading.Thread(target=self._work, args=(self._bag,), daemon=True)
        self._worker.start()

    def _work(self, bag: str) -> None:
        """Runs outside the executor; leaves its result for `_collect`."""
        from quad_sysid.report.store import free_folder

        default = Path(bag).with_name(f'{Path(bag).stem}_identified')
        folder = free_folder(Path(self._out) if self._out else default)
        try:
            self._outcome = session.run([bag], folder, self._wanted)
        except QuadSysidError as error:
            self._outcome = str(error)
        except Exception as error:  # noqa: BLE001 - a fault here must not take the node down
            self.get_logger().error(f'identification failed: {error!r}')
            self._outcome = f'fault of the program: {error!r}'

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
        self.get_logger().info(f'{bag}: {verdicts}, report in {outcome.folder}')
        update = self._update(outcome, bag)
        self._say(
            OK if outcome.answered else WARN,
            state='done', reason=outcome.reasons or f'done; gains: {update}', bag=bag,
            report=f'{outcome.folder}/report.json', update=update, **verdicts,
        )

    def _update(self, outcome: Result, bag: str) -> str:
        """Publish the gains if auto_update is on; returns what was done, or why not."""
        for axis, reason in outcome.refusals().items():
            self.get_logger().warning(f'{axis}: no gains: {reason}')
        wanted = outcome.gains
        if not wanted:
            return 'none: ' + '; '.join(outcome.refusals().values())
        if not self._auto_update:
            self.get_logger().info(f'gains not sent (auto_update is off): {wanted}')
            return 'not sent: auto_update is off'
        if bag in self._earlier:
            why = 'not sent: the bag was complete before this node began; ask ~/identify for them'
            self.get_logger().warning(f'gains {why}: {wanted}')
            return why
        told: dict[str, float | str] = {
            **wanted, 'source': f'identification of {bag}', 'bag': bag,
            'model': f'{outcome.folder}/model.json', 'predicted': outcome.predictions(),
        }  # fmt: skip
        stamp_ns = self.get_clock().now().nanoseconds
        self._gains.publish(event_message(told, '/identification', stamp_ns))
        self.get_logger().info(f'gains sent: {wanted}')
        return 'sent'

    def _say(self, level: int, **values: str) -> None:
        self._level, self._values = level, values
        self._report()

    def _report(self) -> None:
        text = self._values.get('reason', self._values['state'])
        status = Status('identification', self._level, text, self._values)
        now = self.get_clock().now().to_msg()
        self._diagnostics.publish(diagnostic_array(self.get_name(), '', now, [status]))

    def close(self) -> None:
        """Nothing to close: an identification that still runs ends with the process."""


def _wanted(node: Any) -> dict[str, Any]:
    """Options from the parameters; a wrong one ends the node before any flight."""
    descriptor = ParameterDescriptor(
        description='axes to identify; empty: those that the bag excites', read_only=True
    )
    given = node.declare_parameter('axes', [''], descriptor).value
    texts = {
        'train': ros_node.declared(node, 'train', '', 'A:B, s; empty: as the bag says'),
        'validate': ros_node.declared(node, 'validate', '', 'A:B, s; empty: as the bag says'),
        'inertia': ros_node.declared(node, 'inertia', '', 'IX,IY,IZ, kg m²; adds torques in N m'),
    }
    try:
        return session.asked([name for name in given if name], **texts)
    except QuadSysidError as error:
        words = str(error).replace('--', '')  # options of the command are parameters here
        raise QuadBridgeError(f'parameter {words}') from error


def main() -> None:
    """Spin until interrupted."""
    ros_node.run(IdentificationNode, 'identification')
