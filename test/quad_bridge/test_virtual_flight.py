"""Whole simulated flights: determinism, the firmware's loop against a reference, sensors, bags."""

import ctypes
import math
import runpy
from pathlib import Path

import numpy as np
import pytest
from virtual_aircraft import Endpoint, without_noise

from quad_bridge.craft import X
from quad_bridge.virtual import hil
from quad_bridge.virtual.aircraft import Aircraft, boot
from quad_bridge.virtual.native import NativeFirmware, library
from quad_bridge.virtual.profile import Profile
from quad_bridge.virtual.receiver import Event, Receiver
from quad_bridge.virtual.simulation import Excited, fly
from quad_bridge.wire import Decoder
from quad_bridge.wire.axes import flip_attitude, flip_body, flip_control
from quad_bridge.wire.frames import Cycle
from quad_sysid.bags import read_bag, write_bag

SIZE = math.radians(12.0)


def square(seconds: float, period_s: float = 4.0, size: float = SIZE) -> np.ndarray:
    time = (np.arange(round(seconds * 250)) + 0.5) / 250.0
    return size * np.sign(np.sin(2 * np.pi * time / period_s))


def mixed(control: np.ndarray, idle: float) -> tuple[np.ndarray, np.ndarray]:
    """Motors and what is given of U1..U4 (k, 4) by the firmware's quad_mix."""
    mix, out = library().quad_mix, np.zeros((len(control), 8), np.float32)
    turned = np.ascontiguousarray(control * [1.0, 1.0, -1.0, -1.0], np.float32)
    for row, result in zip(turned, out, strict=True):
        at = result.ctypes.data
        mix(ctypes.c_void_p(row.ctypes.data), ctypes.c_float(idle), ctypes.c_void_p(at),
            ctypes.c_void_p(at + 16))
    return out[:, :4].astype(float), out[:, 4:] * [1.0, 1.0, -1.0, -1.0]


def test_the_firmware_gives_up_yaw_then_throttle_and_roll_and_pitch_last():
    rng = np.random.default_rng(5)
    control = rng.uniform([0.0, -0.7, -0.7, -0.7], [1.0, 0.7, 0.7, 0.7], (2000, 4))
    control[0] = 0.9, 0.1, 0.0, 0.3
    idle = 0.05
    motors, given = mixed(control, idle)
    assert motors.min() >= idle - 1e-6
    assert motors.max() <= 1.0 + 1e-6
    assert X.control(motors) == pytest.approx(given, abs=1e-6)
    assert motors == pytest.approx(X.commands(control, 'yaw_first', idle), abs=2e-6)
    span = 2.0 * (np.abs(control[:, 1]) + np.abs(control[:, 2]))
    fits = span <= 1.0 - idle
    assert 0.2 < fits.mean() < 0.8
    assert given[fits, 1:3] == pytest.approx(control[fits, 1:3], abs=1e-6)
    with_throttle = fits & (control[:, 0] + 0.5 * span <= 1.0) \
        & (control[:, 0] - 0.5 * span >= idle)
    assert given[with_throttle, 0] == pytest.approx(control[with_throttle, 0], abs=1e-6)
    larger = ~fits  # one factor for both
    assert given[larger, 1] * control[larger, 2] == pytest.approx(
        given[larger, 2] * control[larger, 1], abs=1e-6)
    assert (given[:, 3] * control[:, 3] >= 0.0).all()  # yaw is never turned the other way
    assert (np.abs(given[:, 3]) <= np.abs(control[:, 3]) + 1e-6).all()


def test_an_effect_sees_time_rates_angles_thrusts_and_voltage_at_every_physics_step():
    seen = []

    def spy(t_s, rates, angles, thrusts, battery_v):
        seen.append((t_s, *rates, *angles, *thrusts, battery_v))
        return np.zeros(3)

    flight = fly(without_noise(Profile()), [Excited(0.0, square(1.0))], 1.0, 1, effect=spy)
    rows = np.array(seen)
    assert rows.shape == (1000, 12)
    assert rows[:, 0] == pytest.approx(np.arange(1000) * 0.001)
    assert rows[::4, 1:4] == pytest.approx(flight.true_rates)
    assert rows[::4, 4:7] == pytest.approx(flight.true_angles)
    assert rows[:, 7:11].sum(axis=1) == pytest.approx(1.2 * 9.80665, rel=1e-3)
    assert rows[::4, 11] == pytest.approx(flight.battery_v)


def test_gyro_noise_is_the_chips_behind_the_filter():
    flight = fly(Profile(), [], 20.0, 6)
    error = flight.rates[:, 1] - flight.true_rates[:, 1]
    # white noise through a 2nd-order Butterworth: equivalent bandwidth 1.11 x cut-off
    assert np.std(error) == pytest.approx(6.0e-4 * math.sqrt(1.11 * 42.0), rel=0.05)
    assert np.abs(flight.true_angles - flight.angles).max() < math.radians(1.0)


