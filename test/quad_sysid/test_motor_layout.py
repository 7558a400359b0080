"""What the motors do is found in the motion, for 4, 6 and 8 motors, and nothing where none is."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from quad_sysid.craft import of_betaflight
from quad_sysid.imports.clock import Stream
from quad_sysid.imports.log import ForeignLog
from quad_sysid.imports.mixers import chosen
from quad_sysid.imports.to_bag import import_log
from quad_sysid.motor_layout import patterns_of, share_of

SHARED = Path(__file__).resolve().parents[2] / '../shared/data'
DT, N = 0.004, 6000
LAYOUTS = {
    'X': ('+ - - +', '+ + - -', '+ - + -'),
    'another order': ('- + - +', '+ + - -', '- + + -'),
    'plus': ('0 - 0 +', '- 0 + 0', '+ - + -'),
    'hexa X': ('- + + - - +', '0 0 - + - +', '+ - + - - +'),
    'coaxial X8': ('+ - - + + - - +', '+ + - - + + - -', '+ - + - - + - +'),
}


def signs(text: str) -> np.ndarray:
    return np.array([{'+': 1.0, '-': -1.0, '0': 0.0}[c] for c in text.split()])


def flown(layout: tuple[str, ...], seed: int = 1, push: float = 20.0) -> tuple:
    """Rates of a plant of each axis in a rate loop, behind 8 ms of delay and 40 ms of lag."""
    rng = np.random.default_rng(seed)
    rows = np.array([signs(text) for text in layout])
    if rows.shape[1] == 6:  # arms of 90° and 30° from the nose
        rows[0, 2:] *= 0.5
    k = rows.shape[1]
    rates = np.zeros((N, 3))
    motors = np.full((N, k), 0.5)
    drive = np.zeros(3)
    wanted = np.repeat(rng.choice([-1.0, 0.0, 1.0], (N // 100 + 1, 3)), 100, axis=0)[:N]
    for n in range(N - 1):
        command = 0.05 * (wanted[n] - rates[n])
        motors[n] = np.clip(0.5 + command @ rows + 0.01 * rng.standard_normal(k), 0.0, 1.0)
        torque = rows @ (motors[max(0, n - 2)] - 0.5) * (4.0 / k)
        drive += DT / 0.04 * (torque - drive)
        rates[n + 1] = rates[n] + DT * (100.0 * drive + push * rng.standard_normal(3))
    return rates + 0.005 * rng.standard_normal((N, 3)), motors


@pytest.mark.parametrize('layout', LAYOUTS.values(), ids=LAYOUTS)
def test_every_layout_is_found(layout):
    rates, motors = flown(layout)
    found = patterns_of(rates, motors, DT)
    assert [p.text for p in found] == list(layout)
    assert all(p.certain for p in found)
    assert all(p.share > 1.4 * p.rival_share for p in found)
    opposite = -np.array(found[0].signs, dtype=float)
    assert share_of(opposite, rates[:, 0], motors, DT) < 0.1 * found[0].share


def test_a_crash_and_a_time_in_the_hand_do_not_hide_the_layout(tmp_path):
    """As long in the hand as in flight, then a second in which it hits things, its motors jump."""
    rng = np.random.default_rng(0)
    rates, motors = flown(LAYOUTS['another order'])
    crash = slice(N - 250, N)
    rates[crash] = np.cumsum(2.0 * rng.standard_normal((250, 3)), axis=0)
    motors[crash] = rng.choice([0.0, 1.0], (250, 4))
    hand = 3.0 * np.sin(np.arange(N)[:, None] * DT * np.array([5.0, 7.0, 4.0]))
    idle = 0.06 + 0.02 * rng.random((N, 4))
    times = DT * np.arange(2 * N)
    log = ForeignLog('crash', 'a log', rates=Stream(times, np.vstack([hand, rates])),
                     motors=Stream(times, np.vstack([idle, motors])))
    notes = import_log(log, tmp_path / 'bag').notes
    for axis, text in zip(('roll', 'pitch', 'yaw'), LAYOUTS['another order'], strict=True):
        (line,) = (line for line in notes if line.startswith(f'motors on {axis}'))
        assert f': {text} explain' in line
        assert 'not certain' not in line


@pytest.mark.parametrize(('layout', 'wanted'), [
    (('- - + +', '+ - + -', '- + + -'), 'QUADX, propellers out'),
    (('- - + + - +', '+ - + - 0 0', '- - + + + -'), 'HEX6X, propellers in'),
])
def test_the_motion_says_what_a_log_does_not(layout, wanted):
    """A blackbox header that names neither the mixer nor the sense of the propellers."""
    mixers = ('QUADX',) if len(signs(layout[0])) == 4 else ('HEX6', 'HEX6X', 'Y6')
    crafts = [of_betaflight({'mixer': mixer, 'yaw_motors_reversed': out})
              for mixer in mixers for out in ('0', '1')]
    rates, motors = flown(layout)
    assert chosen(crafts, patterns_of(rates, motors, DT), rates, motors, DT).name == (
        f"Betaflight's {wanted}")


@pytest.mark.parametrize('motors', [4, 8])
@pytest.mark.parametrize('seed', range(2))
def test_nothing_is_certain_where_nothing_turns_the_axes(seed, motors):
    """Motors and rates that have nothing to do with each other, as noise and as slow motions."""
    rng = np.random.default_rng(seed)
    shape = (N, 3 + motors)
    noise = rng.standard_normal(shape)
    slow = np.cumsum(noise, axis=0) * DT
    for made in (noise, slow):
        found = patterns_of(made[:, :3], np.clip(0.5 + 0.1 * made[:, 3:], 0.0, 1.0), DT,
                            slow[:, :3])
        assert not [p for p in found if p.certain]


def test_on_a_rig_that_hangs_the_angle_shows_it():
    """Sampled every 4 s, only where the arm comes to rest is seen: R² 0.99 for - + - +."""
    rng = np.random.default_rng(0)
    motors = rng.uniform(0.2, 0.8, (300, 4))
    angles = np.zeros((300, 3))
    angles[:, 0] = 0.2 * motors @ signs('- + - +') + 0.01 * rng.standard_normal(300)
    rates = np.zeros((300, 3))
    rates[:, 0] = 0.01 * rng.standard_normal(300)
    (found,) = patterns_of(rates, motors, 4.0, angles)
    assert (found.text, found.response, found.certain) == ('- + - +', 'angle', True)
    assert found.share == pytest.approx(0.98, abs=0.01)


@pytest.mark.parametrize(
    ('file', 'rates', 'motors'),
    [
        ('flights/crazyflie_1khz_roll_pitch.csv', 'gx,gy,gz', 'm1,m2,m3,m4'),
        *((f'nanobench/{name}_rep1.csv.gz', 'imu_gyro_x,imu_gyro_y,imu_gyro_z',
           ','.join(f'motor_motor_m{i}' for i in range(1, 5)))
          for name in ('B2_circle_fast', 'B10_lissajous_fast')),
    ],
)
def test_a_crazyflies_motors_stand_as_its_makers_say(file, rates, motors):
    """Front right, rear right, rear left, front left; what is certain must be right."""
    path = SHARED / file
    if not path.exists():
        pytest.skip('the measured data are not beside this checkout')
    with (gzip.open if path.suffix == '.gz' else open)(path, 'rt') as stream:
        header = stream.readline().strip().split(',')
        data = np.loadtxt(stream, delimiter=',')
    column = {name: data[:, i] for i, name in enumerate(header)}
    measured = np.column_stack([column[n] for n in rates.split(',')])
    commands = np.column_stack([column[n] for n in motors.split(',')])
    dt = float(np.median(np.diff(column['t'])))
    found = patterns_of(measured, commands / commands.max(), dt)
    right = dict(zip(('roll', 'pitch', 'yaw'), ('- - + +', '- + + -', '- + - +'), strict=True))
    assert {p.axis for p in found if p.certain} >= {'roll'}
    assert all(p.text == right[p.axis] for p in found if p.certain)
