"""The node of `quad-tune rollback`: sends an update to the bridge and waits for its answer."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import Parameter, ParameterEvent, ParameterType, ParameterValue
from rclpy.qos import DurabilityPolicy, QoSProfile

from quad_sysid.errors import BadInputError

STATE = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
LISTEN_S, ANSWER_S = 10.0, 60.0
GAINS = 'serial_bridge: gains'


def publish(gains: Mapping[str, float], source: str) -> str:
    """Have the bridge fly `gains` (contract names, SI), or take back what is in flight.

    Returns empty where they are active, else the bridge's refusal. Raises BadInputError where no
    bridge listens or none answers.
    """
    rclpy.init()
    try:
        node: Any = rclpy.create_node('quad_tune_rollback')
        heard = _Heard(source)
        node.create_subscription(ParameterEvent, '/gains/active', heard.active, STATE)
        node.create_subscription(DiagnosticArray, '/diagnostics', heard.diagnostics, 10)
        publisher = node.create_publisher(ParameterEvent, '/gains/update', 10)

        def spin(until: Any, seconds: float) -> bool:
            end = time.monotonic() + seconds
            while not until() and time.monotonic() < end:
                rclpy.spin_once(node, timeout_sec=0.1)
            return bool(until())

        if not spin(lambda: publisher.get_subscription_count() and heard.gains, LISTEN_S):
            raise BadInputError('/gains/update', f'no bridge has been heard for {LISTEN_S:.0f} s')
        publisher.publish(_message(gains, source))
        if not spin(lambda: heard.refusal or heard.has(gains), ANSWER_S):
            raise BadInputError('/gains/active', f'no answer of the bridge for {ANSWER_S:.0f} s')
        return heard.refusal
    finally:
        rclpy.try_shutdown()


class _Heard:
    """The bridge's last words."""

    def __init__(self, source: str) -> None:
        self._source = source
        self.gains: dict[str, float] = {}
        self.refusal = ''

    def active(self, event: Any) -> None:
        self.gains = {p.name: p.value.double_value for p in event.changed_parameters}

    def diagnostics(self, array: Any) -> None:
        for status in array.status:
            if status.name == GAINS and f'gains of {self._source} refused' in status.message:
                self.refusal = status.message

    def has(self, gains: Mapping[str, float]) -> bool:
        return all(
            abs(self.gains.get(name, float('inf')) - value) <= 1e-6 * max(abs(value), 1e-9)
            for name, value in gains.items()
        )


def _message(gains: Mapping[str, float], source: str) -> Any:
    number, text, flag = (
        ParameterType.PARAMETER_DOUBLE,
        ParameterType.PARAMETER_STRING,
        ParameterType.PARAMETER_BOOL,
    )
    message = ParameterEvent(node='/quad_tune')
    message.changed_parameters = [
        *(
            Parameter(name=name, value=ParameterValue(type=number, double_value=value))
            for name, value in gains.items()
        ),
        Parameter(name='source', value=ParameterValue(type=text, string_value=source)),
        Parameter(name='rollback', value=ParameterValue(type=flag, bool_value=True)),
    ]
    return message
