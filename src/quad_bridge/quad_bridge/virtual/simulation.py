"""For tests, benchmarks and tools only: whole flights as arrays, faster than real time.

The aircraft and firmware of virtual_stm32 without its process. No node or command imports this.
Nothing here writes files; tools/flight.py makes a bag of a flight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from quad_bridge.gains.table import AXES
from quad_bridge.si import FloatArray
from quad_bridge.virtual.aircraft import Aircraft, EffectFunction
from quad_bridge.virtual.cycle import (
    ADDED,
    ARMED,
    COLUMNS,
    HOLD,
    INJECTION,
    INPUTS,
    STICK_PITCH,
    STICK_ROLL,
    STICK_YAW,
    THROTTLE,
)
from quad_bridge.virtual.profile import Profile, load_profile
from quad_bridge.virtual.receiver import channels_at

if TYPE_CHECKING:
    from collections.abc import Mapping


INJECTIONS = ('none', 'attitude', 'rate', 'control', 'thrust')


@dataclass(frozen=True)
class Excited:
    """One scheduled segment: `samples` (n,) per control cycle from `start_s` on, on one axis."""

    start_s: float
    samples: FloatArray
    axis: str = 'roll'
    injection: str = 'attitude'
    role: str = 'train'
    signal: str = 'prbs'
    parameters: Mapping[str, float | int | str] = field(default_factory=dict)


@dataclass(frozen=True)
class Flight:
    """A flown flight; arrays have one row per control cycle, SI, body FLU, world ENU."""

    profile: Profile
    schedule: tuple[Excited, ...]
    gains: Mapping[str, float]  # what /gains/active would say, at the start
    time_s: FloatArray
    rates: FloatArray
    acceleration: FloatArray
    angles: FloatArray
    attitude_setpoint: FloatArray
    rate_setpoint: FloatArray
    wrench: FloatArray
    motors: FloatArray
    excitation: FloatArray
    injection: npt.NDArray[np.int64]
    battery_v: FloatArray
    mag: FloatArray
    pressure_pa: FloatArray
    throttle: FloatArray
    limits: FloatArray
    true_rates: FloatArray
    true_angles: FloatArray
    position_m: FloatArray
    velocity_m_s: FloatArray
    height_m: FloatArray  # as the firmware estimates it, with its climb
    climb_m_s: FloatArray

    @property
    def dt(self) -> float:
        """Control cycle, s."""
        return 1.0 / self.profile.firmware.rate_hz


def fly(
    config: Profile | str,
    schedule: Sequence[Excited],
    duration_s: float,
    seed: int,
    effect: EffectFunction | None = None,
    gains: Mapping[str, float] | None = None,
) -> Flight:
    """Fly `config` (profile or its name) over the schedule; `gains` (SI) replace the profile's.

    The same seed gives the same flight, bit for bit. `effect` as in aircraft.py.
    """
    profile = load_profile(config) if isinstance(config, str) else config
    aircraft = Aircraft(profile, seed=seed, effect=effect)
    aircraft.set_gains({k: v for k, v in (gains or {}).items() if not k.startswith('loop.')})
    count = round(duration_s * profile.firmware.rate_hz)
    active = aircraft.gains
    values = inputs(aircraft, schedule, count)
    log = aircraft.run(values)
    arrays = {
        name: log[:, span] if span.stop - span.start > 1 else log[:, span.start]
        for name, span in COLUMNS.items()
    }
    return Flight(
        profile=profile,
        schedule=tuple(schedule),
        gains=active,
        excitation=values[:, ADDED : ADDED + 3],
        injection=values[:, INJECTION].astype(np.int64),
        **arrays,
    )


def inputs(aircraft: Aircraft, schedule: Sequence[Excited], count: int) -> FloatArray:
    """The inputs (count, INPUTS) of all cycles: the receiver's script and the excitation."""
    profile = aircraft.profile
    values = np.zeros((count, INPUTS))
    script, times = profile.receiver, np.arange(count) * aircraft.cycle_s
    marks = sorted({0.0, *(event.time_s for event in script.events)})
    armed = profile.firmware.auto_arm
    for mark in marks:
        channels, rows = channels_at(script, mark), times >= mark - 1e-9
        armed = armed and not channels.kill  # nobody arms it again
        values[rows, ARMED] = float(armed)
        throttle = channels.throttle
        values[rows, THROTTLE] = aircraft.hover_throttle if throttle is None else throttle
        values[rows, HOLD] = float(channels.hold)
        sticks = (channels.roll, channels.pitch, channels.yaw)
        for column, stick in zip((STICK_ROLL, STICK_PITCH, STICK_YAW), sticks, strict=True):
            values[rows, column] = 0.0 if channels.failsafe else stick
    for part in schedule:
        start = round(part.start_s / aircraft.cycle_s)
        stop = min(count, start + part.samples.size)
        climbs = part.axis == 'climb'
        values[start:stop, INJECTION] = INJECTIONS.index(
            'thrust' if climbs else part.injection)
        column = 2 if climbs else AXES.index(part.axis)
        values[start:stop, ADDED + column] = part.samples[: stop - start]
    return values
