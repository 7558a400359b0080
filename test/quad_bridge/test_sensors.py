"""Known biases are found, from a bag too; what moves or is unclear is refused."""

import math
from dataclasses import replace

import numpy as np
import pytest
import yaml
from flight_controller import STILL

from quad_bridge.errors import RefusedError
from quad_bridge.sensors.command import main
from quad_bridge.sensors.live import NOT_YET, EstimateRequest, LiveSensors
from quad_bridge.sensors.rest import GRAVITY_M_S2, estimate_at_rest
from quad_sysid.bags import write_bag
from quad_sysid.record import Record

RATE_HZ = 250.0
BIAS, DRIFT = np.array([0.012, -0.02, 0.004]), np.array([2e-5, 0.0, -1e-4])
ROLL, PITCH = 0.03, -0.02


def resting(seconds=20.0):
    rng = np.random.default_rng(3)
    t = np.arange(0.0, seconds, 1.0 / RATE_HZ)
    gyro = BIAS + DRIFT * (t - t.mean())[:, None] + 0.005 * rng.standard_normal((len(t), 3))
    up = GRAVITY_M_S2 * np.array(
        [-math.sin(PITCH), math.cos(PITCH) * math.sin(ROLL), math.cos(PITCH) * math.cos(ROLL)]
    )
    return t, gyro, up + 0.05 * rng.standard_normal((len(t), 3))


def test_bias_drift_and_level_are_found_within_their_errors():
    found = estimate_at_rest(*resting())
    # 40 block means: four standard errors
    assert np.all(np.abs(np.array(found.gyro_bias) - BIAS) < 4 * np.array(found.gyro_bias_std))
    assert np.all(np.abs(np.array(found.gyro_drift) - DRIFT) < 4 * np.array(found.gyro_drift_std))
    assert max(found.gyro_bias_std) < 2e-4
    assert found.gyro_noise == pytest.approx((0.005,) * 3, rel=0.05)
    assert found.level == pytest.approx((ROLL, PITCH), abs=2e-4)
    assert found.acceleration_norm_error == pytest.approx(0.0, abs=0.005)


def at(array, place, axis, size):
    array[place : place + 200, axis] += size * np.hanning(200)
    return array


SIDE, TURN, HUGE = 1.2, np.array([0.0, 0.0, 0.5]), np.array([1.0, 1.0, 1e308])


@pytest.mark.parametrize(
    ('what', 'text'),
    [
        (lambda t, g, a: (t, at(g, 2000, 1, 0.1), a), r'it turns: .* at 8.* below 0\.01 rad/s;'),
        (lambda t, g, a: (t, g, at(a, 2000, 0, 1.0)), 'is moved or shaken'),
        (lambda t, g, a: (t, g + TURN, a), 'rate z is 0.5'),
        (lambda t, g, a: (t[:1000], g[:1000], a[:1000]), r'only 4\.0 s'),
        (lambda t, g, a: (t, g, SIDE * a), 'gravity is measured as 11.7'),
        (lambda t, g, a: (t, g, 0.0 * a + HUGE), r'only 0\.0 s'),  # no sensor reads that
    ],
)
def test_what_is_not_at_rest_is_refused(what, text):
    with pytest.raises(RefusedError, match=text) as caught:
        estimate_at_rest(*what(*resting()))
    assert '\n' not in str(caught.value)


def test_what_was_seen_at_rest_is_subtracted_from_the_next_stamp_on_and_forgotten_at_a_restart():
    live, rest = LiveSensors(correct=True), zip(*resting(7.0), strict=True)
    for time_s, gyro, felt in rest:
        live.cycle(replace(STILL, time_us=round(1e6 * time_s), gyro=gyro * (1, -1, -1),
                           accel=felt * (1, -1, -1), flags=0))
    assert live.stamped(1).gyro_bias == (0.0, 0.0, 0.0)
    assert live.idle
    live.cycle(STILL)  # it is armed
    assert live.estimate(live.request()).startswith('gyro bias +0.01')
    assert live.request() is None
    found = live.stamped(2)
    assert (found.gyro_bias, found.since_ns) == (pytest.approx(BIAS, abs=1e-3), 2)
    assert live.stamped(3) == found
    assert live.status().values['stood (s)'] == '6.0'
    live.want('asked for')  # nothing is at rest any more
    assert live.request() is None
    with pytest.raises(RefusedError, match=r'it is armed: .*; the earlier one stays'):
        live.estimate(EstimateRequest('asked for', ()))
    live.cycle(replace(STILL, flags=0))
    live.want('recording')  # just before it restarts, with another bias
    live.restarted()
    assert live.request() is None
    assert (live.stamped(4).gyro_bias, live.words) == ((0.0, 0.0, 0.0), NOT_YET)


def imu_bag(path, _t, gyro, felt):
    still = np.zeros((len(gyro), 4))
    return write_bag(Record('at rest', 1.0 / RATE_HZ, gyro, still, acceleration=felt), path)


@pytest.fixture(scope='module')
def standing(tmp_path_factory):
    """A bag of 8 s at rest, that stays as it is."""
    return imu_bag(tmp_path_factory.mktemp('standing') / 'bag', *resting(8.0))


def test_the_command_writes_what_it_finds(tmp_path, standing, printed):
    file = tmp_path / 'aircraft' / 'one.yaml'
    assert 'gyro bias +0.01197, -0.02005' in printed(main, 'rest', standing, '--out', file)
    kept = yaml.safe_load(file.read_text())['sensors']['rest']
    assert kept['gyro_bias'] == pytest.approx(list(BIAS), abs=1e-3)
    assert kept['source'] == str(standing)


@pytest.mark.parametrize(
    ('arguments', 'text'),
    [
        (['rest', '{}/absent'], 'does not exist'),
        (['rest', '{}/list.yaml'], 'holds no .mcap or .db3 file'),
        (['rest', '{}/bag', '--seconds', 'nan'], "--seconds: must be a number above 0"),
        (['rest', '{}/bag', '--seconds', '2'], '--seconds: must be 5 or more: found 2'),
        (['rest', '{}/turning'], '/turning: it turns: '),
        (['rest', '{}/bag', '--out', '{}'], 'cannot be written: Is a directory'),
        (['rest', '{}/bag', '--out', '{}/list.yaml'], 'list.yaml: exists, and holds other things'),
    ],
)  # fmt: skip
def test_what_the_command_refuses_it_says_in_one_line(standing, refused, arguments, text):
    folder = standing.parent
    (folder / 'list.yaml').write_text('- 1\n')
    if not (folder / 'turning').exists():
        t, gyro, felt = resting(6.0)
        imu_bag(folder / 'turning', t, at(gyro, 500, 1, 0.1), felt)
    assert text in refused(main, *(word.format(folder) for word in arguments))
