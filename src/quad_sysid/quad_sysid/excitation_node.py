"""The `excitation` node: plays a schedule on /excitation/setpoint, watched by the guard.

Wiring only: signals, limits and states are in signals/, parameters in excitation_settings.py.
"""

from __future__ import annotations

import math
import re
from collections import deque
from dataclasses import replace
from pathlib import Path
from typing import Any

from ament_index_python.packages import get_package_share_directory
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Vector3Stamped
from rcl_interfaces.msg import ParameterEvent
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import BatteryState, Imu, Joy
from std_srvs.srv import Trigger

from quad_bridge.errors import QuadBridgeError
from quad_bridge.lockstep import clock, patience
from quad_bridge.nodes import ros_node
from quad_bridge.nodes.conversion import event_message
from quad_bridge.nodes.diagnostics import diagnostic_array
from quad_bridge.nodes.fence import Fence
from quad_bridge.nodes.managed_node import answered
from quad_bridge.nodes.node_time import TimedNode, nanoseconds
from quad_bridge.nodes.qos import EVENT, HEARD, STATE, STREAM
from quad_bridge.status import ERROR, OK, WARN, Status
from quad_sysid.bags.cdr import IMU, decode
from quad_sysid.bags.orientation import euler_angles
from quad_sysid.errors import QuadSysidError
from quad_sysid.excitation_settings import (
    ABORT_AUX,
    NUMBERS,
    Settings,
    find_schedule,
    settings_from,
)
from quad_sysid.signals.guard import Readings, Stall
from quad_sysid.signals.player import Player, State, Tick

LEAVE_S = 0.5
"""Longest wait for the last messages at the end, s."""
RELAY, FLAGS, REFUSED = ': excitation', 'flags of the STM32', 'excitation_refused'
"""How the bridge reports on /diagnostics that the STM32 refuses."""
REFUSAL_S = 0.5
"""After the beginning of a segment, s: an older refusal may still be reported."""
FIGURE = re.compile(r'\d+\.\d+')
"""An age or a voltage in a reason, which changes all the time."""
LEVELS = {State.ENDING: WARN, State.ABORTED: ERROR}


