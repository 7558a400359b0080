"""What `look` measures, beside loops, noise and delays that are known: within 3 %."""

import json
import re
import shutil
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.signal import lfilter

from quad_sysid import cli, inspect
from quad_sysid.bags import write_bag
from quad_sysid.imports.clock import Stream
from quad_sysid.imports.log import ForeignLog
from quad_sysid.logview.flown import Flown, stretches
from quad_sysid.logview.measure import look_at
from quad_sysid.logview.read import look, of_log, of_record
from quad_sysid.logview.response import LoopResponse, feedback, measured_delay, plant_delay
from quad_sysid.logview.spectrum import frames
from quad_sysid.logview.step import ANGLE, responses
from quad_sysid.logview.words import sentences
from quad_sysid.loop.figures import step_figures
from quad_sysid.record import GainChange, Record

DT, SECONDS = 0.002, 60.0
GAIN, LAG_S, DELAY, DAMPING = 450.0, 0.03, 3, 0.5
"""rad/s² per unit, s, samples, 1/s."""
KP, KI, KD, D_HZ = 0.06, 0.3, 0.0008, 60.0
SHAKE_HZ = 140.0
ROTORS_HZ = 140.0
KNOWN = {'roll.rate.kp': KP, 'roll.rate.ki': KI, 'roll.rate.kd': KD, 'roll.rate.d_filter_hz': D_HZ}


class Loop:
    """A rate loop in plain Python: what flies, cycle by cycle."""

    def __init__(self, kp=KP):
        self.kp, self.w, self.x, self.i, self.d, self.last = kp, 0.0, 0.0, 0.0, 0.0, 0.0
        self.pipe = [0.0] * DELAY

    def cycle(self, wanted, noise, push):
        seen = self.w + noise
        error = wanted - seen
        self.i += KI * error * DT
        weight = DT / (DT + 1.0 / (2.0 * np.pi * D_HZ))
        self.d += weight * ((seen - self.last) / DT - self.d)
        self.last = seen
        u = self.kp * error + self.i - KD * self.d
        self.pipe.append(u)
        self.x += DT / LAG_S * (self.pipe.pop(0) - self.x)
        self.w += DT * (GAIN * self.x - DAMPING * self.w + push)
        return seen, u


@cache
def flown(seed=1, kp=(KP, KP), noise=0.01):
    """(set-point, rate, command) of a pilot's flight; the second half with another kp."""
    rng = np.random.default_rng(seed)
    n = round(SECONDS / DT)
    asked, k = np.zeros(n), 0
    while k < n:
        held = int(rng.uniform(0.08, 0.7) / DT)
        asked[k:k + held] = 3.0 * rng.standard_normal()
        k += held
    for k in range(1, n):  # as a stick moves
        asked[k] = asked[k - 1] + 0.15 * (asked[k] - asked[k - 1])
    white = noise * rng.standard_normal(n) + 0.03 * np.sqrt(2.0) * np.sin(
        2.0 * np.pi * SHAKE_HZ * DT * np.arange(n))
    pushes = 2.0 * rng.standard_normal(n)
    loops = Loop(kp[0])
    out = np.empty((n, 2))
    for k, now in enumerate(zip(asked.tolist(), white.tolist(), pushes.tolist(), strict=True)):
        if k == n // 2:
            loops.kp = kp[1]
        out[k] = loops.cycle(*now)
    return asked, out[:, 0], out[:, 1]


def truth(kp=KP):
    loops = Loop(kp)
    return step_figures([loops.cycle(1.0, 0.0, 0.0)[0] for _ in range(round(0.5 / DT))], DT)


FIXED = (GainChange(0.0, KNOWN),)


def record(asked, rate, command, gains=FIXED):
    n, zero = len(rate), np.zeros(len(rate))
    return Record(
        source='loop', dt=DT, t0_ns=10**18, rates=np.stack([rate, zero, zero], axis=1),
        control=np.stack([zero + 0.5, command, zero, zero], axis=1),
        rate_setpoint=np.stack([asked, zero, zero], axis=1), gains=gains,
        motors=0.5 + np.stack([command, command, -command, -command], axis=1),
        speeds=np.full((n, 4), 2.0 * np.pi * ROTORS_HZ))


@pytest.fixture(scope='module')
def flight():
    return record(*flown())


@pytest.fixture(scope='module')
def seen(flight):
    return look(flight)


