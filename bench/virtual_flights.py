"""What the benchmarks fly on the virtual STM32: a plan of segments, and the flight's record."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from quad_bridge.virtual.simulation import Excited
from quad_sysid.signals.waveforms import prbs

sys.path.append(str(Path(__file__).resolve().parents[1] / 'tools'))
from flight import record_of

__all__ = ['AMPLITUDE', 'PLAN', 'RATE_HZ', 'START_S', 'record_of', 'schedule_of']

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
