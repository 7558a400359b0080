"""What is easily lost between flights: throttle, turns of yaw, gyro filters, ranges."""

from dataclasses import replace

import numpy as np
import pytest
from flown_axis import DT, GAINS, SHORT, UNSEEN, Axis, fly

from quad_sysid.discover.accept import Unseen
from quad_sysid.discover.base import best_base
from quad_sysid.effects import EFFECTS
from quad_sysid.estimate.fit import Problem, stays_bounded
from quad_sysid.estimate.stored import completed, estimate_of, readings
from quad_sysid.identified import Identified
from quad_sysid.model.data import axis_data
from quad_sysid.pipeline.evaluate import evaluate, simulate
from quad_sysid.pipeline.identify import Options, identify
from quad_sysid.pipeline.step_b import closed_loop, loop_of
from quad_sysid.record import GainChange, Record, Segment

QUIET = {'gyro_noise': 0.002, 'torque_noise': 0.01}


def test_a_simulation_flies_at_the_throttle_and_the_voltage_of_the_flight(true_model):
    bent = estimate_of('thrust_curve', [0.5], settings={'throttle': 0.5})
    sagging = estimate_of('battery_sag', [2.0], settings={'reference_v': 12.0})
    model = replace(true_model, effects=(bent, sagging), mean_throttle=0.6, mean_battery_v=11.0)
    u = np.repeat([0.02, -0.02], 50)
    given = simulate(model, u, throttle=0.6, battery_v=11.0)
    np.testing.assert_array_equal(simulate(model, u), given)
    # the slope of the thrust over the command: 0.5 + m, beside 1 at the usual throttle
    plain = simulate(replace(model, effects=(), base=tuple(
        replace(p, value=0.0) if p.name == 'bias' else p for p in model.base)), u)
    moved = given - simulate(model, 0.0 * u)
    np.testing.assert_allclose(moved, (11.0 / 12.0) ** 2 * 1.1 * plain, atol=2e-3)


def test_yaw_that_turns_through_half_a_turn_keeps_its_reference():
    n = 500
    yaw = 3.0 + np.linspace(0.0, 0.6, n)
    wanted = (yaw + 0.1 + np.pi) % (2.0 * np.pi) - np.pi
    record = Record('bag', DT, np.zeros((n, 3)), np.zeros((n, 4)),
                    angles=np.stack([0 * yaw, 0 * yaw, yaw], axis=1),
                    attitude_setpoint=np.stack([0 * yaw, 0 * yaw, wanted], axis=1))
    np.testing.assert_allclose(record.external('yaw'), yaw + 0.1)
    blind = replace(record, angles=None, attitude_setpoint=np.stack([yaw, yaw, wanted], axis=1))
    assert np.abs(np.diff(blind.external('yaw'))).max() < 0.01


def test_the_simulated_loop_begins_at_the_angle_of_the_flight(plain_flight, plain_answer):
    turned = replace(plain_flight, angles=plain_flight.angles + 3.0,
                     attitude_setpoint=plain_flight.attitude_setpoint + 3.0)
    data = axis_data([turned], 'roll')
    found = closed_loop(plain_answer.model, loop_of([turned], 'roll'), data)
    assert found.rms_after < 0.05


def filtered(hz: float, seed: int, plan=SHORT) -> Record:
    flight = fly(Axis(**QUIET, gyro_filter_hz=hz), seed, plan)
    return replace(flight, gains=(GainChange(0.0, {**GAINS, 'sensor.gyro_filter_hz': hz}),))


@pytest.mark.usefixtures('quick')
def test_each_flight_has_its_own_gyro_filter():
    two = [filtered(40.0, 1), filtered(12.0, 2)]
    answer = identify(two, Options(axes=('roll',), effects=()))['roll']
    assert answer.model.value('delay') == pytest.approx(0.008, abs=0.001)
    assert answer.model.value('lag') == pytest.approx(0.042, abs=0.002)
    third = filtered(20.0, 3, UNSEEN)
    own = evaluate(answer.model, third)
    unknown = replace(third, gains=(GainChange(0.0, GAINS),))
    assert own.after < 0.5 * evaluate(answer.model, unknown).after
    model = Identified(**vars(answer.model))
    assert 100.0 - model.compare(third) < 0.5 * (100.0 - model.compare(unknown))
    at_s = third.segments[0].end_s  # one that is set there counts from there on
    later = GainChange(at_s, {'sensor.gyro_filter_hz': 9.0})
    changed = replace(third, gains=(*third.gains, later))
    cut_offs = axis_data([changed], 'roll').gyro_filters_hz
    assert np.flatnonzero(np.diff(cut_offs)) + 1 == pytest.approx(at_s / third.dt, abs=1)
    assert (cut_offs[0], cut_offs[-1]) == (20.0, 9.0)