@pytest.mark.parametrize('frequency', [1.0, 20.0, 42.0])
def test_the_firmwares_gyro_filter_is_a_butterworth_of_42_hz(frequency):
    firmware, decoder = NativeFirmware(boot(Profile()).frame()), Decoder()
    pulses, slow = (1500.0,) * 9, (12.0, 0.0, 0.24, -0.38, 1013.0, math.nan)
    omega, taken = 2.0 * np.pi * frequency, []
    for cycle in range(750):
        samples = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 9.81], (4, 1))
        samples[:, 0] = np.sin(omega * (4 * cycle + np.arange(4)) * 1e-3)
        firmware.cycle(hil.sensors(4000 * cycle, pulses, False, slow, samples))
        taken += [x.gyro[0] for x in decoder.feed(firmware.send()) if isinstance(x, Cycle)]
    time = (4 * np.arange(250, 750) + 3) * 1e-3
    waves = np.stack((np.sin(omega * time), np.cos(omega * time)), axis=1)
    sine, cosine = np.linalg.lstsq(waves, np.array(taken[250:]), rcond=None)[0]
    s = 1j * frequency / 42.0
    assert complex(sine, cosine) == pytest.approx(
        1.0 / (s**2 + math.sqrt(2.0) * s + 1.0), abs=0.012
    )


def test_the_wire_process_and_the_array_flight_are_the_same_flight():
    events = (Event(0.6, 'roll', 0.5), Event(0.7, 'roll', 0.0), Event(0.9, 'aux1', 1.0),
              Event(0.95, 'aux1', -1.0))  # the kill switch has disarmed
    profile = Profile(receiver=Receiver(events=events))
    flight = fly(profile, [], 1.0, 9)
    endpoint, decoder = Endpoint(Aircraft(profile, seed=9), profile.receiver), Decoder()
    frames = [f for _ in range(250) for f in decoder.feed(endpoint.cycle())]
    cycles = [f for f in frames if isinstance(f, Cycle)]
    assert [f.cycle for f in cycles] == list(range(250))
    assert [f.time_us for f in cycles] == [4000 * k for k in range(250)]
    for name, flip in (('gyro', flip_body), ('accel', flip_body), ('rate_setpoint', flip_body)):
        own = {'gyro': 'rates', 'accel': 'acceleration'}.get(name, name)
        wire = np.array([flip(getattr(f, name)) for f in cycles])
        assert wire == pytest.approx(getattr(flight, own), rel=1e-6, abs=1e-6)
    angles = np.array([flip_attitude(f.attitude) for f in cycles])
    assert angles == pytest.approx(flight.angles, abs=1e-6)
    wrench = np.array([flip_control(f.control) for f in cycles])
    assert wrench == pytest.approx(flight.wrench, abs=1e-6)
    motors = np.array([f.motors for f in cycles])
    assert motors == pytest.approx(flight.motors, abs=1e-6)
    assert not motors[226:].any()
    assert flight.attitude_setpoint[160, 0] == pytest.approx(math.radians(15.0))


@pytest.mark.parametrize('injection', ['attitude', 'control'])
def test_a_flight_becomes_a_bag_of_the_contract(tmp_path, injection):
    tool = runpy.run_path(str(Path(__file__).resolve().parents[2] / 'tools/flight.py'))
    parts = [
        Excited(1.0, square(2.0, size=0.1), 'roll', injection, 'train', 'prbs', {'bits': 9}),
        Excited(3.5, square(1.0, size=0.1), 'roll', injection, 'validation', 'square'),
    ]
    flight = fly('paper', parts, 5.0, 1)
    record = read_bag(write_bag(tool['record_of'](flight), tmp_path / 'bag'))
    assert record.battery_v[::25] == pytest.approx(flight.battery_v[::25], rel=1e-6)
    arrays = ('rates', 'acceleration', 'motors', 'wrench', 'attitude_setpoint', 'rate_setpoint')
    for name in arrays:
        assert np.array_equal(getattr(record, name), getattr(flight, name)), name
    assert record.angles == pytest.approx(flight.angles, abs=1e-12)
    assert np.array_equal(np.nan_to_num(record.excitation), flight.excitation)
    roles = [(s.role, s.injection) for s in record.segments if s.role != 'idle']
    assert roles == [('train', injection), ('validation', injection)]
    assert next(s for s in record.segments if s.role == 'train').parameters['bits'] == 9
    gains = record.gains_at(5.0)
    assert (gains['roll.angle.kp'], gains['sensor.gyro_filter_hz']) == (3.0, 42.0)