class ExcitationNode(TimedNode, Node):  # type: ignore[misc]
    """Topics, services and timers around one Player."""

    def __init__(self) -> None:
        super().__init__('excitation')
        self.keep_time()
        self.fence = Fence(self.get_logger().error, then=self._fail)
        try:
            self._settings = declare(self)
        except QuadSysidError as error:
            raise QuadBridgeError(str(error)) from error
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._pace = self.get_clock() if self.simulated else steady  # it is not set back in flight
        settings = self._settings
        self._player = Player(settings.schedule, settings.limits, settings.ramp_out_s)
        self._setpoint = self.create_publisher(Vector3Stamped, 'excitation/setpoint', STREAM)
        self._segment = self.create_publisher(ParameterEvent, 'excitation/segment', STATE)
        self._diagnostics = self.create_publisher(DiagnosticArray, 'diagnostics', EVENT)
        self._announced: list[int] = []  # stamps, ns, of those that have not come back
        self._started_ns = 0
        self._message = Vector3Stamped()
        self._message.header.frame_id = 'base_link'
        self._imu: bytes = b''
        self._angles: tuple[float, float, float] | None = None
        self._imu_time = self._rc_time = self._volts_time = 0.0
        self._rc = Readings()
        self._refusal, self._began_s = '', 0.0
        self._volts: deque[float] = deque(maxlen=5)  # the highest counts, a dip is not low
        self._ticks = 0
        self._stall = Stall(1.0 / settings.rate_hz)
        self._waiting = settings.autostart
        self._refused = ''
        self._excites = False  # nothing can be refused while nothing is sent
        sensor = qos_profile_sensor_data
        self.create_subscription(Imu, 'imu/data', self._on_imu, sensor, raw=True)
        self.create_subscription(Joy, 'rc/in', self._on_rc, sensor)
        self.create_subscription(BatteryState, 'battery', self._on_battery, sensor)
        self.create_subscription(DiagnosticArray, 'diagnostics', self._on_diagnostics, EVENT)
        self.create_subscription(ParameterEvent, 'excitation/segment', self._on_segment, HEARD)
        self.create_service(Trigger, '~/start', self._on_start)
        self.create_service(Trigger, '~/stop', self._on_stop)
        period_s = 1.0 / settings.rate_hz
        self._timer = self.create_timer(period_s, self._tick, clock=self._pace)
        self._timer.cancel()
        self.create_timer(1.0, self._report, clock=steady)
        self.create_timer(0.1, self._try_autostart, clock=self._pace)
        self.get_logger().info(
            f'{settings.schedule.source}: {len(settings.schedule.parts)} segments, '
            f'{settings.schedule.duration_s:.0f} s, mount {settings.schedule.mount}'
        )

    @property
    def exit_status(self) -> int | None:
        """Exit status of the process; None: continue."""
        if not self._settings.exit_when_done or self._player.active:
            return None
        return {State.DONE: 0, State.ABORTED: 1}.get(self._player.state)

    def _on_imu(self, raw: bytes) -> None:
        self._imu, self._imu_time = raw, self._stall.awake_s(clock().now_s())

    def _on_rc(self, message: Any) -> None:
        axes, switch = message.axes, self._settings.abort_axis
        self._rc = Readings(
            sticks=(axes[0], axes[1], axes[3]) if len(axes) > 3 else None,
            abort_switch=axes[switch] if switch is not None and switch < len(axes) else None,
            failsafe=bool(len(message.buttons) and message.buttons[0]),
        )
        self._rc_time = self._stall.awake_s(clock().now_s())

    def _on_battery(self, message: Any) -> None:
        if math.isfinite(message.voltage):
            self._volts.append(message.voltage)
            self._volts_time = self._stall.awake_s(clock().now_s())

    def _on_diagnostics(self, message: Any) -> None:
        """Note that the STM32 refuses; what it refused before this segment counts no more."""
        if self._excites and clock().now_s() - self._began_s > REFUSAL_S:
            self._refusal = self._refusal or next((
                pair.value for status in message.status for pair in status.values
                if status.name.endswith(RELAY) and pair.key == FLAGS and REFUSED in pair.value
            ), '')

    def _on_segment(self, message: Any) -> None:
        """End where another node excites: it was not discovered yet when the later one began.

        Once they hear each other the earlier one ends, however long that took; what was said
        before the start, as in a bag, does not count.
        """
        stamp = nanoseconds(message.stamp)
        if stamp in self._announced:
            self._announced.remove(stamp)  # its own comes once: another's may have the same
        elif stamp >= self._started_ns:
            self._fail(f'another node publishes {self._segment.topic_name} too: end it first')

    def _readings(self, *, decode_angles: bool) -> Readings:
        """Latest values for the guard."""
        now = self._stall.awake_s(clock().now_s())
        if decode_angles and self._imu:
            angles = euler_angles(decode(IMU, [self._imu]).values[:, :5]).tolist()
            self._angles = tuple(angles[0]) if angles else None
        return replace(self._rc, imu_age_s=now - self._imu_time if self._imu else None,
                       angles=self._angles,
                       rc_age_s=now - self._rc_time if self._rc_time else None,
                       battery_v=max(self._volts) if self._volts else None,
                       battery_age_s=now - self._volts_time if self._volts else None,
                       refused=self._refusal)

    def _now_s(self) -> float:
        """The schedule's time."""
        return float(self._pace.now().nanoseconds) * 1e-9

    def _start(self) -> str:
        if not self._now_s():
            return 'time is simulated, and nothing comes on /clock'
        if not self._player.active:
            self._refusal = ''
            topic = self._setpoint.topic_name
            if self.count_publishers(topic) > 1:
                return (f'another node publishes {topic} too: end it first, or wait until '
                        'the end of a killed one is noticed')
        began_s = clock().now_s()  # the first decoding takes its time, and so may the first tick
        reason = self._player.start(self._now_s(), self._readings(decode_angles=True))
        if not reason:
            self._began_s, self._started_ns = began_s, self.get_clock().now().nanoseconds
            self._stall.begin(began_s)
            self._timer.reset()
            self.get_logger().info('excitation runs')
            self._report()
        return reason

    def _try_autostart(self) -> None:
        if self._waiting:
            before, self._refused = self._refused, self._start()
            self._waiting = bool(self._refused)
            if FIGURE.sub('', self._refused) not in {'', FIGURE.sub('', before)}:
                self.get_logger().info(f'waits to start: {self._refused}')

    def _on_start(self, request: Any, response: Any) -> Any:
        del request
        reason = self._start()
        if reason:
            self.get_logger().warning(f'not started: {reason}')
        return answered(response, not reason, reason or 'started; /diagnostics says if the '
                        'aircraft refuses it')

    def _on_stop(self, request: Any, response: Any) -> Any:
        del request
        runs = self._player.active
        self._waiting = False
        self._player.stop(self._now_s(), 'stopped by ~/stop')
        return answered(response, runs, 'ramping out' if runs else 'nothing runs')

    def _tick(self) -> None:
        stamp = self.get_clock().now().nanoseconds
        self._ticks += 1
        self._stall.tick(clock().now_s())  # first: what waits to be received is not old
        every = max(1, self._settings.rate_hz // 50)  # 50 times a second or more
        readings = self._readings(decode_angles=self._ticks % every == 0)
        if self._stall.stood_still_s:
            self.get_logger().warning(
                f'this node stood still for {self._stall.stood_still_s:.2f} s: the host is busy'
            )
        previous = self._player.state
        self._publish(self._player.tick(self._now_s(), readings), stamp)
        if self._player.state is not previous:
            self._on_state()

    def _publish(self, tick: Tick, stamp: int) -> None:
        if tick.announcement is not None:
            self._began_s = clock().now_s()
            self._excites = tick.announcement['signal'] != 'none'
            self._announced.append(stamp)
            self._segment.publish(event_message(tick.announcement, '/excitation', stamp))
        if tick.setpoint is not None:
            message = self._message
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 1_000_000_000)
            message.vector.x, message.vector.y, message.vector.z = tick.setpoint
            self._setpoint.publish(message)

    def close(self) -> None:
        """End a running excitation at once, and wait until that is delivered."""
        self._cut('the node ends')
        remaining = Duration(seconds=min(patience(LEAVE_S), 60.0))
        for publisher in (self._segment, self._setpoint, self._diagnostics):
            publisher.wait_for_all_acked(remaining)

    def _cut(self, reason: str) -> None:
        self._publish(self._player.cut(reason), self.get_clock().now().nanoseconds)

    def _fail(self, fault: str) -> None:
        """End the excitation at once."""
        if self._player.active:
            self._cut(fault)
            self._on_state()

    def _on_state(self) -> None:
        """Publish the reason for a change of state at once."""
        player = self._player
        if player.state is State.DONE:
            self.get_logger().info(player.reason)
        else:
            self.get_logger().error(f'excitation {player.state.value}: {player.reason}')
        if not player.active:
            self._timer.cancel()
        self._report()

    def _report(self) -> None:
        player, schedule = self._player, self._settings.schedule
        part = schedule.parts[player.part] if player.part is not None else None
        waiting = f'waits: {self._refused}' if self._waiting and self._refused else ''
        level = WARN if waiting else LEVELS.get(player.state, OK)
        values = {'state': player.state.value, 'reason': player.reason or waiting,
                  'schedule': schedule.source, 'segment': part.role if part else 'idle',
                  'signal': part.signal if part else 'none', 'axis': part.axis if part else '',
                  'elapsed_s': f'{player.elapsed_s:.1f}',
                  'duration_s': f'{schedule.duration_s:.1f}',
                  'progress_pct': f'{100.0 * player.elapsed_s / schedule.duration_s:.0f}',
                  **entries(self._settings)}
        status = Status('schedule', level, player.reason or waiting or player.state.value, values)
        self._diagnostics.publish(diagnostic_array(self, '', [status]))


