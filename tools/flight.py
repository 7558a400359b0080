"""Two flights of the demo's aircraft as bags, without ROS and in seconds: `make flight`.

The simulated rig has one free axis, roll, whose bearing sticks and slips; a PRBS trains, then one
validates. `my_flight` is to be identified, `another_flight` to judge the model by.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from quad_bridge.virtual.simulation import Excited, Flight, fly
from quad_sysid.bags import write_bag
from quad_sysid.contract import control_from_motors
from quad_sysid.record import GainChange, Record, Segment
from quad_tuning.demo.friction_bearing import effect

NAMES = ('my_flight', 'another_flight')
START_NS = 1_750_000_000_000_000_000
"""Stamp of the first sample, ns since 1970."""


def levels(seconds: float, seed: int) -> np.ndarray:
    """Random steps of the roll reference between ±10 degrees, rad, 0.1 s each, at 250 Hz."""
    rng = np.random.default_rng(seed)
    return np.repeat(rng.choice([-0.175, 0.175], round(seconds / 0.1)), 25)


def record_of(flight: Flight) -> Record:
    """The flight as the analysis gets it from a bag."""
    segments: list[Segment] = []
    time = 0.0
    for part in flight.schedule:
        segments.append(Segment('idle', 'none', part.axis, part.injection, time, part.start_s))
        time = part.start_s + part.samples.size * flight.dt
        segments.append(
            Segment(part.role, part.signal, part.axis, part.injection, part.start_s, time,
                    part.parameters)
        )
    return Record(
        source='simulated', dt=flight.dt, t0_ns=START_NS, rates=flight.rates,
        control=control_from_motors(flight.motors), angles=flight.angles, motors=flight.motors,
        wrench=flight.wrench, attitude_setpoint=flight.attitude_setpoint,
        rate_setpoint=flight.rate_setpoint, acceleration=flight.acceleration,
        excitation=np.where(flight.injection[:, None] > 0, flight.excitation, np.nan),
        battery_v=flight.battery_v,
        segments=tuple(segments), gains=(GainChange(0.0, dict(flight.gains)),),
    )


def main(folder: Path) -> int:
    """Write both bags into the folder, which may not hold them yet."""
    taken = [name for name in NAMES if (folder / name).exists()]
    if taken:
        sys.stderr.write(f'{folder / taken[0]}: is there already; move it away\n')
        return 2
    for seed, name in enumerate(NAMES):
        schedule = [Excited(1.0, levels(30.0, 2 * seed)),
                    Excited(32.0, levels(15.0, 2 * seed + 1), role='validation')]
        flight = fly('demo_rig', schedule, 48.0, seed, effect=effect)
        path = write_bag(record_of(flight), folder / name)
        sys.stdout.write(f'{path}\n')
    sys.stdout.write(f'now: quad-sysid identify {folder / NAMES[0]} --axis roll\n')
    return 0


if __name__ == '__main__':
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('folder', type=Path, nargs='?', default=Path(), help='default: this one')
    sys.exit(main(parser.parse_args().folder))
