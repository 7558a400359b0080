"""An 85 s flight of one axis in the simulated cascade, as a bag to time the whole command on.

    python bench/blackbox_flight.py BAG
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from quad_sysid.bags.writer import write_bag
from quad_sysid.loop.cascade import CascadeGains
from quad_sysid.loop.plant import plant_like
from quad_sysid.loop.simulation import simulate_cascade
from quad_sysid.record import GainChange, Record, Segment
from quad_sysid.signals.waveforms import prbs

DT, SECONDS = 0.004, 85.0
SPANS = (('idle', 'none', 0.0, 4.5), ('train', 'prbs', 5.0, 45.0),
         ('validation', 'prbs', 46.0, 65.0), ('validation', 'square', 66.0, 85.0))


def flight(seed: int = 0) -> Record:
    """PRBS to train, another PRBS and a square wave to validate; torque and gyro noise."""
    n = round(SECONDS / DT)
    rng = np.random.default_rng(seed)
    time = np.arange(n) * DT
    square = 0.2 * np.sign(np.sin(2.0 * np.pi * 0.4 * time))
    reference = np.select(
        [time < 5.0, time < 45.5, time < 65.5],
        [np.zeros(n), np.resize(prbs(9, 24, 0.2, 1), n), np.resize(prbs(10, 24, 0.2, 2), n)],
        square,
    )
    gains = CascadeGains.default('roll')
    plant = plant_like('roll', np.array([450.0, 0.04, 0.008, 0.4, 0.0]), DT, 42.0)
    run = simulate_cascade(
        plant, gains, reference, DT, noise=0.01 * rng.standard_normal(n),
        disturbance=0.5 * rng.standard_normal(n),
    )
    zero = np.zeros(n)
    return Record(
        source='flight', dt=DT, rates=np.column_stack((run.rate, zero, zero)),
        angles=np.column_stack((run.angle, zero, zero)),
        control=np.column_stack((zero + 0.5, np.clip(run.control, -0.4, 0.4), zero, zero)),
        attitude_setpoint=np.column_stack((reference, zero, zero)),
        rate_setpoint=np.column_stack((run.rate_reference, zero, zero)),
        segments=tuple(Segment(r, s, 'roll', 'attitude', a, b) for r, s, a, b in SPANS),
        gains=(GainChange(
            0.0, gains.to_mapping('roll', constants=True) | {'sensor.gyro_filter_hz': 42.0}
        ),),
    )


if __name__ == '__main__':
    print(write_bag(flight(), Path(sys.argv[1])))
