"""One virtual aircraft in memory: its profile's numbers and its state, run cycle by cycle.

Same seed, same inputs, same flight, whether in one call or cycle by cycle. No clock, no I/O.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from quad_bridge.virtual.control import Controller, initial_memory
from quad_bridge.virtual.cycle import (
    NORMALS_PER_CYCLE,
    NORMALS_PER_STEP,
    OBSERVED,
    WIDTH,
    Machine,
    advance_step,
    begin_cycle,
    observe,
    run_cycles,
)
from quad_bridge.virtual.physics import initial_state
from quad_bridge.virtual.plant import build_plant, hover_throttle
from quad_bridge.virtual.profile import Profile
from quad_bridge.virtual.sensors import build_chips, butterworth, initial_sensors

FloatArray = npt.NDArray[np.float64]

EffectFunction = Callable[[float, FloatArray, FloatArray, FloatArray, float], FloatArray]
"""effect(t_s, rates, angles, thrusts, battery_v) -> extra body torque (3,) in N m."""

BLOCK_CYCLES = 2000


class Aircraft:
    """The machine of compiled states with its random numbers and, if any, a Python effect."""

    def __init__(
        self, profile: Profile, *, seed: int, effect: EffectFunction | None = None
    ) -> None:
        firmware = profile.firmware
        self.profile = profile
        self.cycle_s = 1.0 / firmware.rate_hz
        self._steps = firmware.physics_steps_per_cycle
        self._effect = effect
        self._rng = np.random.default_rng(seed)
        self._cycle = 0
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
        running = self.hover_throttle if firmware.auto_arm else 0.0
        bias = profile.sensors.gyro_calibration_error_rad_s * self._rng.standard_normal(3)
        start = profile.airframe.battery.start_charge
        self.machine = Machine(
            plant=plant,
            chips=chips,
            controller=_controller(profile),
            state=initial_state(start, plant.capacity_as, running),
            sensed=initial_sensors(chips, bias),
            memory=initial_memory(running),
            acting=np.full(4, running),
        )

    @property
    def cycle(self) -> int:
        """Number of the coming control cycle, from 0."""
        return self._cycle

    @property
    def gains(self) -> FloatArray:
        """(3, n) SI gains in use, written in place (columns: gain_columns.py)."""
        return self.machine.controller.gains

    @property
    def gyro_filter_hz(self) -> float:
        """Cut-off of the gyro's filter at boot."""
        return self.profile.sensors.gyro_filter_hz

    def set_filters(self, gyro_hz: float, accel_hz: float) -> None:
        """Change the chip's filters in flight."""
        step_s = self.machine.plant.step_s
        self.machine.chips.gyro_lp[:] = butterworth(gyro_hz, step_s)
        self.machine.chips.accel_lp[:] = butterworth(accel_hz, step_s)

    def run(self, given: FloatArray) -> FloatArray:
        """Fly the cycles whose inputs are `given` (n, INPUTS); returns the log (n, WIDTH)."""
        log = np.zeros((given.shape[0], WIDTH))
        width = NORMALS_PER_CYCLE + self._steps * NORMALS_PER_STEP
        for start in range(0, given.shape[0], BLOCK_CYCLES):
            block = slice(start, min(start + BLOCK_CYCLES, given.shape[0]))
            normals = self._rng.standard_normal((block.stop - start, width))
            if self._effect is None:
                run_cycles(self.machine, self._cycle, given[block], normals, log[block])
            else:
                for row in range(block.stop - start):
                    self._stepwise(row, given[block][row], normals[row], log[block][row])
            self._cycle += block.stop - start
        return log

    def _stepwise(self, row: int, given: FloatArray, normals: FloatArray, log: FloatArray) -> None:
        """One cycle with the Python effect called before every physics step."""
        begin_cycle(self.machine, self._cycle + row, given, normals[:NORMALS_PER_CYCLE], log)
        for step in range(self._steps):
            start = NORMALS_PER_CYCLE + step * NORMALS_PER_STEP
            extra = self._extra_torque()
            advance_step(self.machine, normals[start : start + NORMALS_PER_STEP], extra)

    def _extra_torque(self) -> FloatArray:
        """What the Python effect returns for the present state."""
        if self._effect is None:
            return np.zeros(3)
        seen = np.empty(OBSERVED)
        observe(self.machine, seen)
        return self._effect(float(seen[0]), seen[1:4], seen[4:7], seen[7:11], float(seen[11]))


def _controller(profile: Profile) -> Controller:
    """The control cycle's constants."""
    firmware, pilot = profile.firmware, profile.pilot
    free = 1.0 if profile.mount == 'hover' else 0.0
    return Controller(
        gains=firmware.gains.table(),
        cycle_s=1.0 / firmware.rate_hz,
        delay_cycles=firmware.delay_cycles,
        stick_angle=math.radians(firmware.stick_angle_deg),
        stick_yaw_rate=math.radians(firmware.stick_yaw_rate_deg_s),
        angle_limit=math.radians(firmware.angle_limit_deg),
        climb_kp=free * pilot.climb_kp_per_m,
        climb_kd=free * pilot.climb_kd_s_per_m,
    )