def test_the_step_response_is_the_loops_own(seen):
    found, true = seen.whole.axes['roll'].rate_step, truth()
    assert found.windows > 50
    assert found.figures.rise_time_s == pytest.approx(true.rise_time_s, rel=0.03)
    assert found.figures.settling_time_s == pytest.approx(true.settling_time_s, rel=0.03)
    assert found.figures.overshoot_pct == pytest.approx(true.overshoot_pct, abs=1.0)
    assert (found.low <= found.mean + 1e-9).all()
    assert (found.high >= found.mean - 1e-9).all()


def test_the_controller_computes_at_its_own_cycle_and_not_at_the_logs(flight, seen):
    slow, quick = seen.whole.axes['roll'].loop, look_at(
        replace(of_record(flight, 'a bag'), loop_s=DT / 8)).whole.axes['roll'].loop
    f = slow.frequency_hz
    ratio = feedback(KNOWN, 'roll', f, DT / 8) / feedback(KNOWN, 'roll', f, DT)
    np.testing.assert_allclose(quick.loop, ratio * slow.loop)
    assert quick.phase_margin_deg > slow.phase_margin_deg + 0.1


def test_margins_and_delays_are_those_of_plant_and_gains(seen):
    found = seen.whole.axes['roll'].loop
    f = np.geomspace(0.5, 60.0, 4000)
    back = np.exp(-2j * np.pi * f * DT)
    # motor and rate by forward Euler, as they were flown
    plant = GAIN * back**DELAY * (DT / (LAG_S * (1 - back) + DT * back)) * (
        DT * back / (1 - back + DAMPING * DT * back))
    weight = DT / (DT + 1.0 / (2.0 * np.pi * D_HZ))
    loop = plant * (KP + KI * DT / (1 - back) + KD * weight * (1 - back) / DT / (
        1 - (1 - weight) * back))
    at = np.flatnonzero(np.abs(loop) > 1.0)[-1]
    crossed = np.flatnonzero(np.diff(np.sign(np.angle(loop[at:]))))[0] + at
    assert found.crossover_hz == pytest.approx(f[at], rel=0.03)
    assert found.phase_margin_deg == pytest.approx(180.0 + np.degrees(np.angle(loop[at])),
                                                   rel=0.03)
    assert found.gain_margin_db == pytest.approx(-20 * np.log10(np.abs(loop[crossed])), rel=0.06)
    assert found.sensitivity == pytest.approx(np.abs(1 / (1 + loop)).max(), rel=0.03)
    whole = next(d for d in found.delays if d.part == 'command to acceleration')
    phase = np.interp(found.delay_hz, f, np.unwrap(np.angle(plant * 2j * np.pi * f)))
    assert whole.milliseconds == pytest.approx(-1e3 * phase / (2 * np.pi * found.delay_hz),
                                               rel=0.03)


def test_spectra_have_the_power_that_was_put_in(seen):
    rng = np.random.default_rng(3)
    x = 0.5 * rng.standard_normal(200_000)
    found = frames(x, np.ones(len(x), bool), DT)
    assert np.mean(found.mean[1:-1]) == pytest.approx(0.25 * 2.0 * DT, rel=0.03)
    assert found.rms(50.0, 150.0) == pytest.approx(0.5 * np.sqrt(100.0 / 250.0), rel=0.03)
    peak = seen.whole.axes['roll'].gyro.peaks()[0]
    assert peak.frequency_hz == pytest.approx(SHAKE_HZ, rel=0.01)
    assert peak.rms == pytest.approx(0.03, rel=0.05)


def test_the_delay_of_a_filter_is_measured_where_both_sides_are_logged(flight):
    rate, weight = flight.rates[:, 0], DT / (DT + 1.0 / (2.0 * np.pi * 40.0))
    smooth = np.zeros_like(rate)
    for k in range(1, len(rate)):
        smooth[k] = smooth[k - 1] + weight * (rate[k] - smooth[k - 1])
    known = of_record(flight, 'a record')
    both = replace(known, rates=np.stack([smooth, 0 * rate, 0 * rate], axis=1),
                   rates_before=known.rates, before_dt=DT)
    delay = look(both).whole.axes['roll'].loop
    of = next(d for d in delay.delays if d.part == 'gyro filters')
    back = np.exp(-2j * np.pi * delay.delay_hz * DT)
    phase = np.angle(weight / (1 - (1 - weight) * back))
    assert of.milliseconds == pytest.approx(-1e3 * phase / (2 * np.pi * delay.delay_hz), rel=0.03)
    slow = replace(flight, gains=(GainChange(0.0, {'sensor.gyro_lowpass_delay_s': 0.04}),))
    for of_flight, stated in ((flight, True), (slow, False)):  # no rest of a negative delay
        rests = [d for d in look(of_flight).whole.axes['roll'].loop.delays if 'rest' in d.part]
        assert bool(rests) == stated
        assert all(rest.milliseconds > 0.0 for rest in rests)


