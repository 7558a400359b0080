"""What the run's nodes say, heard over the contract's topics by one small node.

Listens, and calls the nodes' Trigger services; nothing is published, no process started here.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import ParameterEvent
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.utilities import try_shutdown
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger

from quad_bridge.lockstep import Clock
from quad_bridge.nodes.conversion import values_of
from quad_bridge.nodes.qos import EVENT, HEARD
from quad_bridge.start import listen_by_udp
from quad_tuning.demo.processes import StageFailedError

TIMEOUT_S = 1200.0
"""Real time that anything may take in lockstep: what takes longer hangs."""


class Observer:
    """The latest word on every state topic, and waiting for one that satisfies a condition."""

    def __init__(self, domain: int, clock: Clock | None = None) -> None:
        self._clock = clock or Clock()
        self.active_gains: dict[str, float] = {}
        self.gains_time = 0.0
        """When the last word on /gains/active came, s on the run's clock."""
        self.segment: dict[str, Any] = {}
        self.diagnostics: dict[str, tuple[int, str, dict[str, str]]] = {}
        self.imu_count = 0
        self._context = Context()
        listen_by_udp()
        rclpy.init(context=self._context, domain_id=domain)
        self._node = Node('demo_observer', context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        subscribe = self._node.create_subscription
        subscribe(ParameterEvent, '/gains/active', self._on_gains, HEARD)
        subscribe(ParameterEvent, '/excitation/segment', self._on_segment, HEARD)
        subscribe(DiagnosticArray, '/diagnostics', self._on_diagnostics, EVENT)
        self._imu: Any = None

    def __enter__(self) -> Observer:
        """Return the observer, which needs nothing opened."""
        return self

    def __exit__(self, *_: object) -> None:
        """Shut the node and its context down."""
        self._executor.shutdown()
        self._node.destroy_node()
        try_shutdown(context=self._context)

    @property
    def nodes(self) -> list[str]:
        """Names of the nodes that are there."""
        return list(self._node.get_node_names())

    def count_imu(self, on: bool) -> None:
        """Listen to /imu/data only while its arrival is the question; it costs CPU."""
        if on and self._imu is None:
            self.imu_count = 0
            self._imu = self._node.create_subscription(Imu, '/imu/data', self._on_imu,
                                                       qos_profile_sensor_data, raw=True)
        elif not on and self._imu is not None:
            self._node.destroy_subscription(self._imu)
            self._imu = None

    def wait_for(self, stage: str, what: str, condition: Callable[[], bool], timeout_s: float,
                 meanwhile: Callable[[], None] = lambda: None) -> None:
        """Spin until `condition()`; raises StageFailedError after `timeout_s`.

        In lockstep nobody is hurried, and only `TIMEOUT_S` ends it. `meanwhile` is called about
        ten times a second and may raise (a process that died).
        """
        timeout_s = max(timeout_s, TIMEOUT_S) if self._clock.simulated else timeout_s
        deadline = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() > deadline:
                bad = [f'{name}: {text}' for name, (level, text, _) in self.diagnostics.items()
                       if level > 0]
                raise StageFailedError(stage, f'no {what} within {timeout_s:.0f} s'
                                       + (f' ({"; ".join(bad)})' if bad else ''))
            turn = time.monotonic() + 0.1
            while (remaining_s := turn - time.monotonic()) > 0:
                self._executor.spin_once(timeout_sec=remaining_s)
            meanwhile()

    def call(self, stage: str, service: str, timeout_s: float) -> str:
        """Call a Trigger service; its message. Raises StageFailedError where it is refused."""
        client = self._node.create_client(Trigger, service)
        try:
            self.wait_for(stage, f'service {service}', client.service_is_ready, timeout_s)
            future = client.call_async(Trigger.Request())
            self.wait_for(stage, f'answer of {service}', future.done, timeout_s)
            answer = future.result()
        finally:
            self._node.destroy_client(client)
        if answer is None or not answer.success:
            raise StageFailedError(stage, f'{service}: {answer and answer.message}')
        return str(answer.message)

    def _on_gains(self, event: ParameterEvent) -> None:
        self.gains_time = self._clock.now_s()
        values = values_of(event.changed_parameters)
        self.active_gains.update({name: v for name, v in values.items() if isinstance(v, float)})

    def _on_segment(self, event: ParameterEvent) -> None:
        self.segment = values_of(event.changed_parameters)

    def _on_diagnostics(self, array: DiagnosticArray) -> None:
        for status in array.status:
            level = status.level if isinstance(status.level, int) else status.level[0]
            pairs = {pair.key: pair.value for pair in status.values}
            self.diagnostics[status.name] = (level, status.message, pairs)

    def _on_imu(self, _raw: bytes) -> None:
        self.imu_count += 1
