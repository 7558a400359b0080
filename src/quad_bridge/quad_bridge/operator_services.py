"""The operator's part of the bridge: topic operator/enable and service ~/arm. Wiring only.

`~/arm` answers with what the STM32 said. Its callback group is its own: while it waits, the rest
of the node goes on.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.qos import qos_profile_sensor_data
from rclpy.task import Future
from std_msgs.msg import Bool
from std_srvs.srv import SetBool

from quad_bridge.arming import ACCEPTED, Arming
from quad_bridge.errors import RefusedError
from quad_bridge.lockstep import clock
from quad_bridge.operator_enable import OperatorEnable
from quad_bridge.status import WARN, Status
from quad_bridge.wire.frames import Command, CommandAck


class OperatorServices:
    """`send` puts a frame on the wire; `acknowledged` may be called from any thread.

    `armed` says whether the aircraft is, as heard just now; None where it is not heard.
    """

    def __init__(
        self,
        node: Any,
        enable: OperatorEnable,
        send: Callable[[Command], None],
        armed: Callable[[], bool | None],
    ) -> None:
        self._node, self._enable, self._send, self._armed = node, enable, send, armed
        self._arming = Arming()
        self._late = ''
        node.create_subscription(Bool, 'operator/enable', self._on_enable, qos_profile_sensor_data)
        group = ReentrantCallbackGroup()
        node.create_service(SetBool, '~/arm', self._on_arm, callback_group=group)

    def acknowledged(self, ack: CommandAck) -> None:
        """The STM32 has answered a command."""
        self._arming.acknowledged(ack, clock().now_s())

    def tick(self) -> None:
        """Send again, or give up waiting, where no answer has come."""
        now_s, armed = clock().now_s(), self._armed()
        command = self._arming.tick(now_s, armed=bool(armed))
        if command is not None:
            self._send(command)
        late = self._arming.late(now_s, armed=bool(armed))
        if late:
            self._node.get_logger().error(late)
        self._late = late or self._late if armed else ''

    def entries(self) -> list[Status]:
        """What stands in /diagnostics for as long as it holds."""
        return [Status('operator', WARN, self._late)] if self._late else []

    def end(self) -> None:
        """The port is about to be shut."""
        self._arming.end('no answer before the node was deactivated')

    def _on_enable(self, message: Bool) -> None:
        self._enable.take(bool(message.data), clock().now_s())

    def _command(self, arm: bool, told: Callable[[str], None]) -> Command:
        now_s = clock().now_s()
        if not self._node.active:
            raise RefusedError('the node is not active')
        fault = (self._enable.fault(now_s) or self._not_disarmed()) if arm else ''
        if fault:
            raise RefusedError(fault)
        return self._arming.ask(arm, told, now_s)

    def _not_disarmed(self) -> str:
        armed = self._armed()
        if armed is None:
            return 'the aircraft is not heard: nothing says that it is disarmed'
        return 'it is armed already' if armed else ''

    async def _on_arm(self, request: Any, response: Any) -> Any:
        done = Future()
        try:
            self._send(self._command(bool(request.data), done.set_result))
        except RefusedError as error:
            response.success, response.message = False, str(error)
            return response
        answer = await done
        response.success, response.message = answer == ACCEPTED, f'the STM32: {answer}'
        return response
