"""What is known of an autopilot's flight from its messages, as one control cycle of ours. Pure.

Mode, armed, in the air, attitude, what its loops follow, sticks, battery, place, height; whether
it hovers, and the throttle with which it does. Watch, gate and guard ask here and know no
autopilot. Times are s on a steady clock; vectors FRD and NED, as on the wire.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import starmap

from quad_bridge.link.autopilot import Inertial
from quad_bridge.wire import frames as f
from quad_bridge.wire.axes import angles_of
from quad_bridge.wire.frames import Vector3

FRESH_S = 0.3  # a line whose last attitude is older is stale
BEAT_S = 2.5  # the same of heartbeats, which come once a second
STICKS_S = 1.0  # the same of stick positions, which a slow line brings twice a second
HOVER_S = 2.0  # so long it must have been calm to hover
# calm: below these the autopilot holds it against a breeze, and no pilot is moving it
TILT_RAD, TURN_RAD_S = math.radians(12.0), math.radians(45.0)
CLIMB_M_S, DRIFT_M_S = 0.6, 1.5
ON_GROUND, IN_AIR = 1, 2  # MAV_LANDED_STATE
THRUST_S = 2.0  # over which the hover throttle is averaged
REFERENCE_S = 1.0  # after which what the loops follow is not known any more
STICK = 0.15  # share of its way by which a stick has been moved
POSITION, BAROMETER = 'LOCAL_POSITION_NED', 'the barometer'
GAP_S = 1.0  # without an attitude, behind which rate and calm are measured anew
HEIGHT_S = 1.0  # after which a height is not known any more
BATTERY_S = 5.0  # the same of a voltage, which a slow line brings every other second
METRES_PER_HPA = 8.43  # of the standard atmosphere at sea level
BARO_S = 0.5  # time constant of the pressure: its noise is a metre, a climb lasts seconds
ENOUGH, WINDOW = 100, 250  # arrivals over which their rate is counted
UNKNOWN_THRUST = 0.5  # where nothing says it: it counts as flying while it is in the air


@dataclass
class FlightState:
    """See the module; `take` and `inertial` fill it."""

    mode: int | None = None
    armed: bool = False
    landed: int = 0
    angles: Vector3 | None = None
    rates: Vector3 | None = None
    target: f.AttitudeTarget | None = None
    sticks: tuple[float, ...] = ()  # roll, pitch, throttle, yaw, -1..1
    failsafe: bool = False
    volts: float = math.nan
    volts_s: float = -math.inf
    place: Vector3 | None = None
    speed: Vector3 | None = None
    height_m: float | None = None
    """Above the level of its source: heights of two sources have nothing in common."""
    height_source: str = ''
    climb_m_s: float = 0.0
    beat_s: float = -math.inf
    attitude_s: float = -math.inf
    sticks_s: float = -math.inf
    place_s: float = -math.inf
    height_s: float = -math.inf
    target_s: float = -math.inf
    calm_since_s: float = math.inf
    rate_hz: float = 0.0
    """Measured rate of the attitudes, Hz."""
    cycles: int = 0
    _thrusts: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=WINDOW))
    _arrivals: deque[float] = field(default_factory=lambda: deque(maxlen=WINDOW))
    _level_hpa: float = math.nan
    _baro_s: float = -math.inf

    def take(self, frame: object, now_s: float) -> None:
        """Take a frame that bears on the flight."""
        if isinstance(frame, f.Heartbeat):
            self.mode, self.armed, self.beat_s = frame.custom_mode, frame.armed, now_s
        elif isinstance(frame, f.LandedState):
            self.landed = frame.landed
        elif isinstance(frame, f.AttitudeTarget):
            self.target, self.target_s = frame, now_s
            if self.landed == IN_AIR:
                self._thrusts.append((now_s, frame.thrust))
        elif isinstance(frame, f.RcChannels):
            self._take_sticks(frame, now_s)
        elif isinstance(frame, f.Battery) and math.isfinite(frame.voltage_v):
            self.volts, self.volts_s = frame.voltage_v, now_s
        elif isinstance(frame, f.LocalPosition):
            self.place, self.speed, self.place_s = frame.place, frame.speed, now_s
            self.height_m, self.climb_m_s = -frame.place[2], -frame.speed[2]
            self.height_source, self.height_s = POSITION, now_s
        elif isinstance(frame, f.SlowSensors) and frame.pressure_hpa is not None:
            self._take_pressure(frame.pressure_hpa, now_s)

    def inertial(self, frame: Inertial, now_s: float) -> None:
        """Take an attitude with its rates."""
        if frame.attitude is None or frame.gyro is None:
            return
        if now_s - self.attitude_s > GAP_S:
            self.calm_since_s = math.inf
            self._arrivals.clear()
        self.angles, self.rates, self.attitude_s = frame.attitude, frame.gyro, now_s
        self.cycles += 1
        self._arrivals.append(now_s)
        if len(self._arrivals) >= ENOUGH:
            passed_s = now_s - self._arrivals[0]
            self.rate_hz = (len(self._arrivals) - 1) / passed_s if passed_s > 0.0 else 0.0
        calm = (
            max(map(abs, self.angles[:2])) < TILT_RAD
            and max(map(abs, self.rates)) < TURN_RAD_S
            and abs(self.climb_m_s) < CLIMB_M_S
            and (self.speed is None or math.hypot(*self.speed[:2]) < DRIFT_M_S)
            and self.armed
            and self.landed == IN_AIR
        )
        self.calm_since_s = min(self.calm_since_s, now_s) if calm else math.inf

    def line_fault(self, now_s: float) -> str:
        """Why the line is stale; empty where it is fresh."""
        if now_s - self.attitude_s > FRESH_S:
            return f'the line is stale: no attitude with rates for {FRESH_S:g} s'
        if now_s - self.beat_s > BEAT_S:
            return f'the line is stale: no heartbeat for {BEAT_S:g} s'
        return ''

    def hover_fault(self, now_s: float) -> str:
        """Why it does not hover; empty where it does."""
        if not self.armed:
            return 'it is not armed'
        if self.landed != IN_AIR:
            return 'it is not in the air' if self.landed else 'it does not say that it flies'
        if now_s - self.calm_since_s < HOVER_S:
            return f'it does not hover: {HOVER_S:g} s of calm are needed'
        return ''

    def sticks_fault(self, now_s: float) -> str:
        """Reason why the pilot's sticks are not known; empty where they are."""
        if now_s - self.sticks_s > STICKS_S or len(self.sticks) < 4:
            return "the pilot's sticks are not received"
        return 'the receiver is in failsafe' if self.failsafe else ''

    def moved(self, previous: tuple[float, ...]) -> bool:
        """Whether the pilot has moved a stick since `before`."""
        return any(abs(a - b) > STICK for a, b in zip(self.sticks[:4], previous[:4], strict=False))

    def hover_throttle(self, now_s: float) -> float | None:
        """The mean throttle of the last seconds in the air; None where it is not known."""
        last = [thrust for at_s, thrust in self._thrusts if now_s - at_s < THRUST_S]
        spread = max(last) - min(last) if last else 0.0
        if len(last) < 5 or spread > 0.2:
            return None
        mean = sum(last) / len(last)
        return mean if 0.1 < mean < 0.8 else None

    @property
    def reference(self) -> Vector3 | None:
        """Roll, pitch, yaw that its loops follow, rad."""
        return None if self.target is None else angles_of(self.target.q)

    def cycle(
        self, frame: Inertial, now_s: float, added: Vector3, injection: f.Injection, flags: f.Flag
    ) -> f.Cycle | None:
        """The latest measurements as a control cycle; None without attitude and rates."""
        if frame.gyro is None or frame.attitude is None:
            return None
        target = self.target if now_s - self.target_s < REFERENCE_S else None
        reference = None if target is None else angles_of(target.q)
        thrust = max(target.thrust, 0.0) if target is not None else UNKNOWN_THRUST
        if self.armed:
            flags |= f.Flag.ARMED
        if self.failsafe:
            flags |= f.Flag.RC_FAILSAFE
        flies = self.armed and self.landed != ON_GROUND  # also while it takes off or lands
        return f.Cycle(
            frame.time_us, self.cycles % 2**32, frame.gyro, frame.accel or (0.0, 0.0, -9.81),
            frame.attitude, frame.attitude if reference is None else reference,
            target.rates if target is not None else (0.0, 0.0, 0.0),
            (thrust if flies else 0.0, 0.0, 0.0, 0.0), added, (0.0, 0.0, 0.0, 0.0), int(flags), 0,
            int(injection),
        )

    def _take_sticks(self, frame: f.RcChannels, now_s: float) -> None:
        pulses = frame.channels[:4]
        is_valid = len(pulses) == 4 and all(800 <= pulse <= 2200 for pulse in pulses)
        self.failsafe = not is_valid
        if is_valid:
            self.sticks = tuple((pulse - 1500) / 500.0 for pulse in pulses)
            self.sticks_s = now_s

    def _take_pressure(self, hpa: float, now_s: float) -> None:
        since_s, self._baro_s = now_s - self._baro_s, now_s
        if self.height_source == POSITION and now_s - self.height_s < HEIGHT_S:
            return
        previous = self._level_hpa
        if self.height_source != BAROMETER or since_s > HEIGHT_S:
            self._level_hpa, self.climb_m_s = hpa, 0.0
        elif since_s > 0.0:
            share = min(since_s / BARO_S, 1.0)
            self._level_hpa += share * (hpa - self._level_hpa)
            climb = METRES_PER_HPA * (previous - self._level_hpa) / since_s
            self.climb_m_s += share * (climb - self.climb_m_s)
        self.height_m = -METRES_PER_HPA * self._level_hpa
        self.height_source, self.height_s = BAROMETER, now_s


def wrapped(angles: Iterable[float]) -> Vector3:
    """Differences of angles in -pi..pi."""
    roll, pitch, yaw = starmap(math.remainder, ((a, math.tau) for a in angles))
    return roll, pitch, yaw
