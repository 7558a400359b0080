"""One virtual aircraft in memory: its profile's numbers and its state, run cycle by cycle.

The same seed and inputs give the same flight, in one call or cycle by cycle. No clock, no I/O. The
firmware in its memory flies it (`run`), or another one (`measure`, `move`).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping

import numpy as np

from quad_bridge.gains.table import AXES, ROWS, split
from quad_bridge.si import FloatArray
from quad_bridge.virtual import hil
from quad_bridge.virtual.cycle import (
    MAX_DELAY,
    NORMALS_PER_CYCLE,
    NORMALS_PER_STEP,
    OBSERVED,
    WIDTH,
    Machine,
    advance_step,
    begin_cycle,
    measure_cycle,
    move_cycle,
    observe,
    run_cycles,
)
from quad_bridge.virtual.errors import ConfigurationError
from quad_bridge.virtual.native import NativeFirmware
from quad_bridge.virtual.physics import initial_state
from quad_bridge.virtual.plant import build_plant, hover_throttle
from quad_bridge.virtual.profile import Profile
from quad_bridge.virtual.receiver import Channels
from quad_bridge.virtual.sensors import MAG, PRESSURE, SAMPLES, build_chips, initial_sensors

EffectFunction = Callable[[float, FloatArray, FloatArray, FloatArray, float], FloatArray]
"""effect(t_s, rates, angles, thrusts, battery_v) -> extra body torque (3,) in N m."""

BLOCK_CYCLES = 2000
WAITING_THROTTLE = 0.03
"""The pilot's throttle, 0..1, while no motor turns: low enough to be armed."""


class Aircraft:
    """The compiled states with their random numbers and, if any, a Python effect."""

    def __init__(
        self, profile: Profile, *, seed: int, effect: EffectFunction | None = None
    ) -> None:
        firmware = profile.firmware
        self.profile = profile
        self.cycle_s = 1.0 / firmware.rate_hz
        self._steps = firmware.physics_steps_per_cycle
        self._effect = effect
        self._rng = np.random.default_rng(seed)
        self.cycle = 0  # number of the coming control cycle
        phases = self._rng.uniform(0.0, 2.0 * math.pi, 1 + 16)
        step_s = self.cycle_s / self._steps
        plant = build_plant(
            profile.airframe,
            profile.effects,
            mount=profile.mount,
            axis=profile.axis,
            step_s=step_s,
            phase=float(phases[0]),
        )
        chips = build_chips(
            profile.sensors,
            profile.effects.vibration,
            step_s=step_s,
            cycle_s=self.cycle_s,
            phases=phases[1:],
        )
        self.hover_throttle = hover_throttle(profile.airframe, plant)
        self._divider = profile.sensors.battery_divider
        self._turning = firmware.auto_arm
        running = self.hover_throttle if firmware.auto_arm else 0.0
        bias = profile.sensors.gyro_calibration_error_rad_s * self._rng.standard_normal(3)
        start = profile.airframe.battery.start_charge
        sensed, samples = initial_sensors(chips, bias, self._steps)
        self.firmware = NativeFirmware(boot(profile).frame())
        """The firmware in memory, for `run`."""
        free = 1.0 if profile.mount == 'hover' else 0.0
        self.machine = Machine(
            plant=plant,
            chips=chips,
            delay_cycles=firmware.delay_cycles,
            climb_kp=free * profile.pilot.climb_kp_per_m,
            climb_kd=free * profile.pilot.climb_kd_s_per_m,
            state=initial_state(start, plant.capacity_as, running),
            sensed=sensed,
            samples=samples,
            queue=np.full((MAX_DELAY + 1, 4), running),
            acting=np.full(4, running),
            firmware=self.firmware.memory,
            gains=self.firmware.gains(),
        )
        self._normals = np.empty(0)

    @property
    def gains(self) -> dict[str, float]:
        """The parameters that `run` flies with, by the contract's names, SI."""
        return dict(zip(ROWS, map(float, self.machine.gains), strict=True))

    def set_gains(self, gains: Mapping[str, float]) -> None:
        """Change gains without the firmware's bounds; ConfigurationError for an unknown name."""
        for name, value in gains.items():
            if name not in ROWS:
                raise ConfigurationError('gains', 'unknown name', name)
            self.machine.gains[list(ROWS).index(name)] = value

    def measure(self, channels: Channels) -> bytes:
        """The firmware's measurements at the start of the next cycle, as a frame of hil.py."""
        machine = self.machine
        width = NORMALS_PER_CYCLE + self._steps * NORMALS_PER_STEP
        self._normals = self._rng.standard_normal(width)
        trim = self.hover_throttle if channels.throttle is None else channels.throttle
        values = np.empty(2)
        measure_cycle(machine, self.cycle, trim, self._normals[:NORMALS_PER_CYCLE], values)
        throttle, volts = map(float, values)
        if channels.hold:
            throttle = trim
        elif channels.throttle is None and not self._turning:
            throttle = WAITING_THROTTLE
        pulses = [
            1000.0 + 1000.0 * value if i == 2 else 1500.0 + 500.0 * value
            for i, value in enumerate(channels.axes(throttle))
        ]
        sensed = machine.sensed
        slow = (
            volts / self._divider, *(1e4 * sensed[MAG : MAG + 3]), sensed[PRESSURE] / 100.0,
            math.nan,
        )  # fmt: skip
        samples = machine.samples[: int(sensed[SAMPLES])]
        return hil.sensors(self.time_us, pulses, channels.failsafe, slow, samples)

    def move(self, motors: hil.Motors) -> None:
        """Apply these motor commands and run the physics to the next cycle."""
        steps = self._normals[NORMALS_PER_CYCLE:]
        compiled = steps if self._effect is None else steps[:0]
        move_cycle(self.machine, self.cycle, np.array(motors.commands), compiled)
        if self._effect is not None:
            self._effect_steps(self._effect, steps)
        self.cycle += 1
        self._turning = any(motors.commands)

    @property
    def time_us(self) -> int:
        """Device time of the coming cycle."""
        return round(self.cycle * self.cycle_s * 1e6)

    def run(self, inputs: FloatArray) -> FloatArray:
        """Fly the cycles with these inputs (n, INPUTS); returns the log (n, WIDTH)."""
        log = np.zeros((inputs.shape[0], WIDTH))
        width = NORMALS_PER_CYCLE + self._steps * NORMALS_PER_STEP
        for start in range(0, inputs.shape[0], BLOCK_CYCLES):
            block = slice(start, min(start + BLOCK_CYCLES, inputs.shape[0]))
            normals = self._rng.standard_normal((block.stop - start, width))
            if self._effect is None:
                run_cycles(self.machine, self.cycle, inputs[block], normals, log[block])
            else:
                rows = zip(inputs[block], normals, log[block], strict=True)
                for cycle, (row, noise, out) in enumerate(rows, self.cycle):
                    begin_cycle(self.machine, cycle, row, noise[:NORMALS_PER_CYCLE], out)
                    self._effect_steps(self._effect, noise[NORMALS_PER_CYCLE:])
            self.cycle += block.stop - start
        return log

    def _effect_steps(self, effect: EffectFunction, normals: FloatArray) -> None:
        """Physics steps, before each of which the Python effect says its torque."""
        for start in range(0, normals.size, NORMALS_PER_STEP):
            values = np.empty(OBSERVED)
            observe(self.machine, values)
            extra = effect(float(values[0]), values[1:4], values[4:7], values[7:11],
                           float(values[11]))
            advance_step(self.machine, normals[start : start + NORMALS_PER_STEP], extra)


