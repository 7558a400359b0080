"""The bridge's gains as parameters of its node, and its services. Wiring only.

`ros2 param set /serial_bridge roll.rate.kp 0.08` passes the same gate as /gains/update. The
services wait for their pulses without blocking the executor.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.parameter import Parameter
from rclpy.task import Future
from std_srvs.srv import Trigger

from quad_bridge.errors import RefusedError
from quad_bridge.gains.table import ROWS, SETTABLE, WIRE_NAMES

SOURCE = 'ros2 param set'


class GainServices:
    """Declares the parameters of `node` and offers `~/check_polarity` and `~/find_motors`.

    `ask` takes an update, `check` starts pulses and calls back; both raise RefusedError.
    """

    def __init__(
        self,
        node: Any,
        ask: Callable[[Mapping[str, object]], None],
        check: Callable[[Callable[[str], None], bool], None],
    ) -> None:
        self._node, self._ask, self._check = node, ask, check
        self._showing = False
        for name in SETTABLE:
            words = f'{ROWS[name].meaning}, {ROWS[name].unit}; NaN until the STM32 has reported it'
            descriptor = ParameterDescriptor(description=words, dynamic_typing=True)
            node.declare_parameter(name, math.nan, descriptor)
        node.add_on_set_parameters_callback(self._on_set)
        group = ReentrantCallbackGroup()  # of their own: while they wait the node goes on
        for name, answer in (
            ('~/check_polarity', self._on_polarity),
            ('~/find_motors', self._on_motors),
        ):
            node.create_service(Trigger, name, answer, callback_group=group)

    def show(self, active: Mapping[str, float]) -> None:
        """Let the parameters say what is in force."""
        self._showing = True
        try:
            self._node.set_parameters(
                [Parameter(n, value=v) for n, v in active.items() if n in SETTABLE]
            )
        finally:
            self._showing = False

    def _on_set(self, given: Sequence[Any]) -> Any:
        wanted = {p.name: p.value for p in given if p.name in WIRE_NAMES}
        if self._showing or not wanted:
            return SetParametersResult(successful=True)
        try:
            self._ask({**wanted, 'source': SOURCE})
        except RefusedError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    async def _on_polarity(self, request: Any, response: Any) -> Any:
        del request
        return await self._answer(response, False)

    async def _on_motors(self, request: Any, response: Any) -> Any:
        del request
        return await self._answer(response, True)

    async def _answer(self, response: Any, motors: bool) -> Any:
        done = Future()
        try:
            self._check(done.set_result, motors)
            response.message = str(await done)
            response.success = not response.message.startswith('stopped')
        except RefusedError as error:
            response.success, response.message = False, str(error)
        return response
