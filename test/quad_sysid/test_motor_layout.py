"""What the motors do is found in the motion, for 4, 6 and 8 motors, and nothing where none is."""

from pathlib import Path

import numpy as np
import pytest
from flown_craft import DT, Airframe, X, fly

from quad_sysid.craft import of_betaflight
from quad_sysid.imports.clock import Stream
from quad_sysid.imports.log import ForeignLog
from quad_sysid.imports.mixers import chosen
from quad_sysid.imports.table import open_table
from quad_sysid.imports.to_bag import import_log
from quad_sysid.motor_layout import commands_of, exchanged, patterns_of, share_of

SHARED = Path(__file__).resolve().parents[2] / '../shared/data'
LAYOUTS = {
    'X': X, 'another order': ((135, 1), (-135, -1), (45, -1), (-45, 1)),
    'plus': ((0, -1), (90, 1), (180, -1), (-90, 1)),
    'hexa X': ((90, -1), (-90, 1), (-30, -1), (150, 1), (30, 1), (-150, -1)),
    'coaxial X8': (*X, *((angle, -spin) for angle, spin in X)),
}


def flown(motors) -> tuple[list[str], np.ndarray, np.ndarray]:
    """What each motor does to roll, pitch and yaw as signs, and rates and motors of a flight."""
    airframe = Airframe(motors, torque_noise=1.0)
    forward, left, turn = np.round(airframe.places, 6).T
    texts = [' '.join('-0+'[int(np.sign(x)) + 1] for x in row) for row in (left, -forward, turn)]
    flight = fly(airframe, 1, 16.0)
    return texts, flight['rates'], flight['motors']


@pytest.mark.parametrize('layout', LAYOUTS.values(), ids=LAYOUTS)
def test_every_layout_is_found(layout):
    texts, rates, motors = flown(layout)
    found = patterns_of(rates, motors, DT)
    assert [p.text for p in found] == texts
    assert all(p.certain for p in found)
    assert all(p.share > 1.4 * p.rival_share for p in found)
    later = patterns_of(rates[:-8], motors[8:], DT)  # whatever answers by as much
    assert min(a.share / b.share for a, b in zip(later, found, strict=True)) > 0.9
    opposite = -np.array(found[0].signs, dtype=float)
    assert share_of(opposite, rates[:, 0], motors, DT) < 0.1 * found[0].share


@pytest.mark.parametrize(('order', 'lines'), [([0, 1, 2], 0), ([1, 0, 2], 2)])
def test_commands_that_are_exchanged_are_told(order, lines):
    _, rates, motors = flown(LAYOUTS['X'])
    commands = 0.25 * motors @ np.array([p.signs for p in patterns_of(rates, motors, DT)]).T
    commands = commands[:, order]
    found = exchanged(commands_of(rates, commands, DT), rates, commands, DT)
    assert len(found) == lines
    assert all('exchanged?' in line for line in found)


def test_a_crash_and_a_time_in_the_hand_do_not_hide_the_layout(tmp_path):
    """As long in the hand as in flight, then a second in which it hits things, its motors jump."""
    rng = np.random.default_rng(0)
    texts, rates, motors = flown(LAYOUTS['another order'])
    n = len(rates)
    crash = slice(n - 250, n)
    rates[crash] = np.cumsum(2.0 * rng.standard_normal((250, 3)), axis=0)
    motors[crash] = rng.choice([0.0, 1.0], (250, 4))
    hand = 3.0 * np.sin(np.arange(n)[:, None] * DT * np.array([5.0, 7.0, 4.0]))
    idle = 0.06 + 0.02 * rng.random((n, 4))
    times = DT * np.arange(2 * n)
    log = ForeignLog('crash', 'a log', rates=Stream(times, np.vstack([hand, rates])),
                     motors=Stream(times, np.vstack([idle, motors])))
    notes = import_log(log, tmp_path / 'bag').notes
    for axis, text in zip(('roll', 'pitch', 'yaw'), texts, strict=True):
        (line,) = (line for line in notes if line.startswith(f'motors on {axis}'))
        assert f': {text} explain' in line
        assert 'not certain' not in line


@pytest.mark.parametrize(('layout', 'wanted'), [
    (((135, 1), (45, -1), (-135, -1), (-45, 1)), 'QUADX, propellers out'),
    (((150, 1), (30, 1), (-150, -1), (-30, -1), (90, -1), (-90, 1)), 'HEX6X, propellers in'),
])
def test_the_motion_says_what_a_log_does_not(layout, wanted):
    """A blackbox header that names neither the mixer nor the sense of the propellers."""
    mixers = ('QUADX',) if len(layout) == 4 else ('HEX6', 'HEX6X', 'Y6')
    crafts = [of_betaflight({'mixer': mixer, 'yaw_motors_reversed': out})
              for mixer in mixers for out in ('0', '1')]
    _, rates, motors = flown(layout)
    assert chosen(crafts, patterns_of(rates, motors, DT), rates, motors, DT).name == (
        f"Betaflight's {wanted}")


@pytest.mark.parametrize('motors', [4, 8])
@pytest.mark.parametrize('seed', range(2))
def test_nothing_is_certain_where_nothing_turns_the_axes(seed, motors):
    rng = np.random.default_rng(seed)
    shape = (6000, 3 + motors)
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
    angles[:, 0] = 0.2 * motors @ [-1.0, 1.0, -1.0, 1.0] + 0.01 * rng.standard_normal(300)
    rates = np.zeros((300, 3))
    rates[:, 0] = 0.01 * rng.standard_normal(300)
    (found,) = patterns_of(rates, motors, 4.0, angles)
    assert (found.text, found.response, found.certain) == ('- + - +', 'angle', True)
    assert found.share == pytest.approx(0.98, abs=0.01)


@pytest.mark.parametrize(
    ('file', 'rates', 'motors'),
    [
        ('flights/crazyflie_1khz_roll_pitch.csv', 'gx,gy,gz', 'm1,m2,m3,m4'),
        ('nanobench/B2_circle_fast_rep1.csv.gz', 'imu_gyro_x,imu_gyro_y,imu_gyro_z',
         ','.join(f'motor_motor_m{i}' for i in range(1, 5))),
    ],
)
def test_a_crazyflies_motors_stand_as_its_makers_say(file, rates, motors):
    """Front right, rear right, rear left, front left; what is certain must be right."""
    path = SHARED / file
    if not path.exists():
        pytest.skip('the measured data are not beside this checkout')
    column = open_table(path).columns
    measured = np.column_stack([column[n] for n in rates.split(',')])
    commands = np.column_stack([column[n] for n in motors.split(',')])
    dt = float(np.median(np.diff(column['t'])))
    found = patterns_of(measured, commands / commands.max(), dt)
    right = dict(zip(('roll', 'pitch', 'yaw'), ('- - + +', '- + + -', '- + - +'), strict=True))
    assert {p.axis for p in found if p.certain} >= {'roll'}
    assert all(p.text == right[p.axis] for p in found if p.certain)
