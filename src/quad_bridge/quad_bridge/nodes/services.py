"""The bridge's services. Wiring only.

Services that wait (for gains that are read back, pulses, arming) have callback groups of their
own: meanwhile the node goes on.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from rcl_interfaces.msg import ParameterEvent, SetParametersResult
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.qos import qos_profile_sensor_data
from rclpy.task import Future
from std_msgs.msg import Header
from std_srvs.srv import SetBool, Trigger

from quad_bridge.aircraft import ACCEPTED, Ability, Aircraft
from quad_bridge.arming import Arming, OperatorEnable, SecondCall
from quad_bridge.errors import RefusedError
from quad_bridge.gains.update import Reply
from quad_bridge.lockstep import clock
from quad_bridge.motor_test import MotorTest
from quad_bridge.nodes import conversion
from quad_bridge.nodes.managed_node import answered
from quad_bridge.nodes.qos import HEARD
from quad_bridge.sensors.live import EstimateRequest, LiveSensors
from quad_bridge.status import OK, WARN, Status
from quad_bridge.wire.frames import CommandAck, Frame

SOURCE = '~/set_gains'
MAX_PARAMETERS = 500
"""Most parameters in one call, a few times the number that exists."""
GAINS_S = 120.0  # the longest an update may take: a check of the polarity, and sixteen steps


class GainServices:
    """Offers `~/set_gains`, `~/check_polarity` and `~/find_motors`.

    `ask` takes an update, `check` starts pulses; both raise RefusedError, and call back.
    """

    def __init__(
        self,
        node: Any,
        ask: Callable[[Mapping[str, object], Reply], None],
        check: Callable[[Callable[[str], None], bool], None],
    ) -> None:
        self._node, self._ask, self._check = node, ask, check
        self._waiting: list[tuple[float, Any]] = []

    def configure(self) -> None:
        """Create the services."""
        group = ReentrantCallbackGroup()
        self._node.service(SetParametersAtomically, '~/set_gains', self._on_set, group)
        for name, motors in (('~/check_polarity', False), ('~/find_motors', True)):
            self._node.service(Trigger, name, partial(self._on_check, motors), group)

    def tick(self) -> None:
        """Answer those who have waited too long."""
        now_s = clock().now_s()
        late = [done for until_s, done in self._waiting if now_s > until_s]
        self._waiting = [call for call in self._waiting if now_s <= call[0] and not call[1].done()]
        for done in late:
            _settle(done, (False, f'not read back in {GAINS_S:g} s: /diagnostics says why'))

    async def _on_set(self, request: Any, response: Any) -> Any:
        """Answer once the aircraft has read the set back, or with the reason why it has not."""
        def begin(done: Any) -> None:
            count = len(request.parameters)
            if count > MAX_PARAMETERS:
                raise RefusedError(f'at most {MAX_PARAMETERS} parameters: found {count}')
            values = {'source': SOURCE, **conversion.values_of(request.parameters)}
            self._waiting.append((clock().now_s() + GAINS_S, done))
            self._ask(values, lambda ok, why: _settle(done, (ok, why)))

        return await _with_outcome(response, begin)

    async def _on_check(self, motors: bool, _: Any, response: Any) -> Any:
        done = Future()
        try:
            self._check(done.set_result, motors)
        except RefusedError as error:
            return answered(response, False, str(error))
        words = str(await done)
        return answered(response, not words.startswith('stopped'), words)


class OperatorServices:
    """Topic operator/enable, services `~/arm` and `~/motor_test`, which answer with what became.

    `send` puts a frame on the wire. `armed` says whether the aircraft is armed, as heard just now;
    None where it is not heard; `flies` whether it may be in the air; `name` what messages call it.
    `acknowledged` may be called from any thread.
    """

    def __init__(
        self,
        node: Any,
        enable: OperatorEnable,
        aircraft: Callable[[], Aircraft],
        send: Callable[[Frame], None],
        armed: Callable[[], bool | None],
        flies: Callable[[], bool],
        name: Callable[[], str],
    ) -> None:
        self._node, self._enable, self._send, self._armed = node, enable, send, armed
        self._name, self._flies = name, flies
        self._second = SecondCall()
        self._arming, self._test = Arming(), MotorTest(enable)
        self._aircraft = aircraft
        self._late = ''

    def configure(self) -> None:
        """Create the services."""
        group = ReentrantCallbackGroup()
        self._node.service(SetBool, '~/arm', self._on_arm, group)
        self._node.service(SetParametersAtomically, '~/motor_test', self._on_test, group)

    def activate(self) -> None:
        """Listen to the operator."""
        self._node.subscribe(
            Header, '/operator/enable', self._on_enable, qos_profile_sensor_data
        )

    def acknowledged(self, ack: CommandAck) -> None:
        """The STM32 has answered a command."""
        self._arming.acknowledged(ack, clock().now_s())
        self._test.acknowledged(ack)

    def tick(self) -> None:
        """Send again, or give up waiting, where no answer has come."""
        now_s, armed = clock().now_s(), self._armed()
        command = self._arming.tick(now_s, armed=bool(armed))
        for frame in (command, self._test.tick(now_s)):
            if frame is not None:
                self._send(frame)
        late = self._arming.late(now_s, armed=bool(armed))
        if late:
            self._node.get_logger().error(late)
        self._late = late or self._late if armed else ''

    def entries(self) -> list[Status]:
        """Entries for /diagnostics: a warning for as long as its reason lasts."""
        refused = self._enable.refused
        if not (self._late or refused):
            return []
        words = self._late or self._enable.reason or 'holds the enable'
        level = WARN if self._late or self._enable.reason else OK
        return [Status('operator', level, words, {'enables refused for their stamp': refused})]

    def end(self) -> None:
        """End requests before the port is closed."""
        self._arming.end('no answer before the node was deactivated')
        stop = self._test.end('the node was deactivated')
        if stop is not None:
            self._send(stop)

    def _on_enable(self, message: Header) -> None:
        now_ns = self._node.get_clock().now().nanoseconds
        self._enable.take(conversion.age_s(message.stamp, now_ns), clock().now_s())

    def _command(self, arm: bool, reply: Callable[[str], None]) -> Frame:
        now_s = clock().now_s()
        self._node.refuse_unless_active()
        if arm:
            fault = self._enable.fault(now_s) or self._not_disarmed()
        else:
            fault = self._second.fault(now_s, flies=self._flies())
        if fault:
            raise RefusedError(fault)
        return self._arming.ask(arm, reply, now_s)

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

    async def _on_test(self, request: Any, response: Any) -> Any:
        """Answer once the motor has spun, or with the reason why it does not."""
        def begin(done: Any) -> None:
            self._node.refuse_unless_active()
            words = self._aircraft().cannot(Ability.MOTORS)
            if words:
                raise RefusedError(words)
            self._send(self._test.ask(
                conversion.values_of(request.parameters),
                lambda ok, why: _settle(done, (ok, why)), clock().now_s(), armed=self._armed(),
            ))  # fmt: skip

        return await _with_outcome(response, begin)


class SensorServices:
    """Service `~/calibrate_at_rest`, recordings; `report` publishes /diagnostics at once."""

    def __init__(self, node: Any, sensors: LiveSensors, report: Callable[[], None]) -> None:
        self._node, self._sensors, self._report = node, sensors, report
        self._since_ns = 0

    def configure(self) -> None:
        """Create the service."""
        self._node.service(Trigger, '~/calibrate_at_rest', self._on_calibrate)

    def activate(self) -> None:
        """Listen for recordings that begin."""
        self._node.subscribe(ParameterEvent, '/logger/bag', self._on_bag, HEARD)

    def tick(self) -> None:
        """Make the estimate that arming or a recording asks for; report a change at once."""
        request, since_ns = self._sensors.request(), self._sensors.current.since_ns
        if request is not None:
            try:
                self._node.get_logger().info(self._sensors.estimate(request))
            except RefusedError as error:
                self._node.get_logger().info(str(error))
        if request is not None or since_ns != self._since_ns:
            self._since_ns = since_ns
            self._report()

    def _on_bag(self, event: ParameterEvent) -> None:
        if conversion.values_of(event.changed_parameters).get('state') == 'recording':
            self._sensors.want('recording')

    def _on_calibrate(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        request = EstimateRequest('asked for', self._sensors.standing())
        if request.samples and not self._sensors.idle:
            return answered(response, False, 'the last estimate has not been published yet')
        try:
            return answered(response, True, self._sensors.estimate(request))
        except RefusedError as error:
            return answered(response, False, str(error))


async def _with_outcome(response: Any, begin: Callable[[Any], None]) -> Any:
    """The response to a set of parameters, once what `begin` starts has settled its future."""
    done = Future()
    try:
        begin(done)
    except RefusedError as error:
        _settle(done, (False, str(error)))
    ok, why = await done
    response.result = SetParametersResult(successful=ok, reason=why)
    return response


def _settle(done: Any, result: object) -> None:
    """Set a future's result, unless it has one: its caller may have been answered by then."""
    if not done.done():
        done.set_result(result)
