"""The bridge's services, and its gains as parameters of the node. Wiring only.

`ros2 param set /serial_bridge roll.rate.kp 0.08` passes the same gate as /gains/update. Services
that wait (pulses, arming) have callback groups of their own: meanwhile the node goes on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor, ParameterEvent, SetParametersResult
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.parameter import Parameter
from rclpy.qos import qos_profile_sensor_data
from rclpy.task import Future
from std_msgs.msg import Bool
from std_srvs.srv import SetBool, Trigger

from quad_bridge.arming import ACCEPTED, Arming, OperatorEnable
from quad_bridge.errors import RefusedError
from quad_bridge.gains.table import ROWS, SETTABLE, WIRE_NAMES
from quad_bridge.lockstep import clock
from quad_bridge.nodes import conversion
from quad_bridge.nodes.managed_node import answered
from quad_bridge.nodes.qos import STATE
from quad_bridge.sensors.live import LiveSensors, Wanted
from quad_bridge.status import WARN, Status
from quad_bridge.wire.frames import Command, CommandAck

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
            row = ROWS[name]
            words = f'{row.meaning}, {row.unit}; NaN until the aircraft has reported it'
            descriptor = ParameterDescriptor(description=words, dynamic_typing=True)
            node.declare_parameter(name, math.nan, descriptor)
        node.add_on_set_parameters_callback(self._on_set)
        group = ReentrantCallbackGroup()
        for name, motors in (('~/check_polarity', False), ('~/find_motors', True)):
            node.create_service(
                Trigger, name, partial(self._on_check, motors), callback_group=group
            )

    def show(self, active: Mapping[str, float]) -> None:
        """Set the parameters to the gains in force."""
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

    async def _on_check(self, motors: bool, _: Any, response: Any) -> Any:
        done = Future()
        try:
            self._check(done.set_result, motors)
        except RefusedError as error:
            return answered(response, False, str(error))
        words = str(await done)
        return answered(response, not words.startswith('stopped'), words)


class OperatorServices:
    """Topic operator/enable and service `~/arm`, which answers with what the aircraft said.

    `send` puts a frame on the wire. `armed` says whether the aircraft is armed, as heard just now;
    None where it is not heard; `name` what messages call it. `acknowledged` may be called from any
    thread.
    """

    def __init__(
        self,
        node: Any,
        enable: OperatorEnable,
        send: Callable[[Command], None],
        armed: Callable[[], bool | None],
        name: Callable[[], str],
    ) -> None:
        self._node, self._enable, self._send, self._armed = node, enable, send, armed
        self._name = name
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
        """Entries for /diagnostics: a warning for as long as its reason lasts."""
        return [Status('operator', WARN, self._late)] if self._late else []

    def end(self) -> None:
        """End requests before the port is closed."""
        self._arming.end('no answer before the node was deactivated')

    def _on_enable(self, message: Bool) -> None:
        self._enable.take(bool(message.data), clock().now_s())

    def _command(self, arm: bool, told: Callable[[str], None]) -> Command:
        now_s = clock().now_s()
        self._node.refuse_unless_active()
        fault = (self._enable.fault(now_s) or self._not_disarmed()) if arm else ''
        if fault:
            raise RefusedError(fault)
        return self._arming.ask(arm, told, now_s)

    def _not_disarmed(self) -> str:
        armed = self._armed()
        if armed is None:
            return 'nothing is received from the aircraft, so it may be armed: check the link'
        return 'it is armed already' if armed else ''

    async def _on_arm(self, request: Any, response: Any) -> Any:
        done = Future()
        try:
            self._send(self._command(bool(request.data), done.set_result))
        except RefusedError as error:
            return answered(response, False, str(error))
        answer = await done
        return answered(response, answer == ACCEPTED, f'{self._name()}: {answer}')


class SensorServices:
    """Service `~/calibrate_at_rest`, recordings; `report` publishes /diagnostics at once."""

    def __init__(self, node: Any, sensors: LiveSensors, report: Callable[[], None]) -> None:
        self._node, self._sensors, self._report = node, sensors, report
        self._since_ns = 0
        node.create_service(Trigger, '~/calibrate_at_rest', self._on_calibrate)
        node.create_subscription(ParameterEvent, 'logger/bag', self._on_bag, STATE)

    def tick(self) -> None:
        """Make the estimate that arming or a recording asks for; report a change at once."""
        wanted, since_ns = self._sensors.wanted(), self._sensors.current.since_ns
        if wanted is not None:
            try:
                self._node.get_logger().info(self._sensors.estimate(wanted))
            except RefusedError as error:
                self._node.get_logger().info(str(error))
        if wanted is not None or since_ns != self._since_ns:
            self._since_ns = since_ns
            self._report()

    def _on_bag(self, event: ParameterEvent) -> None:
        if conversion.parameters(event).get('state') == 'recording':
            self._sensors.want('recording')

    def _on_calibrate(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        wanted = Wanted('asked for', self._sensors.standing())
        if wanted.samples and not self._sensors.settled:
            return answered(response, False, 'the last estimate has not been published yet')
        try:
            return answered(response, True, self._sensors.estimate(wanted))
        except RefusedError as error:
            return answered(response, False, str(error))