def boot(profile: Profile, *, lockstep: bool = True) -> hil.Boot:
    """The settings with which the firmware flies this profile."""
    firmware, sensors = profile.firmware, profile.sensors
    settings = {
        'receiver.arm_channel': 0.0,  # it is armed by the bridge, or from the start
        'receiver.hold_channel': 8.0,
        **firmware.gains,
        'sensor.gyro_filter_hz': sensors.gyro_filter_hz,
        'sensor.accel_filter_hz': sensors.accel_filter_hz,
    }
    gains = []
    for name, row in ROWS.items():
        start = row.start[AXES.index(split(name)[0]) if len(row.start) > 1 else 0]
        value = float(np.float32(settings.get(name, start)))
        lowest, highest = row.limits or (value, value)
        if not np.float32(lowest) <= value <= np.float32(highest):
            what = f'the firmware accepts {lowest:g} to {highest:g}'
            raise ConfigurationError(f'profile: {name}', what, f'{value:g}')
        gains.append(value)
    return hil.Boot(
        aircraft=aircraft_number(profile),
        rate_hz=int(firmware.rate_hz),
        armed=firmware.auto_arm,
        may_arm=True,
        samples=firmware.physics_steps_per_cycle,
        lockstep=lockstep,
        stick_angle=math.radians(firmware.stick_angle_deg),
        stick_yaw_rate=math.radians(firmware.stick_yaw_rate_deg_s),
        angle_limit=math.radians(firmware.angle_limit_deg),
        low_battery_v=firmware.low_battery_v,
        complementary_s=sensors.complementary_time_s,
        declination=math.atan2(sensors.mag_field_t[0], sensors.mag_field_t[1]),
        gains=gains,
    )


def aircraft_number(profile: Profile) -> int:
    """Unique number of an airframe, 64 bits as of an STM32; the same on any mount."""
    digest = hashlib.blake2b(repr(profile.airframe).encode(), digest_size=8).digest()
    return int.from_bytes(digest, 'little')
