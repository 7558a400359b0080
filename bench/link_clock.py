"""Stamps against the true device time: drift, stalls, asymmetry, jitter, wrap, restart, jumps.

    python bench/link_clock.py --minutes 20

At the level of numbers, faster than time: a device whose clock drifts answers TIMESYNC over a line
with delays, the bridge's stamping stamps 250 cycles a second. Cycles before convergence are held
back. `late ms` is the longest time from a cycle's begin to its stamp. The last line is one JSON
object.
"""

from __future__ import annotations

import argparse
import json
import math

import numpy as np

from quad_bridge.link.stamping import Stamping
from quad_bridge.wire.frames import Cycle

OFFSET_NS = 1_700_000_000_000_000_000
CYCLE_S = 0.004
ZERO = (0.0, 0.0, 0.0)


class World:
    """True time is the host's, in s; the device counts from its last start."""

    def __init__(self, case: dict[str, float], seed: int) -> None:
        self.case, self.rng = case, np.random.default_rng(seed)
        self.zero_s = 0.0
        self.bits = int(case.get('bits', 64))
        self.begin_s = float(case.get('device_begin_s', 0.0))

    def device_us(self, at_s: float) -> int:
        wander = self.case.get('wander_ppm', 0.0) * 1e-6
        # the drift itself wanders with temperature, a period of ten minutes
        slow = wander * 600.0 / math.tau * (1.0 - math.cos(math.tau * at_s / 600.0))
        passed = (at_s - self.zero_s) * (1.0 + self.case['drift_ppm'] * 1e-6) + slow
        return int(1e6 * (passed + self.begin_s)) % (1 << self.bits)

    def delays(self) -> tuple[float, float]:
        there, back = 2e-4 + self.rng.exponential(self.case['jitter_ms'] * 1e-3, 2)
        back += self.case['asymmetry_ms'] * 1e-3
        if self.rng.random() < self.case['stalled']:
            back += self.case['stall_ms'] * 1e-3 * self.rng.random()
        return there, back


class Far:
    """The aircraft's side of a link with delays, and the stamps that the host computes."""

    def __init__(self, case: dict[str, float], seed: int) -> None:
        self.world, self.stamping = World(case, seed), Stamping()
        self.found: list[tuple[float, float, float]] = []
        """True time, stamp, and the time at which it was computed, s."""
        self.begun_s = -1.0
        self.stall = (case.get('stall_from_s', math.inf), case.get('stall_s', 0.0))
        self.kept: list[Cycle] = []

    def unheard(self, at_s: float) -> bool:
        begin = self.world.case.get('silent_from_s', math.inf)
        return begin <= at_s < begin + self.world.case.get('silent_s', 0.0)

    def stalled(self, at_s: float) -> bool:
        return self.stall[0] <= at_s < sum(self.stall)

    def question(self, at_s: float) -> None:
        there, back = self.world.delays()
        told_ns = 1000 * self.world.device_us(at_s + there)
        sent, received = (host_ns(t) for t in (at_s, at_s + there + back))
        self.stamping.trip(sent, told_ns, received)
        self.collect(at_s)

    def cycle(self, at_s: float) -> None:
        world, begun_s = self.world, at_s
        if world.rng.random() < world.case.get('uneven', 0.0):
            begun_s += 0.02 * world.rng.random()  # the control loop came late, and catches up
        self.begun_s = begun_s = max(begun_s, self.begun_s + 0.001)
        if self.unheard(at_s):
            return
        number = round((at_s - world.zero_s) / CYCLE_S)
        true = (begun_s, 0.0, 0.0)
        frame = Cycle(
            world.device_us(begun_s), number, true, ZERO, ZERO, ZERO, ZERO, (0.0,) * 4, ZERO,
            (0.0,) * 4, 0,
        )  # fmt: skip
        self.kept.append(frame)
        if not self.stalled(at_s):
            for one in self.kept:
                self.stamping.cycle(one, host_ns(at_s))
            self.kept.clear()
            self.collect(at_s)

    def collect(self, at_s: float) -> None:
        for item in self.stamping.out:
            self.found.append((item.frame.gyro[0], 1e-9 * (item.stamp_ns - OFFSET_NS), at_s))
        self.stamping.out.clear()


def host_ns(at_s: float) -> int:
    return OFFSET_NS + round(1e9 * at_s)


