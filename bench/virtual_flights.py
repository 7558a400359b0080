"""What the benchmarks fly on the virtual STM32: a plan of segments, and the flight's record."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quad_bridge.virtual.simulation import Excited, Flight
from quad_sysid.contract import control_from_motors
from quad_sysid.record import GainChange, Record, Segment
from quad_sysid.signals.waveforms import prbs

RATE_HZ = 250.0
AMPLITUDE = float(np.deg2rad(12.0))
START_S = 3.0
PLAN = (('train', 'prbs', 40.0), ('validation', 'prbs', 18.0), ('validation', 'square', 16.0))


def schedule_of(
    axis: str, plan: Sequence[tuple[str, str, float]], seed: int
) -> tuple[list[Excited], float]:
    """The plan's set-points (role, signal, s) with pauses of 2 s, and when the flight ends, s."""
    out: list[Excited] = []
    time = START_S
    for number, (role, signal, seconds) in enumerate(plan):
        n = round(seconds * RATE_HZ)
        if signal == 'square':
            samples = AMPLITUDE * np.where((np.arange(n) // 375) % 2 == 0, 1.0, -1.0)
        else:
            wave = prbs(9, 23, AMPLITUDE, 1 + (13 * seed + 101 * number) % 510)
            samples = np.resize(wave, n)
        out.append(Excited(time, samples, axis, 'attitude', role, signal))
        time += seconds + 2.0
    return out, time


def record_of(flight: Flight) -> Record:
    """The flight as the analysis gets it from a bag."""
    segments: list[Segment] = []
    time = 0.0
    for part in flight.schedule:
        segments.append(Segment('idle', 'none', part.axis, part.injection, time, part.start_s))
        time = part.start_s + part.samples.size * flight.dt
        segments.append(
            Segment(part.role, part.signal, part.axis, part.injection, part.start_s, time)
        )
    return Record(
        source='simulated', dt=flight.dt, rates=flight.rates,
        control=control_from_motors(flight.motors), angles=flight.angles, motors=flight.motors,
        wrench=flight.wrench, attitude_setpoint=flight.attitude_setpoint,
        rate_setpoint=flight.rate_setpoint, battery_v=flight.battery_v,
        segments=tuple(segments), gains=(GainChange(0.0, dict(flight.gains)),),
    )
