"""The `serial_bridge` node: the flight controller's port on one side, topics on the other.

One thread reads the port and hands each of the link's events to its handler; the executor's thread
does the rest. Whatever is sent is encoded, signed and written in `_flush`, in one order, under the
lock that also guards link, gains and relay.
"""

from __future__ import annotations

import contextlib
import importlib
import threading
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Vector3Stamped, WrenchStamped
from rcl_interfaces.msg import ParameterEvent
from rclpy.parameter import Parameter
from rclpy.qos import qos_profile_sensor_data
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import BatteryState, FluidPressure, Imu, JointState, Joy, MagneticField

from quad_bridge.aircraft import Ability, Aircraft
from quad_bridge.arming import OperatorEnable
from quad_bridge.autopilots.aircraft import Connected
from quad_bridge.craft import Craft
from quad_bridge.errors import RefusedError
from quad_bridge.excitation_relay import ExcitationRelay
from quad_bridge.gains.cycles import LOW_THROTTLE
from quad_bridge.gains.history import History, Worker
from quad_bridge.gains.polarity import FLOWN, PULSE_VALID_MS
from quad_bridge.gains.table import with_mixing
from quad_bridge.gains.update import GainUpdates, Note, Reply, State
from quad_bridge.link.autopilot import (
    BATTERY,
    COMPASS,
    INERTIAL,
    MOTORS,
    PRESSURE,
    ROTORS,
    Inertial,
)
from quad_bridge.link.machine import Link
from quad_bridge.link.port import PortState, SerialPort
from quad_bridge.link.report import LinkReport
from quad_bridge.link.stamping import Arrived, Described, Restarted, Stamped
from quad_bridge.lockstep import START_NS, WIRE, clock
from quad_bridge.motor_outputs import MotorOutputs, motor_outputs
from quad_bridge.nodes import conversion, diagnostics
from quad_bridge.nodes.autopilot_logs import AutopilotLogs
from quad_bridge.nodes.bridge_parameters import BridgeSettings, declare
from quad_bridge.nodes.description import Description
from quad_bridge.nodes.fence import LogLimiter
from quad_bridge.nodes.host_time import NEVER_NS, Epoch, HostTime, read_epoch
from quad_bridge.nodes.managed_node import ManagedNode
from quad_bridge.nodes.qos import EVENT, HEARD, STATE, STREAM
from quad_bridge.nodes.ros_node import run
from quad_bridge.nodes.services import GainServices, OperatorServices, SensorServices
from quad_bridge.sensors.live import LiveSensors
from quad_bridge.status import OK
from quad_bridge.topics import STREAMS
from quad_bridge.wire import frames as f

TICK_S = 0.1  # an executor's turn costs half a millisecond; what is urgent the port's thread does
POLL_NS = 20_000_000
"""Longest time between two looks at what is to be asked of the aircraft while bytes arrive."""
BACK_S = 4.0  # longest wait for the old gains and the pilot's mode at the end; launch kills at 10
REPORT_S = 0.1  # least time between two reports, however many updates are refused
YAW_STICK = 3


