"""An autopilot's own log: fetched after landing, announced on /aircraft/log. Wiring only.

Fetching and files are in autopilots/log_fetch.py and log_store.py.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import ParameterEvent
from std_srvs.srv import Trigger

from quad_bridge.autopilots.aircraft import AutopilotAircraft
from quad_bridge.autopilots.log_fetch import LogFetch, Phase
from quad_bridge.autopilots.log_store import LogStore
from quad_bridge.lockstep import clock
from quad_bridge.nodes import conversion
from quad_bridge.nodes.managed_node import answered
from quad_bridge.nodes.qos import STATE
from quad_bridge.status import OK, WARN, Status
from quad_bridge.topics import AIRCRAFT_LOG
from quad_bridge.wire import frames as f

LOGS = 'logs'


class AutopilotLogs:
    """Offers `~/fetch_log`; `tick` also fetches by itself once the aircraft has landed."""

    def __init__(
        self, node: Any, aircraft: Callable[[], AutopilotAircraft | None],
        folder: Callable[[], Path | None], offset_ns: Callable[[], int | None],
        run: Callable[[Callable[[], object]], None], *, by_itself: bool,
    ) -> None:  # fmt: skip
        """`folder` of the aircraft's files; `offset_ns`: ROS time minus the aircraft's."""
        self._node, self._aircraft, self._folder, self._offset_ns = (
            node, aircraft, folder, offset_ns
        )
        self._by_itself = by_itself
        self._fetch, self._store = LogFetch(), LogStore(run)
        self._fetch.there = self._store.there
        self._flew, self._announced, self._logged_pct = False, '', -1
        self._finishing = False

    def configure(self) -> None:
        """Create the topic and the service."""
        self._node.service(Trigger, '~/fetch_log', self._on_fetch)
        self._publisher = self._node.publisher(ParameterEvent, AIRCRAFT_LOG, STATE)

    def take(self, frame: f.LogEntry | f.LogData, _now_ns: int) -> None:
        """Take an answer, in the port's thread."""
        self._fetch.take(frame, clock().now_s())

    def status_text(self, text: str) -> None:
        """Give way to a pilot whom ArduPilot does not let arm because of the log."""
        if text.startswith('Arm: ') and 'ownloading log' in text:
            self._fetch.stop('the pilot wants to fly; ~/fetch_log fetches it later')

    def end(self) -> None:
        """Give a fetch up."""
        self._fetch.stop('the node was deactivated; ~/fetch_log fetches the rest')

    @property
    def coming(self) -> bool:
        """Whether the log is on the line now."""
        return self._fetch.phase is Phase.FETCHING

    def poll(self) -> list[f.Frame]:
        """Say what to send now; in the lock under which `take` is called."""
        parts, self._fetch.parts = self._fetch.parts, []
        self._store.write(parts)
        return self._fetch.poll(clock().now_s())

    def tick(self) -> None:
        """Begin after a landing, and say how far it is."""
        aircraft = self._aircraft()
        if aircraft is None:
            return
        flight = aircraft.flight
        if flight.armed:
            self._flew = self._flew or flight.landed == 2
            self._fetch.stop('the aircraft is armed again')
            if self._by_itself and self._announced != 'expected':
                self._publish('expected', '')
        elif self._announced == 'expected':
            if not self._flew or self._begin():  # there is none, or it cannot be fetched
                self._publish('failed', '')
            self._flew = False
        self._tell()

    def status(self) -> Status:
        """Status of the fetch, for /diagnostics."""
        fetch = self._fetch
        values = {'state': fetch.phase.value, 'bytes': fetch.got, 'of': fetch.size,
                  'path': self._store.whole}  # fmt: skip
        words = self._store.fault or (fetch.reason if fetch.phase is Phase.FAILED else '')
        if words:
            return Status('log of the autopilot', WARN, words, values)
        done = f' {fetch.got / 1e6:.1f} of {fetch.size / 1e6:.1f} MB' if fetch.size else ''
        return Status('log of the autopilot', OK, f'{fetch.phase.value}{done}', values)

    def _begin(self) -> str:
        aircraft, folder = self._aircraft(), self._folder()
        if aircraft is None or folder is None:
            return 'no autopilot with a log of its own is on the line'
        if aircraft.flight.armed and not aircraft.kind.fetches_armed:
            return f'{aircraft.kind.name} sends no log while it is armed'
        if aircraft.flight.armed:
            return 'not in flight: the line is for the flight; land and disarm it first'
        self._store.open(folder / LOGS, aircraft.kind.log_suffix)
        self._store.whole = self._store.fault = ''  # of the log before
        self._fetch.begin(clock().now_s(), aircraft.kind.log_closes_s,
                          by_time=aircraft.kind.logs_by_time)
        self._finishing, self._logged_pct = False, -1
        self._publish('fetching', '')
        return ''

    def _tell(self) -> None:
        fetch, log = self._fetch, self._node.get_logger()
        if fetch.phase is Phase.FETCHING and fetch.size:
            pct = 25 * int(4.0 * fetch.got / fetch.size)
            if pct > self._logged_pct:
                self._logged_pct = pct
                words = f'log of the autopilot: {pct} % of {fetch.size / 1e6:.1f} MB'
                log.info(words)
        if fetch.phase is Phase.DONE and not self._finishing:
            self._finishing = True
            self._store.finish()
        if self._store.whole and self._announced == 'fetching':
            self._publish('complete', self._store.whole)
            log.info(self._store.whole)
        words = self._store.fault or (fetch.reason if fetch.phase is Phase.FAILED else '')
        if words and self._announced == 'fetching':
            self._publish('failed', '')
            words = f'log of the autopilot: {words}: take it from the card'
            log.warning(words)

    def _publish(self, state: str, path: str) -> None:
        self._announced = state
        values: dict[str, bool | float | str] = {'state': state, 'path': path}
        offset_ns = self._offset_ns()
        if offset_ns is not None:
            values['offset_s'] = 1e-9 * offset_ns
        name, now_ns = self._node.get_fully_qualified_name(), self._node.get_clock().now()
        message = conversion.event_message(values, name, now_ns.nanoseconds)
        self._publisher.publish(message)

    def _on_fetch(self, _: Any, response: Any) -> Any:
        fault = self._begin()
        return answered(response, not fault, fault or 'fetching the newest log')