@pytest.mark.parametrize(('late', 'at_hz'), [(5, 10.0), (20, 10.0), (20, 40.0), (30, 40.0)])
def test_a_pure_delay_is_measured_however_often_it_turns_the_phase(late, at_hz):
    """Within 0.5 %: what a frame of 2 s has at its ends is not common to both signals."""
    white = np.random.default_rng(0).standard_normal(30_000)
    x = lfilter([0.1], [1.0, -0.9], white)
    y = np.concatenate((np.zeros(late), x[:-late]))
    found = measured_delay('part', x, y, np.ones(len(x), bool), 0.001, at_hz)
    assert found.milliseconds == pytest.approx(late, rel=0.005)
    f = np.arange(1.0, 60.0, 0.5)
    plant = np.exp(-2e-3j * np.pi * f * late) / (1j * f)
    loop = LoopResponse(f, plant, np.ones_like(f), 5.0, 1.0, 5.0, plant=plant)
    assert 1e3 * plant_delay(loop, at_hz) == pytest.approx(late, rel=1e-6)


def test_each_set_of_gains_is_measured_by_itself():
    signals = flown(seed=2, kp=(0.04, 0.09))
    changes = (GainChange(0.0, {**KNOWN, 'roll.rate.kp': 0.04}),
               GainChange(SECONDS / 2, {**KNOWN, 'roll.rate.kp': 0.09}))
    found = look(record(*signals, gains=changes))
    assert [p.stretch.changed for p in found.parts][1] == ('roll.rate.kp',)
    for part, kp in zip(found.parts, (0.04, 0.09), strict=True):
        figures = part.axes['roll'].rate_step.figures
        assert figures.rise_time_s == pytest.approx(truth(kp).rise_time_s, rel=0.03)
    assert len(found.plot('step_by_gains').axes[0].lines) == 1 + 2
    assert np.isnan(found.whole.axes['roll'].loop.phase_margin_deg)


def test_a_log_without_commands_is_looked_at_all_the_same(flight, seen, tmp_path):
    t = DT * np.arange(flight.n)
    motors = np.tile(0.3 + 0.4 * t / t[-1], (4, 1)).T
    found = look(of_log(ForeignLog(
        'log', 'a log', rates=Stream(t, flight.rates), motors=Stream(t, motors),
        rate_setpoint=Stream(t, flight.rate_setpoint))))
    assert 'it cannot be identified: ' in found.flown.warnings[0]
    (mine, whole) = (one.whole.axes['roll'].rate_step for one in (found, seen))
    assert mine.figures.rise_time_s == pytest.approx(whole.figures.rise_time_s, rel=0.01)
    low, high = found.plot('throttle').axes[0].get_xlim()
    assert (low, high) == pytest.approx((0.3, 0.7), abs=0.03)
    assert 'Gyro spectrum over throttle' in found.save(tmp_path / 'page.html').read_text()


def test_gains_that_fly_for_moments_are_no_stretch():
    n = 5000
    still = Flown('x', 'a log', 0.004, np.zeros((n, 3)), np.ones(n, bool), ('roll',), gains=(
        GainChange(0.0, {'roll.rate.kp': 0.1}), GainChange(6.0, {'roll.rate.kp': 0.2}),
        GainChange(7.0, {'roll.rate.kp': 0.3})))
    assert [(s.start_s, s.end_s) for s in stretches(still)] == [(0.0, 6.0), (6.0, 20.0)]


def test_nothing_is_stated_of_a_rate_that_does_not_follow(seen):
    rng = np.random.default_rng(5)
    n = len(seen.flown.rates)
    deaf = record(seen.flown.rate_setpoint[:, 0], rng.standard_normal(n), rng.standard_normal(n))
    one = look(deaf).whole.axes['roll']
    assert one.rate_step is None
    assert one.loop is None


