"""Gains of a blackbox header: the firmware's own numbers, and the D part that it logged."""

import math
import struct
from pathlib import Path

import numpy as np
import pytest

from quad_sysid.imports.betaflight import _Events
from quad_sysid.imports.betaflight_gains import Adjustment, changes, tuning
from quad_sysid.logview.read import read
from quad_sysid.logview.response import derivative
from quad_sysid.logview.spectrum import frames

BETAFLIGHT = {
    'Firmware revision': 'Betaflight 4.5.1 (77d01ba3b) STM32F7X2', 'rollPID': '45,80,40',
    'pitchPID': '47,84,46', 'yawPID': '45,80,0', 'd_min': '30,34,0', 'levelPID': '50,75,75',
    'tpa_rate': '65', 'tpa_breakpoint': '1350', 'tpa_mode': '1', 'ff_weight': '120,125,120',
    'dterm_lpf1_static_hz': '75', 'dterm_lpf2_static_hz': '150', 'pidsum_limit': '500',
}
INAV = {'Firmware revision': 'INAV 7.1.2 (4e1e59eb) MATEKF722', 'rollPID': '40,30,23',
        'pitchPID': '40,30,23', 'yawPID': '45,80,0', 'tpa_rate': '20', 'tpa_breakpoint': '1500'}
RAD = math.degrees(1.0) / 1000.0
LOG = Path(__file__).resolve().parents[3] / 'shared/data/autopilots/bf_sitl_quad.BFL'


def test_betaflights_numbers_become_command_per_rad_s():
    found = tuning(BETAFLIGHT, 0.35 + 0.325).gains  # half-way up TPA's slope
    assert found['roll.rate.kp'] == pytest.approx(45 * 0.032029 * RAD)
    assert found['yaw.rate.ki'] == pytest.approx(80 * 0.244381 * 2.5 * RAD)
    # D of a stick that rests is d_min, and TPA leaves 1 - 0.65 / 2 of it
    assert found['roll.rate.kd'] == pytest.approx(30 * 0.000529 * RAD * 0.675)
    assert found['roll.rate.kff_slope'] == pytest.approx(1.2 * 0.013754 * RAD)
    assert found['pitch.angle.kp'] == 5.0
    # two first-order filters as one with the delay of both
    assert found['roll.rate.d_filter_hz'] == pytest.approx(50.0)
    assert found['roll.rate.output_limit'] == 0.5


def test_inavs_numbers_are_a_part_of_the_motors_range():
    low, high = (tuning(INAV, at, 850.0).gains for at in (0.3, 0.75))
    assert low['roll.rate.kp'] == pytest.approx(40 / 31.0 * math.degrees(1.0) / 850.0)
    assert low['yaw.rate.ki'] == pytest.approx(80 / 4.0 * math.degrees(1.0) / 850.0)
    assert high['roll.rate.kp'] == pytest.approx(0.9 * low['roll.rate.kp'])
    assert high['yaw.rate.kp'] == low['yaw.rate.kp']


@pytest.mark.parametrize('header', [
    {'Firmware revision': 'Betaflight 3.5.7 (1c1bc2ee4) STM32F405'}, {'use_integrated_yaw': '1'},
])
def test_yaws_i_is_no_steeper_before_betaflight_4_and_where_yaw_is_integrated(header):
    found = tuning({**BETAFLIGHT, **header}, 0.3).gains
    assert found['yaw.rate.ki'] == pytest.approx(80 * 0.244381 * RAD)


def test_the_types_of_d_filters_have_older_names():
    """A biquad of 100 Hz has the delay of a filter of first order of 71 Hz."""
    own = {k: v for k, v in BETAFLIGHT.items() if not k.startswith('dterm')}
    found = tuning({**own, 'dterm_lpf_hz': '100', 'dterm_filter_type': '1'}, 0.3).gains
    assert found['roll.rate.d_filter_hz'] == pytest.approx(100.0 / math.sqrt(2.0))


def test_unknown_firmwares_have_no_gains():
    assert tuning({**BETAFLIGHT, 'Firmware revision': 'Rotorflight 4.3.0'}, 0.5).gains == {}


def test_a_gain_changed_in_flight_is_a_set_from_there_on():
    events = _Events()
    for message in (bytes([18, 104]), bytes([0x80 | 17]) + struct.pack('<f', 50.0)):
        events.rows += 100
        events(iter(message))
    assert events.changes == [(100, 18, 52.0), (200, 17, 50.0)]
    found = changes(BETAFLIGHT, [Adjustment(3.0, 18, 52.0), Adjustment(9.0, 6, 60.0)], None)
    assert [one.time_s for one in found] == [3.0, 9.0]
    assert found[0].values['roll.rate.kp'] == pytest.approx(52 * 0.032029 * RAD)
    assert found[0].values['pitch.rate.kp'] == pytest.approx(47 * 0.032029 * RAD)
    assert found[1].values['pitch.rate.kp'] == pytest.approx(60 * 0.032029 * RAD)


@pytest.mark.skipif(not LOG.exists(), reason=f'no {LOG.name} beside the checkout')
def test_the_d_part_that_betaflight_logged_is_that_of_the_gains(tmp_path):
    """In the first half of the log: decoding takes long."""
    whole, part = LOG.read_bytes(), tmp_path / LOG.name
    part.write_bytes(whole[: len(whole) // 2])
    flown = read(part)
    gains = flown.gains[0].values
    for i, axis in enumerate(('roll', 'pitch')):
        gyro, logged = (frames(x[:, i], flown.flying, flown.dt)
                        for x in (flown.rates, flown.d_term))
        ours = gyro.mean * np.abs(derivative(gains, axis, gyro.frequency_hz, flown.dt)) ** 2
        band = (gyro.frequency_hz >= 10.0) & (gyro.frequency_hz < 80.0)
        assert math.sqrt(logged.mean[band].sum() / ours[band].sum()) == pytest.approx(1.0,
                                                                                      abs=0.05)
