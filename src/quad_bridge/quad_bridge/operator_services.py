"""The operator's part of the bridge: topic operator/enable and service ~/arm. Wiring only.

`~/arm` answers with what the STM32 said, without blocking the executor.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.qos import qos_profile_sensor_data
from rclpy.task import Future
from std_msgs.msg import Bool
from std_srvs.srv import SetBool

from quad_bridge.operator_enable import OperatorEnable
from quad_bridge.wire.frames import Command, CommandAck

ARM_DISARM = 400
"""MAV_CMD_COMPONENT_ARM_DISARM."""
ANSWER_S = 1.0
_RESULTS = ('accepted', 'not now', 'denied', 'not supported', 'failed')


class OperatorServices:
    """`send` puts a frame on the wire; `acknowledged` may be called from any thread."""

    def __init__(self, node: Any, enable: OperatorEnable, send: Callable[[Command], None]) -> None:
        self._enable, self._send = enable, send
        self._waiting: Any = None
        self._until_s = 0.0
        node.create_subscription(
            Bool, 'operator/enable', self._on_enable, qos_profile_sensor_data
        )
        node.create_service(SetBool, '~/arm', self._on_arm)

    def acknowledged(self, ack: CommandAck) -> None:
        """The STM32 has answered a command."""
        waiting = self._waiting
        if ack.command == ARM_DISARM and waiting is not None and not waiting.done():
            known = ack.result < len(_RESULTS)
            waiting.set_result(_RESULTS[ack.result] if known else f'result {ack.result}')

    def tick(self) -> None:
        """Give up waiting where no answer has come."""
        waiting = self._waiting
        if waiting is not None and not waiting.done() and time.monotonic() > self._until_s:
            waiting.set_result(f'no answer in {ANSWER_S:g} s')

    def _on_enable(self, message: Bool) -> None:
        self._enable.take(bool(message.data), time.monotonic())

    async def _on_arm(self, request: Any, response: Any) -> Any:
        now_s = time.monotonic()
        fault = self._enable.fault(now_s) if request.data else ''
        if self._waiting is not None and not self._waiting.done():
            fault = 'an earlier request waits for its answer'
        if fault:
            response.success, response.message = False, fault
            return response
        self._until_s, self._waiting = now_s + ANSWER_S, Future()
        self._send(Command(ARM_DISARM, (1.0 if request.data else 0.0,)))
        response.message = f'the STM32: {await self._waiting}'
        response.success = response.message.endswith(_RESULTS[0])
        return response