def entries(settings: Settings) -> dict[str, str]:
    """Diagnostics: what is flown and what ends it."""
    return {
        'axes': ' '.join(dict.fromkeys(
            part.axis for part in settings.schedule.parts if part.role == 'train'
        )),
        'train_s': f'{settings.schedule.training_s:g}',
        'angle_limit_deg': f'{math.degrees(settings.limits.angle_rad):g}',
        'battery_min_v': f'{settings.limits.battery_min_v:g}',
    }


def declare(node: Any) -> Settings:
    """Declare and read the parameters; raises BadInputError naming the file or parameter."""
    ros_node.refuse_unknown(node, [*NUMBERS, 'autostart', 'exit_when_done', 'schedule', 'rate_hz',
                                   'abort_aux'])
    name = ros_node.declared(node, 'schedule', 'schedule_rig',
                             'YAML file, or the name of a shipped schedule')
    autostart = ros_node.declared(node, 'autostart', False, 'start as soon as the guard lets it')
    exit_when_done = ros_node.declared(node, 'exit_when_done', False,
                                       'end the process with the schedule (status 0 done, 1 not)')
    rate_hz = ros_node.declared(node, 'rate_hz', 250, 'set-points per second', (10, 1000))
    aux = ros_node.declared(node, 'abort_aux', ABORT_AUX,
                            "channel aux 1..5 of the pilot's abort switch; 0: none", (0, 5))
    numbers = {key: ros_node.declared(node, key, default, description, (low, high))
               for key, (default, low, high, description) in NUMBERS.items()}
    share = lambda: Path(get_package_share_directory('quad_sysid'))  # noqa: E731
    return settings_from(find_schedule(name, share), numbers, aux, rate_hz, autostart=autostart,
                         exit_when_done=exit_when_done)


def main() -> None:
    """Spin until interrupted or, with exit_when_done, until the schedule has ended.

    Exit status 2 with one line where a parameter or the schedule is wrong.
    """
    ros_node.run(ExcitationNode, 'excitation')
