"""The bridge's part for the sensors: service `~/calibrate_at_rest`, recordings. Wiring only."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

from rcl_interfaces.msg import ParameterEvent
from std_srvs.srv import Trigger

from quad_bridge import conversion
from quad_bridge.errors import RefusedError
from quad_bridge.link import Link
from quad_bridge.qos import STATE
from quad_bridge.sensor_keeper import SensorKeeper, Wanted
from quad_bridge.sensor_status import FILTER_HZ, sensors_status, vibration_entries
from quad_bridge.status import Status
from quad_bridge.wire.frames import Cycle


class SensorServices:
    """`lock` guards keeper and link; `report` publishes /diagnostics at once."""

    def __init__(
        self, node: Any, keeper: SensorKeeper, lock: threading.Lock, report: Callable[[], None]
    ) -> None:
        self._node, self._keeper, self._lock, self._report = node, keeper, lock, report
        self._restarts = 0
        self._since_ns = 0
        node.create_service(Trigger, '~/calibrate_at_rest', self._on_calibrate)
        node.create_subscription(ParameterEvent, 'logger/bag', self._on_bag, STATE)

    def cycle(self, frame: Cycle, restarts: int) -> None:
        """Take one cycle, in the port's thread; `restarts` of the STM32 so far."""
        if restarts != self._restarts:
            self._restarts = restarts
            self._keeper.restarted()
        self._keeper.cycle(frame, time.time())

    def tick(self, aircraft: str) -> None:
        """Make the estimate that arming or a recording asks for; report a change at once."""
        with self._lock:
            self._keeper.aircraft(aircraft)
            wanted = self._keeper.wanted()
            since_ns = self._keeper.current.since_ns
        if wanted is not None:
            try:
                self._node.get_logger().info(self._estimate(wanted))
            except RefusedError as error:
                self._node.get_logger().info(str(error))
        if wanted is not None or since_ns != self._since_ns:
            self._since_ns = since_ns
            self._report()

    def entries(self, link: Link) -> list[Status]:
        """Status of offsets and vibration. The spectrum takes a millisecond, without the lock."""
        with self._lock:
            offsets = sensors_status(self._keeper)
            rate_hz, samples = self._keeper.window.spectrum()
            filter_hz = link.gains.active.get('sensor.gyro_filter_hz', FILTER_HZ)
            flies = link.last_cycle is not None
        return [offsets, *(vibration_entries(rate_hz, samples, filter_hz) if flies else [])]

    def _estimate(self, wanted: Wanted) -> str:
        try:
            found = self._keeper.estimate(wanted)
        except RefusedError as error:
            with self._lock:
                raise RefusedError(self._keeper.refused(wanted, str(error))) from error
        with self._lock:
            return self._keeper.take(wanted, found)

    def _on_bag(self, event: ParameterEvent) -> None:
        if conversion.parameters(event).get('state') == 'recording':
            with self._lock:
                self._keeper.want('recording')

    def _on_calibrate(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        with self._lock:
            wanted = Wanted('asked for', self._keeper.window.standing())
            settled = self._keeper.settled
        if not settled:
            response.message = 'the last estimate has not been published yet'
            return response
        try:
            response.message = self._estimate(wanted)
            response.success = True
        except RefusedError as error:
            response.message = str(error)
        return response