def run(case: dict[str, float], seconds: float, seed: int) -> dict[str, float]:
    far = Far(case, seed)
    stamping, world = far.stamping, far.world
    next_sync_s = at_s = 0.0
    jump_s, restart_s = case.get('jump_at_s', math.inf), case.get('restart_at_s', math.inf)
    while at_s < seconds:
        if at_s >= jump_s:
            world.begin_s += case['jump_ms'] * 1e-3
            jump_s = math.inf
        if at_s >= restart_s:
            world.zero_s, world.begin_s, restart_s = at_s, 0.0, math.inf
            if not far.unheard(at_s):
                stamping.restart()  # the cycle counter went back
        if at_s >= next_sync_s and not far.unheard(at_s) and not far.stalled(at_s):
            far.question(at_s)
            calm = stamping.clock.converged and not stamping.clock.doubtful
            next_sync_s = at_s + (0.2 if calm else 0.05)
        far.cycle(at_s)
        if stamping.asks:
            next_sync_s = min(next_sync_s, at_s + 0.02)
        at_s += CYCLE_S
    true, stamps, given = np.array(far.found).T
    errors, steps = 1e3 * (stamps - true), np.diff(stamps)
    return {
        'rms_ms': float(np.sqrt(np.mean(errors**2))),
        'max_ms': float(np.abs(errors).max()),
        'backwards': int((steps <= 0).sum()),
        'held': stamping.withheld,
        'over_2_ms': int((np.abs(errors) > 2.0).sum()),
        'restarts': stamping.clock.restarts,
        'wraps': stamping.device_time.wraps,
        'alarms': stamping.guard.alarms,
        'late_ms': float(1e3 * (given - true).max()),
        'bound_ms': 500.0 * stamping.clock.round_trip_s,
    }


QUIET = {'drift_ppm': 50.0, 'jitter_ms': 0.2, 'asymmetry_ms': 0.0, 'stall_ms': 0.0, 'stalled': 0.0}
STALLS = {**QUIET, 'stall_ms': 10.0, 'stalled': 0.3}
WORST = {**STALLS, 'asymmetry_ms': 0.5, 'jitter_ms': 0.5}
CASES: dict[str, dict[str, float]] = {
    'drift +50 ppm, jitter 0.2 ms': QUIET,
    'drift -50 ppm': {**QUIET, 'drift_ppm': -50.0},
    'stalls of 10 ms, 3 trips in 10': STALLS,
    'asymmetry 0.5 ms': {**QUIET, 'asymmetry_ms': 0.5},
    'all of it, jitter 0.5 ms': WORST,
    'all, stalls 8 trips in 10': {**WORST, 'stalled': 0.8},
    'all, drift wanders 5 ppm': {**WORST, 'wander_ppm': 5.0},
    '32 bits wrap at half time': {**WORST, 'bits': 32, 'device_begin_s': -1.0},
    'STM32 restarts at half time': {**WORST, 'restart_at_s': -1.0},
    'device jumps 40 ms': {**WORST, 'jump_at_s': -1.0, 'jump_ms': 40.0},
    'device jumps back 3 ms': {**WORST, 'jump_at_s': -1.0, 'jump_ms': -3.0},
    'device jumps back 40 ms': {**WORST, 'jump_at_s': -1.0, 'jump_ms': -40.0},
    'device jumps 2.5 ms': {**WORST, 'jump_at_s': -1.0, 'jump_ms': 2.5},
    'uneven cycles, 1 in 50 late': {**WORST, 'uneven': 0.02},
    'host stands still for 1 s': {**WORST, 'stall_from_s': -1.0, 'stall_s': 1.0},
    'nothing heard for 3 s': {**WORST, 'silent_from_s': -1.0, 'silent_s': 3.0},
    # heard again with a higher counter than before
    'unheard for 4.5 s, restarted': {
        **WORST, 'silent_from_s': 2.0, 'silent_s': 4.5, 'restart_at_s': 2.5,
    },
    'unheard for 90 s, restarted': {
        **WORST, 'silent_from_s': 30.0, 'silent_s': 90.0, 'restart_at_s': 31.0,
    },
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--minutes', type=float, default=10.0, help='of each case')
    parser.add_argument('--seeds', type=int, default=3)
    given = parser.parse_args()
    seconds, told = 60.0 * given.minutes, {}
    heads = 'RMS ms  max ms  > 2 ms  backwards  held  late ms  bound ms'
    print(f'{"case":32}{heads}')
    for name, case in CASES.items():
        half = {'jump_at_s': seconds / 2, 'restart_at_s': seconds / 2}
        half |= {'stall_from_s': seconds / 2, 'silent_from_s': seconds / 2}
        half['device_begin_s'] = 2**32 * 1e-6 - seconds / 2
        filled = {k: half.get(k, v) if v == -1.0 else v for k, v in case.items()}
        runs = [run(filled, seconds, seed) for seed in range(1, given.seeds + 1)]
        worst = {key: max(one[key] for one in runs) for key in runs[0]}
        told[name] = worst
        print(
            f'{name:30} {worst["rms_ms"]:7.3f} {worst["max_ms"]:7.3f} {worst["over_2_ms"]:7d}'
            f' {worst["backwards"]:10d} {worst["held"]:5d} {worst["late_ms"]:8.0f}'
            f' {worst["bound_ms"]:9.3f}'
        )
    print(json.dumps({'schema': 'quad_bridge/link_clock/1', 'minutes': given.minutes, **told}))


if __name__ == '__main__':
    main()
