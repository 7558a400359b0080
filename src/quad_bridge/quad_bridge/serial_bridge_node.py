"""The `serial_bridge` node: wires the port, the link and the contract's topics. No protocol here.

The port's thread decodes and publishes cycles at once; timers and subscriptions run in the one
executor; a lock guards the link between them.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Vector3Stamped, WrenchStamped
from rcl_interfaces.msg import ParameterEvent
from rclpy.qos import qos_profile_sensor_data
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import BatteryState, FluidPressure, Imu, JointState, Joy, MagneticField

from quad_bridge import conversion, diagnostics
from quad_bridge.autopilot import Inertial
from quad_bridge.bridge_parameters import BridgeSettings, declare
from quad_bridge.errors import RefusedError
from quad_bridge.excitation_relay import ExcitationRelay
from quad_bridge.gain_keeper import GainKeeper
from quad_bridge.gain_services import GainServices
from quad_bridge.gain_state import News, State
from quad_bridge.host_time import NEVER_NS, HostTime
from quad_bridge.link import Link
from quad_bridge.lockstep import IMU_STREAM, RC_STREAM, SETPOINT_STREAM, START_NS, WIRE, clock
from quad_bridge.managed_node import ManagedNode
from quad_bridge.node_time import nanoseconds
from quad_bridge.operator_enable import OperatorEnable
from quad_bridge.operator_services import OperatorServices
from quad_bridge.qos import EVENT, STATE, STREAM
from quad_bridge.ros_node import run
from quad_bridge.sensor_keeper import SensorKeeper
from quad_bridge.sensor_services import SensorServices
from quad_bridge.serial_port import SerialPort
from quad_bridge.sparing import Sparing
from quad_bridge.stamping import Stamped
from quad_bridge.status import OK
from quad_bridge.wire.codec import Counts
from quad_bridge.wire.frames import Battery, Cycle, Flag, Outputs, RcChannels, SlowSensors

TICK_S = 0.05
REPORT_S = 0.1
"""Least time between two reports, however many updates are refused."""
SETTLED_S = 0.5
"""Least time over which rates and losses are told."""
YAW_STICK = 3
NO_EXCITATION = 'the far end sends standard messages only: it has no QUAD_EXCITATION'


class SerialBridge(ManagedNode):
    """See the module. Configured it has its topics, active the port."""

    def __init__(self) -> None:
        super().__init__('serial_bridge')
        self._settings: BridgeSettings = declare(self)
        self._lock = threading.Lock()
        self._link = Link(self._settings.signing, START_NS if clock().simulated else None)
        self._enable = OperatorEnable(required=self._settings.require_enable)
        self._relay = ExcitationRelay(self._settings.excitation_valid_ms, self._enable)
        self._messages = conversion.CycleMessages()
        self._keeper = GainKeeper(self._settings.keeper, self._link.gains)
        self._gain_services = GainServices(self, self._ask_gains, self._ask_check)
        self._operator = OperatorServices(self, self._enable, self._forward, self._armed)
        self._sensor_keeper = SensorKeeper(
            self._settings.keeper.folder, correct=self._settings.correct_sensors
        )
        self._sensors = SensorServices(self, self._sensor_keeper, self._lock, self._on_report)
        self._link.on_ack = self._operator.acknowledged
        self._link.on_cycle = self._watch_cycle
        self._reported_s = 0.0
        self._simulated = self.simulated
        self._time = HostTime(self._epoch())
        self._told_time: Any = None
        """In lockstep, for whoever is not on the line; outside any namespace."""
        if clock().simulated:
            self._told_time = self.create_publisher(ClockMessage, '/clock', 1)
        self._failed_lately = 0
        self._since = self._before = diagnostics.Since(clock().now_s(), Counts(), 0)
        self._opened_counts = Counts()
        self._sparing = Sparing()
        self._changes = diagnostics.Changes(self._sparing)
        self._port = self._new_port()

    def _new_port(self) -> SerialPort:
        heard, opened = self.fence.around(self._on_bytes), self.fence.around(self._on_open)
        return SerialPort(
            self._settings.port, self._settings.baud, heard, opened,
            on_silence=lambda: clock().forget(WIRE),
        )  # fmt: skip

    def activate(self) -> None:
        """Open the port; it need not be there yet."""
        self._port = self._new_port()
        self._timers_of_work = (
            self.create_timer(TICK_S, self._on_tick),
            self.create_timer(1.0, self._on_report),
        )
        self._port.start()

    def deactivate(self) -> None:
        """End a running excitation, stop the port's thread."""
        if self._relay.injection:
            self._forward(self._relay.segment({'segment': 'idle'}))
        for timer in self._timers_of_work:
            self.destroy_timer(timer)
        self._operator.end()
        with self._lock:
            self._keeper.disturb('the node was deactivated')
        self._port.stop()

    def configure(self) -> None:
        """Create the topics."""

        def publisher(kind: Any, topic: str, qos: Any = STREAM) -> Any:
            return self.publisher(kind, topic, qos)

        m = self._messages
        imu, motors = publisher(Imu, '/imu/data'), publisher(JointState, '/motors/command')
        self._per_cycle = (
            (imu.publish, m.imu),
            (motors.publish, m.motors),
            (publisher(WrenchStamped, '/control/wrench').publish, m.wrench),
            (publisher(Vector3Stamped, '/setpoint/attitude').publish, m.attitude_setpoint),
            (publisher(Vector3Stamped, '/setpoint/rates').publish, m.rate_setpoint),
        )
        self._applied = publisher(Vector3Stamped, '/excitation/applied')
        self._rc = publisher(Joy, '/rc/in')
        self._others: dict[type, tuple[tuple[Any, Callable[[Any, int], Any]], ...]] = {
            Battery: ((publisher(BatteryState, '/battery'), conversion.battery_message),),
            SlowSensors: (
                (publisher(MagneticField, '/imu/mag'), self._mag_message),
                (publisher(FluidPressure, '/baro'), conversion.baro_message),
            ),
            Inertial: ((imu, conversion.inertial_message),),
            Outputs: ((motors, conversion.outputs_message),),
        }
        self._active = publisher(ParameterEvent, '/gains/active', STATE)
        self._diagnostics = publisher(DiagnosticArray, '/diagnostics', EVENT)
        subscribe = self.subscribe
        subscribe(ParameterEvent, '/excitation/segment', self._on_segment, STATE)
        subscribe(ParameterEvent, '/gains/update', self._on_gains, EVENT)
        loss = STREAM if clock().simulated else qos_profile_sensor_data
        subscribe(Vector3Stamped, '/excitation/setpoint', self._on_setpoint, loss)

    # In the port's thread.

    def _on_open(self) -> None:
        with self._lock:
            self._link.opened()
            self._keeper.disturb('the port was opened anew')
            self._time.opened(self._epoch())
            self._opened_counts = self._link.decoder.counts
        words = f'{self._port.status.path}: open at {self._settings.baud} baud'
        if self._sparing.allow(words, clock().now_s()):
            self.get_logger().info(words)

    def _on_bytes(self, data: bytes) -> None:
        now_ns = clock().now_ns()
        with self._lock:
            before = self._link.cycles
            for item in self._link.receive(data, now_ns):
                self._publish(item)
            self._link.poll_gains(now_ns)
            reply = self._link.drain()
            last = self._link.last_cycle if self._link.cycles > before else None
        if reply:
            self._port.write(reply)
        if last is not None:
            clock().handled(WIRE, START_NS + 1000 * last.time_us)

    def _publish(self, item: Stamped) -> None:
        frame = item.frame
        if item.stamp_ns is None:
            words = f'STM32: {getattr(frame, "text", "")}'
            if self._sparing.allow(words, clock().now_s()):
                self.get_logger().info(words)
            return
        stamp_ns = item.stamp_ns + self._time.epoch_ns
        if stamp_ns <= 0:  # simulated time has not come yet
            return
        if isinstance(frame, Cycle):
            self._publish_cycle(frame, stamp_ns)
        elif isinstance(frame, RcChannels):
            self._publish_sticks(frame, stamp_ns)
        else:
            for publisher, convert in self._others[type(frame)]:
                message = convert(frame, stamp_ns)
                if message is not None:
                    publisher.publish(message)

    def _publish_sticks(self, frame: RcChannels, stamp_ns: int) -> None:
        last = self._link.last_cycle
        lost = last is not None and bool(last.flags & Flag.RC_FAILSAFE)
        message = conversion.rc_message(frame, stamp_ns, failsafe=lost)
        self._rc.publish(message)
        clock().published(RC_STREAM, stamp_ns)
        self._keeper.sticks(message.axes[YAW_STICK], clock().now_s())

    def _mag_message(self, frame: SlowSensors, stamp_ns: int) -> MagneticField | None:
        offset = self._sensor_keeper.stamped(stamp_ns).hard_iron
        return conversion.mag_message(frame, stamp_ns, offset)

    def _watch_cycle(self, frame: Cycle, now_ns: int) -> None:
        self._sensors.cycle(frame, self._link.decoder.restarts)
        if self._keeper.state is State.CHECKING:
            fault = self._enable.fault(1e-9 * now_ns)
            if fault:
                self._keeper.disturb(fault)
        pulse = self._keeper.cycle(frame, 1e-9 * now_ns)
        if pulse is not None:
            self._link.send(pulse)

    def _publish_cycle(self, frame: Cycle, stamp_ns: int) -> None:
        self._messages.fill(frame, stamp_ns, self._sensor_keeper.stamped(stamp_ns).gyro_bias)
        for publish, message in self._per_cycle:
            publish(message)
        if conversion.excited(frame):
            self._applied.publish(self._messages.excitation)
        clock().published(IMU_STREAM, stamp_ns)
        if self._told_time is not None:
            self._told_time.publish(ClockMessage(clock=self._messages.imu.header.stamp))

    # In the executor.

    def _on_tick(self) -> None:
        with self._lock:
            self._link.tick(clock().now_ns())
            self._keeper.tick(clock().now_s())
            self._link.poll_gains(clock().now_ns())
            outgoing = self._link.drain()
            news, self._keeper.news = self._keeper.news, []
            aircraft = self._settings.keeper.name_of(self._link.gains.state)
        self._send(outgoing)
        self._operator.tick()
        self._sensors.tick(aircraft)
        end = self._relay.tick(clock().now_s())
        if end is not None:
            self._forward(end)
        for item in news:
            self._tell(item)
        if news and clock().now_s() - self._reported_s > REPORT_S:
            self._on_report()

    def _tell(self, item: News) -> None:
        if item.fault:
            self.get_logger().error(item.text)
        else:
            self.get_logger().info(item.text)
        if item.active is not None:
            name, now_ns = self.get_fully_qualified_name(), self.get_clock().now().nanoseconds
            self._active.publish(conversion.event_message(item.active, name, now_ns))
        with self._lock:
            active = self._link.gains.active
        self._gain_services.show(active)

    def _send(self, outgoing: bytes) -> None:
        # Nothing is written to a shut port; the diagnostics say that it is shut.
        if outgoing and self._port.status.opened:
            self._port.write(outgoing)

    def _on_segment(self, event: ParameterEvent) -> None:
        end = self._relay.segment(conversion.parameters(event))
        with self._lock:
            if end is None:
                self._keeper.disturb()
            elif self._keeper.state is State.CHECKING:
                end = None
        if end is not None:
            self._forward(end)

    def _on_setpoint(self, message: Vector3Stamped) -> None:
        v = message.vector
        frame = self._relay.setpoint(v.x, v.y, v.z, clock().now_s())
        if frame is not None:
            self._forward(frame)
        clock().handled(SETPOINT_STREAM, nanoseconds(message.header.stamp))

    def _forward(self, frame: Any) -> None:
        with self._lock:
            self._link.send(frame)
            outgoing = self._link.drain()
        self._send(outgoing)

    def _on_gains(self, event: ParameterEvent) -> None:
        with contextlib.suppress(RefusedError):  # it is in the keeper's news
            self._ask_gains(conversion.parameters(event))

    def _ask_gains(self, parameters: Mapping[str, object]) -> None:
        """Hand an update to the keeper; raises RefusedError."""
        if not self.active:
            raise RefusedError('the node is not active')
        with self._lock:
            words = self._keeper.ask(parameters, clock().now_s())
            self._link.poll_gains(clock().now_ns())
            outgoing = self._link.drain()
        self._send(outgoing)
        self.get_logger().info(words)

    def _armed(self) -> bool | None:
        with self._lock:
            return self._link.armed_lately(clock().now_ns())

    def _ask_check(self, told: Callable[[str], None], motors: bool) -> None:
        """Have the polarity or the motors checked; raises RefusedError."""
        if not self.active:
            raise RefusedError('the node is not active')
        with self._lock:
            self._keeper.check(clock().now_s(), told, motors=motors)

    def _on_report(self) -> None:
        self._keep_epoch()
        self._reported_s = clock().now_s()
        now_s = clock().now_s()
        with self._lock:
            link, port = self._link, self._port.status
            # a report out of turn may follow the last one so closely that nothing came between
            unset = self._time.epoch_ns == NEVER_NS
            settled = now_s - self._since.time_s > SETTLED_S
            since = self._since if settled else self._before
            standard = link.standard_only(clock().now_ns())
            self._relay.refusal = NO_EXCITATION if standard else ''
            entries = [
                diagnostics.link_status(port, link, since, now_s, self._opened_counts),
                diagnostics.clock_status(
                    link, self._time.behind_ns, unset=unset, now_ns=clock().now_ns()
                ),
                diagnostics.gains_status(link, self._keeper),
                diagnostics.excitation_status(self._relay, link, self._enable.fault(now_s)),
            ]
            if settled:
                counts = diagnostics.Since(
                    now_s, link.decoder.counts, link.cycles, port.dropped_writes
                )
                self._before, self._since = since, counts
        entries += self._sensors.entries(link) + self._operator.entries()
        self._failed_lately = self.fence.lately() if settled else self._failed_lately
        entries += diagnostics.callback_entries(self.fence.failed, self._failed_lately)
        self._diagnostics.publish(
            diagnostics.diagnostic_array(
                self.get_name(), self._settings.port, self.get_clock().now().to_msg(), entries
            )
        )
        for entry in self._changes.new(entries[:2], now_s):
            text = f'{self._settings.port}: {entry.name}: {entry.message}'
            if entry.level == OK:
                self.get_logger().info(text)
            else:
                self.get_logger().warning(text)

    def _epoch(self) -> int:
        """ROS time minus the steady clock, ns."""
        now_ns = int(self.get_clock().now().nanoseconds)
        return NEVER_NS if self._simulated and not now_ns else now_ns - clock().now_ns()

    def _keep_epoch(self) -> None:
        if self._simulated:
            self._time.follow(self._epoch())
            return
        words = self._time.measured(self._epoch(), armed=self._link.armed)
        if words:
            self.get_logger().warning(words)


def main() -> None:
    """Run the node until it is interrupted; exit status 2 where its parameters are wrong."""
    run(SerialBridge, 'serial_bridge')