def test_a_reference_is_of_one_unit(plain_flight):
    """Where training and validation are excited elsewhere, the training's unit counts."""
    train, validation = plain_flight.segments
    pushed = replace(validation, injection='control')
    mixed = replace(plain_flight, segments=(train, pushed),
                    excitation=np.full_like(plain_flight.rates, 0.01))
    reference = mixed.external('roll')
    inside, outside = slice(*mixed.span(train)), slice(*mixed.span(validation))
    np.testing.assert_array_equal(reference[inside], mixed.attitude_setpoint[inside, 0])
    assert np.isnan(reference[outside]).all()
    both = replace(mixed, segments=(train, Segment(**{**vars(pushed), 'role': 'train'})))
    assert both.external('roll') is None
    assert axis_data([plain_flight, replace(mixed, segments=(
        replace(train, injection='control'), pushed))], 'roll').reference is None


def test_what_runs_away_is_no_explanation_and_a_flight_says_where_it_leaves_the_training(
    true_model, plain_flight
):
    data = axis_data([plain_flight], 'roll')
    unseen = Unseen(data, data.validation)
    unstable = estimate_of('shape:damping:throttle', [-30.0] * 6, 'smooth', settings={
        'knots': tuple(np.linspace(0.4, 0.6, 6)), 'mean': (0.0,) * 6})
    spring = estimate_of('pendulum_stiffness', [-6.0])
    for effects, bounded in (((), True), ((spring,), True), ((unstable,), False)):
        model = completed(replace(true_model, effects=effects))
        assert stays_bounded(unseen.problem, model, unseen.predict(model)) is bounded
    told = evaluate(replace(true_model, ranges={'rate': (-0.2, 0.2), 'command': (-1.0, 1.0)}),
                    plain_flight).outside
    (rate,) = told
    assert (rate.signal, rate.low, rate.high) == ('rate', -0.2, 0.2)
    assert 1.0 < rate.seconds < 28.0
    assert rate.most == plain_flight.rates[250:, 0].max()


def with_gaps(flight: Record, gap_s: float, every_s: float, seed: int) -> Record:
    """The flight without its rates in gaps that come at random, as from a log of a slow card."""
    rates, length = flight.rates.copy(), round(gap_s / flight.dt)
    apart = np.random.default_rng(seed).exponential(every_s / flight.dt, 400) + length
    for start in np.cumsum(apart).astype(int):
        rates[start : start + length] = np.nan
    return replace(flight, rates=rates)


@pytest.mark.usefixtures('quick')
def test_a_log_with_gaps_says_what_is_missing(rubbed_flight):
    few = tuple(effect for effect in EFFECTS if effect.name == 'coulomb_friction')
    flight = with_gaps(rubbed_flight, 0.08, 0.4, 1001)
    model = identify([flight], Options(axes=('roll',), effects=few))['roll'].model
    assert [effect.name for effect in model.effects] == ['coulomb_friction']


def test_a_log_with_gaps_keeps_its_windows_and_blocks_and_its_errors_are_as_large_as_said():
    """Short gaps shut no window out; behind a gap the filter knows less than its variance says."""
    axis = Axis(torque_noise=0.3)
    truth = [axis.gain, axis.lag_s, 1e-3 * axis.delay_ms, axis.damping, axis.bias]
    off = []
    for seed in range(8):
        whole = fly(axis, seed, SHORT)
        full, data = (axis_data([one], 'roll') for one in (
            whole, with_gaps(whole, 0.08, 0.5, 1000 + seed)))
        assert data.windows(data.train).count >= 0.5 * full.windows(full.train).count
        problem = Problem(data, data.train)
        base = readings(problem, best_base(problem)).base
        off += [(one.value - true) / one.std for one, true in zip(base, truth, strict=True)
                if one.std]
    assert np.sqrt(np.mean(np.square(off))) < 1.4  # 40 of them; 2.0 where all samples count
    rates = whole.rates.copy()
    rates[::10] = np.nan  # lost throughout: blocks are of time, not of unbroken samples
    counts = [Problem(one, one.train).blocks(2.0).max() for one in (
        axis_data([whole], 'roll'), axis_data([replace(whole, rates=rates)], 'roll'))]
    assert counts[1] == pytest.approx(counts[0], abs=1)


@pytest.mark.usefixtures('quick')
@pytest.mark.parametrize(('reaches', 'sign', 'said'), [
    ('all of it', 1.0, True), ('all of it', -1.0, True), ('what is recorded', 1.0, False),
])
def test_a_command_whose_record_alone_is_limited_is_said(reaches, sign, said):
    """What the aircraft is sent may be limited, but a record that is cut off hides it."""
    def limited(u):
        return np.clip(u, -0.05, 0.05)

    axis = Axis() if reaches == 'all of it' else Axis(command=lambda _t, u, _v: limited(u))
    flight = fly(axis, 5, replace(SHORT, amplitude=0.5))
    record = replace(flight, control=limited(flight.control) * [0.0, sign, 1.0, 1.0] + [
        0.5, 0.0, 0.0, 0.0])
    answer = identify([record], Options(axes=('roll',), effects=()))['roll']
    assert ('stands at -0.05 or 0.05, its ends, for' in answer.reason) == said
    assert 'the order of the motors' not in answer.reason
    assert (answer.model.value('gain') < 0.0) == (sign < 0.0)