def test_a_rate_that_follows_late_is_late_by_its_latency():
    asked = flown(noise=0.0)[0]
    (one,) = look(record(asked, np.roll(asked, 10), asked)).whole.axes['roll'].tracking
    assert one.latency_s == pytest.approx(10 * DT)
    assert one.error_rms_delayed < 0.01 * one.error_rms
    drifts = np.linspace(0.0, 1.0, len(asked))  # nothing follows it, and any delay helps a little
    (none,) = look(record(drifts, 1e-3 * asked, 1e-3 * asked)).whole.axes['roll'].tracking
    assert np.isnan(none.latency_s)
    assert none.error_rms_delayed == none.error_rms


@pytest.mark.parametrize('hertz', [0.8, 1.5])
def test_a_slow_rate_that_still_rises_is_not_said_to_overshoot(hertz):
    """Critically damped, it never goes beyond its set-point; it takes longer than is looked at."""
    asked = flown()[0]
    keep = np.exp(-2.0 * np.pi * hertz * DT)
    rate = lfilter([0.0, (1.0 - keep)**2], [1.0, -2.0 * keep, keep**2], asked)
    rate += 0.01 * np.random.default_rng(2).standard_normal(len(rate))
    seen = look(record(asked, rate, 0.1 * asked))
    figures = seen.whole.axes['roll'].rate_step.figures
    assert np.isnan(figures.overshoot_pct)
    assert np.isnan(figures.rise_time_s)
    assert 'it still rises after 0.5 s' in str(seen)
    assert 'nan' not in str(seen)
    assert seen.tree()['axes']['roll']['steps'][0]['overshoot_pct'] is None


@pytest.mark.parametrize('hertz', [2.6, 6.2, 18.3])
def test_the_bandwidth_lies_between_the_lines_of_the_spectrum(hertz):
    asked = flown()[0]
    f = np.geomspace(0.5, 60.0, 20_000)
    keep = np.exp(-2.0 * np.pi * hertz * DT)
    back = np.exp(-2j * np.pi * f * DT)
    true = f[np.argmax(np.abs((1.0 - keep) / (1.0 - keep * back)) < np.sqrt(0.5))]
    rate = lfilter([1.0 - keep], [1.0, -keep], asked)
    assert look(record(asked, rate, 0.1 * asked)).whole.axes['roll'].loop.bandwidth_hz == \
        pytest.approx(true, rel=0.05)


def test_motors_that_the_mixer_holds_at_idle_are_at_their_limit():
    """The firmware lets no motor in flight go below `mixer.idle`."""
    n = 3000
    asked = np.sin(DT * np.arange(n))
    flight = record(asked, asked, 0.1 * asked, (GainChange(0.0, {'mixer.idle': 0.05}),))
    motors = np.full((n, 4), 0.5)
    motors[:300, 1] = 0.05
    flight = replace(flight, motors=motors)
    seen = look(flight)
    assert [m.at_zero_pct for m in seen.motors] == [0.0, pytest.approx(10.0, abs=0.1), 0.0, 0.0]
    assert 'never at their limits' not in str(seen)
    assert inspect(flight).motors_at_limit_pct == (0.0, pytest.approx(10.0), 0.0, 0.0)


def test_the_heading_of_a_log_without_commands_may_pass_south():
    n = 10_000
    time, zero = DT * np.arange(n), np.zeros(n)
    heading = np.pi + 0.5 * np.sin(0.6 * time)
    wanted = (heading + np.pi) % (2.0 * np.pi) - np.pi
    turned = np.roll(heading, 50)
    turned[:50] = heading[0]
    rate = np.gradient(turned, DT)
    log = ForeignLog(
        'log', 'a log', Stream(time, np.column_stack([rate, zero, rate])), None,
        angles=Stream(time, np.column_stack([zero, zero, turned])), axes=('yaw',),
        attitude_setpoint=Stream(time, np.column_stack([zero, zero, wanted])))
    seen = look_at(of_log(log))
    assert sentences(seen)[0].startswith('Yaw has no rate set-point in the log')
    (angle,) = seen.whole.axes['yaw'].tracking
    assert angle.error_rms < 0.05
    assert angle.latency_s == pytest.approx(50 * DT, rel=0.05)


def test_a_slow_log_says_nothing_of_noise_that_it_cannot_hold():
    asked, rate, command = (x[::20] for x in flown())  # 25 Hz
    flight = replace(record(asked, rate, command, ()), dt=20 * DT)
    seen = look(flight)
    assert seen.whole.axes['roll'].noise_rms is None
    assert seen.tree()['axes']['roll']['noise']['gyro']['rms_above_80_hz'] is None