class SerialBridge(ManagedNode):
    """See the module. Configured it has publishers and services, active the port and ears."""

    def __init__(self) -> None:
        super().__init__('serial_bridge')
        settings: BridgeSettings = declare(self)
        self._settings = settings
        self._lock = threading.Lock()
        self._link = Link(settings.signing, START_NS if clock().simulated else None,
                          settings.line_baud)  # fmt: skip
        self._report = LinkReport(self._link, clock().now_s())
        self._enable = OperatorEnable(required=settings.require_enable)
        self._connected = Connected(
            self._standard, clock().now_s, allow_gains=settings.allow_gains,
            allow_excitation=settings.allow_excitation,
        )  # fmt: skip
        self._connected.on_change = self._on_aircraft
        self._relay = ExcitationRelay(settings.excitation_valid_ms, self._enable, self._present)
        self._worker, self._log_worker = Worker(), Worker()
        self._history = History(settings.gains.folder, self._worker)
        self._gains = GainUpdates(settings.gains, self._history)
        self._gains.use(self._present().gains)
        self._sensors = LiveSensors(correct=settings.correct_sensors)
        self._description = Description(self, settings.craft, self._on_craft)
        self._motors: MotorOutputs | None = None  # of another autopilot, once it is known
        self._gain_services = GainServices(self, self._ask_gains, self._ask_check)
        self._operator = OperatorServices(
            self, self._enable, self._present, self._forward, self._armed, self._flies,
            lambda: self._link.name,
        )
        self._sensor_services = SensorServices(self, self._sensors, self._on_report)
        self._logs = AutopilotLogs(
            self, lambda: self._connected.autopilot, self._aircraft_folder, self._offset_ns,
            self._log_worker, by_itself=settings.fetch_log,
        )  # fmt: skip
        self._messages = conversion.Messages()
        self.inside: list[Any] = []
        if settings.logger is not None:
            self.inside.append(self._logger_inside(settings.logger))
        self._arrived: dict[type, Callable[[Any, int], None]] = {
            f.Cycle: self._on_cycle,
            f.ParamValue: self._on_gains_frame,
            f.GainsState: self._on_gains_frame,
            f.RcChannels: lambda frame, now_ns: self._gains.sticks(
                conversion.rc_axis(frame, YAW_STICK), 1e-9 * now_ns),
            f.CommandAck: lambda frame, _: self._operator.acknowledged(frame),
            f.StatusText: self._on_text,
            f.LogEntry: self._logs.take,
            f.LogData: self._logs.take,
        }
        self._reported_s, self._poll_ns = 0.0, 0
        self._simulated = self.simulated
        self._time = HostTime(*self._epoch())
        self._clock_topic: Any = None  # in lockstep, for whoever is not on the line
        if clock().simulated:
            self._clock_topic = self.create_publisher(ClockMessage, '/clock', 1)
        self._limiter = LogLimiter()
        self._changes = diagnostics.Changes(self._limiter)
        self._port = self._new_port()

    def _new_port(self) -> SerialPort:
        fenced, settings = self.fence.around, self._settings
        return SerialPort(settings.port, settings.baud, fenced(self._on_bytes),
                          fenced(self._on_open), lambda: clock().forget(WIRE))  # fmt: skip

    def _logger_inside(self, options: Mapping[str, Any]) -> Any:
        """A logger for this process, in the same namespace, with these parameters."""
        declared = {name: self.get_parameter(name).value for name in ('managed', 'use_sim_time')}
        parameters = [Parameter(name, value=value)
                      for name, value in {**declared, **options}.items()]
        logger_class = importlib.import_module('quad_bridge.nodes.bag_logger').BagLogger
        return logger_class(STREAMS, namespace=self.get_namespace(), use_global_arguments=False,
                            parameter_overrides=parameters)  # fmt: skip

    def configure(self) -> None:
        """Create what is published, and the services."""
        stream = self._stream
        imu, motors = stream(Imu, '/imu/data'), stream(JointState, '/motors/command')
        self._per_cycle = (
            imu,
            motors,
            stream(WrenchStamped, '/control/wrench'),
            stream(Vector3Stamped, '/setpoint/attitude'),
            stream(Vector3Stamped, '/setpoint/rates'),
        )
        self._applied = stream(Vector3Stamped, '/excitation/applied')
        self._rc = stream(Joy, '/rc/in')
        messages = self._messages
        self._others: dict[str, tuple[Any, Callable[[Any, int], Any]]] = {
            BATTERY: (stream(BatteryState, BATTERY), messages.battery),
            COMPASS: (stream(MagneticField, COMPASS), messages.mag),
            PRESSURE: (stream(FluidPressure, PRESSURE), messages.baro),
            INERTIAL: (imu, messages.inertial),
            MOTORS: (motors, partial(self._of_motors, messages.outputs)),
            ROTORS: (stream(JointState, ROTORS), partial(self._of_motors, messages.rotors)),
        }
        self._active = self.publisher(ParameterEvent, '/gains/active', STATE)
        self._diagnostics = self.publisher(DiagnosticArray, '/diagnostics', EVENT)
        for part in (
            self._description, self._gain_services, self._operator, self._sensor_services,
            self._logs,
        ):
            part.configure()

    def _stream(self, kind: Any, topic: str) -> Callable[[bytes], None]:
        """A publisher that also passes messages to the logger in this process."""
        publish = self.stream(kind, topic, STREAM)

        def both(data: bytes) -> None:
            publish(data)
            for logger in self.inside:
                logger.take(topic, data)

        return both if self.inside else publish

    def activate(self) -> None:
        """Listen, and open the port; it need not be there yet."""
        for part in self._description, self._operator, self._sensor_services:
            part.activate()
        self.subscribe(ParameterEvent, '/excitation/segment', self._on_segment, HEARD)
        self.subscribe(ParameterEvent, '/gains/update', self._on_gains, EVENT)
        self.subscribe(
            Vector3Stamped, '/excitation/setpoint', self._on_setpoint, qos_profile_sensor_data
        )
        if self._settings.craft is not None:
            self._on_craft(self._settings.craft)
            self._description.publish(self._settings.craft)
        self._port = self._new_port()
        self.timer(TICK_S, self._on_tick)
        self.timer(1.0, self._on_report)
        self._port.start()

    def deactivate(self) -> None:
        """End excitation and trial, wait until the aircraft has what it had, stop the port.

        Nobody watches gains on trial any more, and PX4 and ArduPilot take nothing back themselves.
        """
        if self._relay.injection:
            with self._lock:
                end = self._relay.segment({'segment': 'idle'})
            self._forward(end)
        self._operator.end()
        with self._lock:
            self._gains.disturb('the node was deactivated')
            self._gains.end('the node was deactivated')
            self._logs.end()
            self._poll_gains(clock().now_ns())
            self._flush()
        until_s, rest = clock().now_s() + BACK_S, self.fence.around(clock().rest)
        while not (at_rest := self._at_rest()) and clock().now_s() < until_s \
                and self._port.status.state is PortState.OPEN:
            rest(0.02)
        self._tell_notes()
        if not at_rest:
            self.get_logger().error(f'{self._link.name}: has not confirmed its old gains and mode '
                                    'before the bridge ended: look at both')
        self._port.stop()
        self._worker.close()
        self._log_worker.close()

    def _at_rest(self) -> bool:
        """Whether the aircraft has nothing left of a trial or an excitation."""
        with self._lock:
            return self._gains.state is State.IDLE and self._present().at_rest

    # Called in the port's thread.

    def _on_open(self) -> None:
        with self._lock:
            self._link.opened()
            self._motors = None
            self._report.opened()
            self._gains.restarted()
            self._gains.disturb('the port was opened again')
            self._connected.doubt()
            self._time.opened(*self._epoch())
        path = self._port.status.path
        speed = '' if '://' in path else f' at {self._settings.baud} baud'
        self._say_once(f'{path}: open{speed}')

    def _on_bytes(self, data: bytes) -> None:
        now_ns = clock().now_ns()
        with self._lock:
            # what arrives beside cycles may be answered, and what is in flight may have to go back
            asks = self._gains.state is not State.IDLE or self._connected.autopilot is not None
            for event in self._link.receive(data, now_ns):
                if isinstance(event, Stamped):
                    self._publish(event)
                elif isinstance(event, Arrived):
                    asks = asks or not isinstance(event.frame, f.Cycle)
                    self._on_arrived(event.frame, now_ns)
                elif isinstance(event, Described):
                    self._on_described(event)
                elif isinstance(event, Restarted):
                    self._gains.restarted()
                    self._sensors.restarted()
            if asks or now_ns >= self._poll_ns:
                self._poll_gains(now_ns)
            self._flush()
            received_us = self._link.received_us
        if received_us is not None:
            clock().handled(WIRE, START_NS + 1000 * received_us)

    def _on_arrived(self, frame: Any, now_ns: int) -> None:
        self._connected.take(frame, 1e-9 * now_ns)
        handle = self._arrived.get(type(frame))
        if handle is not None:
            handle(frame, now_ns)

    def _on_cycle(self, frame: f.Cycle, now_ns: int) -> None:
        self._sensors.cycle(frame)
        if self._gains.state is State.CHECKING:
            fault = self._enable.fault(1e-9 * now_ns)
            if fault:
                self._gains.disturb(fault)
        pulse = self._gains.cycle(frame, 1e-9 * now_ns)
        if pulse is not None:
            self._send(self._present().excite(*pulse, PULSE_VALID_MS))

    def _on_gains_frame(self, frame: f.ParamValue | f.GainsState, now_ns: int) -> None:
        if self._connected.has_gains:
            self._gains.take(frame, 1e-9 * now_ns)

    def _on_text(self, frame: f.StatusText, _: int) -> None:
        self._logs.status_text(frame.text)
        self._say_once(f'{self._link.name}: {frame.text}')

    def _present(self) -> Aircraft:
        return self._connected.aircraft

    def _on_aircraft(self, aircraft: Aircraft) -> None:
        """Another aircraft is on the line, by its heartbeat."""
        self._gains.use(aircraft.gains)
        self._link.describe_again()
        autopilot = self._connected.autopilot
        self._link.autopilot.also_hz = autopilot.kind.requested_hz if autopilot is not None else {}

    def _publish(self, event: Stamped) -> None:
        frame, stamp_ns = event.frame, event.stamp_ns + self._time.epoch_ns
        is_timed = stamp_ns > 0  # simulated time may not have come yet
        if isinstance(frame, f.Cycle):
            if is_timed:
                self._publish_cycle(frame, stamp_ns)
            return
        self._connected.take(frame, clock().now_s())
        if not is_timed:
            return
        if isinstance(frame, f.RcChannels):
            last = self._link.last_cycle
            lost = last is not None and bool(last.flags & f.Flag.RC_FAILSAFE)
            self._rc(self._messages.sticks(frame, stamp_ns, failsafe=lost))
        else:
            publish, convert = self._others[event.topic]
            message = convert(frame, stamp_ns)
            if message is not None:
                publish(message)
        if isinstance(frame, Inertial):
            self._publish_autopilot(frame, stamp_ns)

    def _publish_autopilot(self, frame: Inertial, stamp_ns: int) -> None:
        """Publish an autopilot's attitude beside /imu/data; watch and gate use it too."""
        autopilot, now_s = self._connected.autopilot, clock().now_s()
        cycle = autopilot.cycle(frame, now_s) if autopilot is not None else None
        if self._clock_topic is not None:
            self._clock_topic.publish(ClockMessage(clock=conversion.time_message(stamp_ns)))
        if autopilot is None or cycle is None:
            return
        self._gains.cycle(cycle, now_s)
        if autopilot.flight.reference is not None:
            *_, attitude, rates = self._messages.packed(cycle, stamp_ns)
            self._per_cycle[3](attitude)
            self._per_cycle[4](rates)
        if cycle.injection:
            self._applied(self._messages.applied(cycle, stamp_ns))

    def _publish_cycle(self, frame: f.Cycle, stamp_ns: int) -> None:
        bias = self._sensors.stamped(stamp_ns).gyro_bias
        messages = self._messages.packed(frame, stamp_ns, bias)
        for publish, message in zip(self._per_cycle, messages, strict=True):
            publish(message)
        if frame.flags & f.Flag.EXCITATION:
            self._applied(self._messages.applied(frame, stamp_ns))
        if self._clock_topic is not None:
            self._clock_topic.publish(ClockMessage(clock=conversion.time_message(stamp_ns)))

    def _on_described(self, event: Described) -> None:
        self._motors = motor_outputs(
            event.peer.autopilot, self._link.name, event.parameters, self._description.craft
        )
        self._say_once(self._motors.words)
        if self._connected.autopilot is not None:
            self._connected.autopilot.describe(self._motors.craft)
        if self._motors.craft is not None:
            self._description.publish(self._motors.craft)

    def _of_motors(
        self, convert: Callable[[Any, MotorOutputs, int], Any], frame: Any, stamp_ns: int
    ) -> Any:
        """A message by motor; None as long as nobody has said which output is which motor."""
        return convert(frame, self._motors, stamp_ns) if self._motors is not None else None

    # Called in both threads, with the lock held.

    def _poll_gains(self, now_ns: int) -> None:
        self._poll_ns = now_ns + POLL_NS
        if self._connected.has_gains:  # parameters of others are their own, and a thousand
            self._send(self._gains.poll(1e-9 * now_ns))
        self._link.autopilot.log_comes(now=self._logs.coming)
        for frame in [*self._connected.poll(1e-9 * now_ns), *self._logs.poll()]:
            self._link.send(frame)

    def _send(self, frame: f.Frame | None) -> None:
        if frame is not None:
            self._link.send(frame)

    def _flush(self) -> None:
        """Write what the link has to send: the only place that does."""
        outgoing = self._link.to_send()
        if outgoing:
            self._port.write(outgoing)

    # Called in the executor.

    def _on_tick(self) -> None:
        with self._lock:
            aircraft, protocol = self._gains.aircraft, self._gains.protocol
        record = self._history.open(aircraft)
        with self._lock:
            now_ns = clock().now_ns()
            same = self._gains.aircraft == aircraft and self._gains.protocol is protocol
            if record is not None and same:
                self._gains.know(record)
            elif record is not None:
                self._history.leave('')  # another has come while its files were read
            self._link.tick(now_ns)
            self._gains.tick(clock().now_s())
            self._poll_gains(now_ns)
            self._flush()
        self._operator.tick()
        self._gain_services.tick()
        self._sensor_services.tick()
        self._logs.tick()
        with self._lock:
            end = self._relay.tick(clock().now_s())
        if end is not None:
            self._forward(end)
        if self._tell_notes() and clock().now_s() - self._reported_s > REPORT_S:
            self._on_report()

    def _tell_notes(self) -> bool:
        """Log and publish what has happened to the gains; whether anything has."""
        with self._lock:
            notes, self._gains.notes = self._gains.notes, []
        for item in notes:
            self._tell(item)
        return bool(notes)

    def _tell(self, item: Note) -> None:
        if item.fault:
            self.get_logger().error(item.text)
        else:
            self.get_logger().info(item.text)
        if item.active is not None:
            name, now_ns = self.get_fully_qualified_name(), self.get_clock().now().nanoseconds
            self._active.publish(conversion.event_message(
                with_mixing(item.active), name, now_ns))

    def _say_once(self, words: str) -> None:
        if self._limiter.allow(words, clock().now_s()):
            self.get_logger().info(words)

    def _on_craft(self, craft: Craft) -> None:
        """Take the craft that the parameter gives, or another node describes."""
        with self._lock:
            if craft.count == FLOWN:
                self._gains.polarity.craft = craft
            peer, parameters = self._link.peer, self._link.parameters
            if self._motors is not None and peer is not None and parameters is not None:
                self._on_described(Described(peer, parameters.values))

    def _on_segment(self, event: ParameterEvent) -> None:
        values, age_s = conversion.values_of(event.changed_parameters), self._age_s(event.stamp)
        with self._lock:
            end = self._relay.segment(values, age_s, clock().now_s())
            if self._relay.injection:
                self._gains.disturb()
            elif self._gains.state is State.CHECKING:
                end = None
        if end is not None:
            self._forward(end)

    def _on_setpoint(self, message: Vector3Stamped) -> None:
        v = message.vector
        age_s = self._age_s(message.header.stamp)
        with self._lock:
            frame = self._relay.setpoint(v.x, v.y, v.z, clock().now_s(), age_s)
        if frame is not None:
            self._forward(frame)

    def _forward(self, frame: Any) -> None:
        with self._lock:
            self._send(frame)
            self._flush()

    def _on_gains(self, event: ParameterEvent) -> None:
        with contextlib.suppress(RefusedError):  # it is in the news
            values = conversion.values_of(event.changed_parameters)
            self._ask_gains(values, age_s=self._age_s(event.stamp))

    def _age_s(self, stamp: Any) -> float:
        return conversion.age_s(stamp, self.get_clock().now().nanoseconds)

    def _ask_gains(
        self, parameters: Mapping[str, object], reply: Reply | None = None, *, age_s: float = 0.0
    ) -> None:
        """Hand on an update; raises RefusedError."""
        self.refuse_unless_active()
        if self._port.status.state is PortState.BUSY:  # of two bridges the other one has it
            raise RefusedError(f'{self._settings.port} is {PortState.BUSY.value}')
        with self._lock:
            if not self._gains.takes_back(parameters):
                self._refuse(Ability.GAINS)
            words = self._gains.ask(parameters, clock().now_s(), reply, age_s=age_s)
            self._poll_gains(clock().now_ns())
            self._flush()
        self.get_logger().info(words)

    def _refuse(self, ability: Ability) -> None:
        """Raise RefusedError where the aircraft takes no such now."""
        words = self._present().cannot(ability)
        if words:
            self._say_once(words)
            raise RefusedError(words)

    def _standard(self) -> str:
        """Name of an autopilot that sends standard messages only; '' for ours."""
        return self._link.name if self._link.standard_only(clock().now_ns()) else ''

    def _aircraft_folder(self) -> Path | None:
        """Where the files of the connected aircraft are; None while it is not known."""
        name = self._gains.aircraft
        return self._settings.gains.folder / name if name else None

    def _offset_ns(self) -> int | None:
        """ROS time minus the aircraft's own time; None while it is not known."""
        link = self._link
        if link.received_us is None or not link.clock.converged:
            return None
        device_ns = 1000 * link.received_us
        return link.clock.host_ns(device_ns) - device_ns + self._time.epoch_ns

    def _armed(self) -> bool | None:
        with self._lock:
            return self._link.armed_lately(clock().now_ns())

    def _flies(self) -> bool:
        """Whether it may be in the air: armed when last heard, the throttle up or not known."""
        with self._lock:
            last = self._link.last_cycle
            low = last is not None and last.control[0] < LOW_THROTTLE
            return self._link.armed and not low

    def _ask_check(self, reply: Callable[[str], None], motors: bool) -> None:
        """Have the polarity or the motors checked; raises RefusedError."""
        self.refuse_unless_active()
        with self._lock:
            self._refuse(Ability.PULSES)
            self._gains.check(clock().now_s(), reply, motors=motors)

    def _on_report(self) -> None:
        self._keep_epoch()
        self._reported_s = now_s = clock().now_s()
        with self._lock:
            link = self._link
            unset = self._time.epoch_ns == NEVER_NS
            entries = self._report.entries(
                self._port.status, now_s, behind_ns=self._time.behind_ns, unset=unset
            )
            entries += [
                self._gains.status(
                    self._present().cannot(Ability.GAINS) if link.peer else ''),
                self._relay.status(self._connected.last_cycle or link.last_cycle, now_s),
            ]
        log, port = self.get_logger(), self._settings.port
        for entry in self._changes.new(entries[:2], now_s):
            text = f'{port}: {entry.name}: {entry.message}'
            if entry.level == OK:  # rclpy wants one severity for each line of code
                log.info(text)
            else:
                log.warning(text)
        entries += [self._sensors.status(), *self._operator.entries()]
        if self._connected.autopilot is not None:
            entries.append(self._logs.status())
        entries += [*self.bounds(), *self.fence.entries()]
        self._diagnostics.publish(diagnostics.diagnostic_array(self, port, entries))

    def _epoch(self) -> Epoch:
        """ROS time minus the steady clock."""
        ros = self.get_clock()
        if self._simulated and not ros.now().nanoseconds:
            return Epoch(NEVER_NS)
        return read_epoch(lambda: int(ros.now().nanoseconds), clock().now_ns)

    def _keep_epoch(self) -> None:
        if self._simulated:
            self._time.follow(self._epoch().ns)
            return
        words = self._time.measured(*self._epoch(), armed=self._link.armed)
        if words:
            self.get_logger().warning(words)


def main() -> None:
    """Run the node until it is interrupted; exit status 2 where its parameters are wrong."""
    run(SerialBridge, 'serial_bridge')
