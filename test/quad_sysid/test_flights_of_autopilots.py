"""Flights of ArduCopter's and PX4's own firmware: the bridge's bag, the log it fetched, the truth.

ArduCopter 4.7 in its simulator (frame quad, plus), a chirp by SYSTEM ID at the mixer's input, and
PX4 1.16 in its own (SIH, quadx), a PRBS of the attitude in OFFBOARD; roll rate gains halved, flown
by our excitation node. The bags are thinned to 50 Hz, of the logs what is needed was kept. ROS
time is the autopilot's plus 1000 s.
"""

import lzma
from pathlib import Path

import pytest

import quad_sysid
from quad_sysid.imports.log_of_flight import joined

pytestmark = pytest.mark.usefixtures('quick')
DATA = Path(__file__).resolve().parents[1] / 'data'
OFFSET_S = 1000.0
THRUST_N, ARM_M, INERTIA = 3.0 * 9.80665 / 4.0 / 0.39, 0.35, 3.0 * 0.25 * 0.175**2
"""Of one motor at full command and 12.6 V; of the frame; kg m²."""
LIFT, AIR = 0.35 * 12.6 / 12.8 + 0.65 * (12.6 / 12.8) ** 2, 0.9444
"""What ArduPilot divides by: battery's lift by MOT_BAT_VOLT_MAX and MOT_THST_EXPO, air density."""
GAIN = THRUST_N * ARM_M / INERTIA / LIFT / AIR
"""rad/s² per unit of RATE.ROut: two motors with half of it each."""
DAMPING = 1.99
"""1/s: drag of the rotors' inflow 1.93, of the simulator's rotation 0.06."""
UNIT = 0.02532673 / 0.0675
"""Our command per RATE.ROut: as the bridge read it in flight (roll.rate.kp, ATC_RAT_RLL_P)."""


def both(flight, log, folder):
    """The bag of both, from the bag and log of a flight."""
    path = folder / log
    path.write_bytes(lzma.decompress((DATA / flight / f'{log}.xz').read_bytes()))
    return joined(DATA / flight / 'bag', path, OFFSET_S, folder / 'flight_log')


def test_ardupilots_log_beside_the_bag_has_the_truth(tmp_path):
    bag = both('ardupilot_sitl', 'log.bin', tmp_path)
    record = quad_sysid.read_bag(bag)
    assert record.dt == pytest.approx(0.0025, rel=1e-3)  # the log's rate, not the bag's
    assert {(s.axis, s.injection) for s in record.segments if s.signal == 'chirp'} == {
        ('roll', 'control')}  # fmt: skip
    model = quad_sysid.identify(bag, axes=['roll'], effects=()).answers['roll'].model
    assert model.value('gain') == pytest.approx(GAIN / UNIT, rel=0.03)
    assert model.value('damping') == pytest.approx(DAMPING, abs=0.3)
    assert model.value('lag') < 0.001  # its motors answer at once
    assert model.value('delay') < 0.001


def test_px4s_log_beside_the_bag_has_the_truth(tmp_path):
    pytest.importorskip('pyulog')
    bag = both('px4_sih', 'log.ulg', tmp_path)
    record = quad_sysid.read_bag(bag)
    assert record.dt == pytest.approx(0.004)
    assert record.gains_at(1.0)['roll.rate.kp'] == pytest.approx(0.075 * 0.5**0.5, rel=1e-4)
    model = quad_sysid.identify(bag, axes=['roll'], effects=()).answers['roll'].model
    assert model.value('gain') == pytest.approx(4 * 5.0 * 0.2 / 0.025, rel=0.05)
    # 0.05 s in steps of 4 ms: a pole at 0.048 s that answers half a step early
    assert model.value('lag') + model.value('delay') == pytest.approx(0.046, abs=0.003)
    assert model.value('damping') == pytest.approx(1.0, abs=0.5)