def test_an_axis_is_measured_though_the_others_are_not(seen):
    flight = record(*flown())
    alone = look(replace(flight, rates=np.where([True, False, False], flight.rates, np.nan)))
    assert alone.flown.axes == ('roll',)
    assert alone.whole.axes['roll'].rate_step.figures == seen.whole.axes['roll'].rate_step.figures


def test_a_log_of_many_gaps_blames_the_gaps_for_what_it_does_not_show():
    asked, rate, command = flown()
    lost = np.random.default_rng(1).random(len(rate)) < 0.01
    seen = repr(look(record(asked, np.where(lost, np.nan, rate), command)))
    assert 'gaps come too often for a step response' in ' '.join(seen.split())
    assert 'moves too little' not in seen


def test_white_noise_has_no_peaks_however_short():
    rng = np.random.default_rng(0)
    for seconds in (0.6, 1.0, 1.5, 3.0):
        white = rng.standard_normal(round(seconds / DT))
        assert not frames(white, np.ones(len(white), bool), DT).peaks()


@pytest.mark.parametrize('setpoint', [0.7, 30.0])
def test_nothing_is_stated_of_a_set_point_that_stands_still(setpoint):
    """Its correlations are rounding, of either sign, or nothing."""
    rates = 1e-4 * np.random.default_rng(0).standard_normal(60_000)
    still = np.full(60_000, setpoint)
    assert not responses(still, rates, np.ones(60_000, bool), 0.005, ANGLE)


def test_no_class_is_stated_whose_windows_hold_no_low_frequencies():
    """A chirp whose size falls: its small set-points are its fast ones, and say no level."""
    time = DT * np.arange(round(SECONDS / DT))
    span = 20.0
    sweep = np.mod(time, span)
    phase = 2.0 * np.pi * 0.5 * (80.0 ** (sweep / span) - 1.0) * span / np.log(80.0)
    asked = np.radians(120.0) * np.sin(phase) / np.hypot(1.0, 0.5 * 80.0 ** (sweep / span) / 6.0)
    loops, rng = Loop(), np.random.default_rng(1)
    rate = np.array([loops.cycle(one, *push)[0] for one, push in zip(
        asked, rng.standard_normal((len(time), 2)) * [0.01, 10.0], strict=True)])
    found = responses(asked, rate, np.ones(len(time), bool), DT)
    assert [one.amplitude for one in found] == ['all', 'medium']
    assert found[0].figures.overshoot_pct == pytest.approx(truth().overshoot_pct, abs=2.0)


def test_set_points_of_a_damaged_log_that_nothing_can_follow_are_dropped(seen):
    flown = seen.flown
    broken = flown.rate_setpoint[:, 0].copy()
    broken[[500, 900]] = 1e25, -1e30
    found = look(record(broken, flown.control[:, 1], flown.rates[:, 0]))
    assert found.whole.axes['roll'].tracking[0].setpoint_rms < 70.0
    assert any('from 2 samples' in one for one in found.flown.warnings)


def test_the_command_prints_the_answer_first_and_writes_a_page(
    seen, tmp_path, monkeypatch, printed, refused, refusal
):
    monkeypatch.chdir(tmp_path)
    write_bag(record(*(x[: len(x) // 2] for x in flown())), tmp_path / 'flight')
    out = printed(cli.main, 'look', 'flight')
    assert out.startswith('Roll follows a step of its rate set-point in ')
    text = (tmp_path / 'flight_look.html').read_text()
    assert len(text.encode()) < 2_000_000
    assert not re.search(r'(?:src|href)="(?!data:|#)', text)
    shutil.copy(next((tmp_path / 'flight').glob('*.mcap')), '_5$_6$.v1.mcap')
    both = printed(cli.main, 'look', 'flight', '_5$_6$.v1.mcap', 'flight', '--out', 'both.html')
    assert re.search(r'roll +flight \(3\) +\d', both)
    assert (tmp_path / 'both.html').stat().st_size < 2_000_000
    assert '> _5$_6$.v1.mcap</text>' in (tmp_path / 'both.html').read_text()
    tree = json.loads(printed(cli.main, 'look', '_5$_6$.v1.mcap', '--json'))
    assert (tmp_path / '_5$_6$.v1_look.html').exists()
    assert tree['axes']['roll']['steps'][0]['rise_time_s'] == pytest.approx(
        truth().rise_time_s, rel=0.03)
    (tmp_path / 'mine.html').write_text('notes')
    assert 'is no page of quad-sysid' in refused(cli.main, 'look', 'flight', '--out', 'mine.html')
    assert 'nothing' in refusal(seen.plot, 'nothing')
