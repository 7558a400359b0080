"""Stamps against the true device time: drift, stalls, asymmetry, jitter, wrap, restart, jumps.

    python bench/link_clock.py --minutes 20

At the level of numbers, faster than time: a device whose clock drifts answers TIMESYNC over a line
with delays, the estimator stamps 250 cycles a second. Cycles before convergence are held back, as
the link does. The last line is one JSON object.
"""

from __future__ import annotations

import argparse
import json
import math

import numpy as np

from quad_bridge.wire.clock import ClockEstimator, DeviceTime
from quad_bridge.wire.step_guard import StepGuard

OFFSET_NS = 1_700_000_000_000_000_000
CYCLE_S = 0.004


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


def run(case: dict[str, float], seconds: float, seed: int) -> dict[str, float]:
    world, clock, time, guard = World(case, seed), ClockEstimator(), DeviceTime(), StepGuard()
    errors, stamps, held, wrong, cycle = [], [], 0, 0, 0
    waiting: list[tuple[int, float]] = []
    next_sync_s = at_s = last_s = 0.0
    last_ns = longest = 0
    jump_s, restart_s = case.get('jump_at_s', math.inf), case.get('restart_at_s', math.inf)
    while at_s < seconds:
        if at_s >= jump_s:
            world.begin_s += case['jump_ms'] * 1e-3
            jump_s = math.inf
        if at_s >= restart_s:
            world.zero_s, world.begin_s, restart_s = at_s, 0.0, math.inf
            clock.reset()  # the link resets it: the cycle counter went back
            time.restart()
            guard.restart()
        if at_s >= next_sync_s:
            there, back = world.delays()
            middle = time.extend(world.device_us(at_s + there), 60_000_000)
            sent, received = (OFFSET_NS + round(1e9 * t) for t in (at_s, at_s + there + back))
            accepted = clock.add(sent, 1000 * middle, received)
            guard.trip(sent, clock.off_ns, accepted=accepted)
            if not clock.converged:
                guard.restart()
            next_sync_s = at_s + (0.2 if clock.converged and not clock.doubtful else 0.05)
        begun_s = at_s
        if world.rng.random() < case.get('uneven', 0.0):
            begun_s += 0.02 * world.rng.random()  # the control loop came late, and catches up
        begun_s = max(begun_s, last_s + 0.001)
        last_s = begun_s
        device_us = time.extend(world.device_us(begun_s), 60_000_000)
        cycle += 1
        waiting.append((device_us, begun_s))
        if guard.step(cycle, device_us, OFFSET_NS + round(1e9 * at_s)) and clock.converged:
            next_sync_s = min(next_sync_s, at_s + 0.02)
            longest = max(longest, len(waiting))
        else:
            for device, true_s in waiting:
                stamp_ns = clock.host_ns(1000 * device) if clock.converged else 0
                if stamp_ns <= last_ns:
                    held += 1
                    continue
                last_ns = stamp_ns
                errors.append(1e-6 * (stamp_ns - OFFSET_NS - 1e9 * true_s))
                stamps.append(stamp_ns)
                wrong += abs(errors[-1]) > 2.0
            waiting.clear()
        at_s += CYCLE_S
    found, steps = np.array(errors), np.diff(np.array(stamps))
    return {
        'rms_ms': float(np.sqrt(np.mean(found**2))),
        'max_ms': float(np.abs(found).max()),
        'backwards': int((steps <= 0).sum()),
        'held': held,
        'over_2_ms': wrong,
        'restarts': clock.state.restarts,
        'wraps': time.wraps,
        'alarms': guard.alarms,
        'late_ms': 1e3 * CYCLE_S * longest,
        'bound_ms': 500.0 * clock.state.round_trip_s,
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
