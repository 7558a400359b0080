"""The observer hears the state topics, also the words that were said before it came."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2 or its wheels')

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.msg import Parameter, ParameterEvent, ParameterType, ParameterValue
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_srvs.srv import Trigger

from quad_tuning.demo.domain import own_domain
from quad_tuning.demo.errors import StageFailedError
from quad_tuning.demo.observer import STATE, VOLATILE, Observer, values_of


def event(**values: float | str) -> ParameterEvent:
    def wrapped(value: float | str) -> ParameterValue:
        if isinstance(value, str):
            return ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=value)
        return ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value)

    return ParameterEvent(
        changed_parameters=[
            Parameter(name=name.replace('_', '.'), value=wrapped(value))
            for name, value in values.items()
        ]
    )


class Aircraft:
    """A node that says what bridge and logger would say."""

    def __init__(self, domain: int) -> None:
        self.context = Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = Node('aircraft', context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)

    def turn(self) -> None:
        self.executor.spin_once(timeout_sec=0.0)

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)


@pytest.fixture
def pair(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Aircraft, Callable[[], Observer]]]:
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    with own_domain() as domain:
        aircraft = Aircraft(domain)
        try:
            yield aircraft, lambda: Observer(domain)
        finally:
            aircraft.close()


def test_values_of_an_event_keep_names_and_types() -> None:
    assert values_of(event(roll_kp=2.5, source='me')) == {'roll.kp': 2.5, 'source': 'me'}


def test_late_it_still_hears_the_last_gains(
    pair: tuple[Aircraft, Callable[[], Observer]],
) -> None:
    aircraft, observe = pair
    publisher = aircraft.node.create_publisher(ParameterEvent, '/gains/active', STATE)
    publisher.publish(event(roll_kp=3.0, source='read back'))
    with observe() as observer:
        observer.wait_for(
            'connect', 'gains', lambda: bool(observer.active_gains), 20.0, aircraft.turn
        )
        assert observer.active_gains == {'roll.kp': 3.0}


def test_silence_ends_with_what_the_nodes_complain_of(
    pair: tuple[Aircraft, Callable[[], Observer]],
) -> None:
    aircraft, observe = pair
    publisher = aircraft.node.create_publisher(DiagnosticArray, '/diagnostics', VOLATILE)
    status = DiagnosticStatus(level=DiagnosticStatus.ERROR, name='link', message='port is busy')

    def complain() -> None:
        publisher.publish(DiagnosticArray(status=[status]))

    with observe() as observer:
        observer.wait_for(
            'connect', 'complaint', lambda: bool(observer.diagnostics), 20.0, complain
        )
        with pytest.raises(StageFailedError, match=r'connect: no gains within 0 s .*port is busy'):
            observer.wait_for('connect', 'gains', lambda: False, 0.3)


def test_a_refused_call_gives_the_reason(
    pair: tuple[Aircraft, Callable[[], Observer]],
) -> None:
    aircraft, observe = pair

    def answer(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = False, 'disk is full'
        return response

    aircraft.node.create_service(Trigger, '/bag_logger/start', answer)
    with observe() as observer:
        wait = observer.wait_for

        def turning(*arguments: object) -> None:
            wait(*arguments, aircraft.turn)  # type: ignore[arg-type]

        observer.wait_for = turning  # type: ignore[method-assign,assignment]
        with pytest.raises(StageFailedError, match='/bag_logger/start: disk is full'):
            observer.call('fly', '/bag_logger/start', 20.0)
