"""The model is not a list of cases: another sensor, another motion, physics of another package."""

import math
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from flown_axis import LONGER, SHORT, Axis, fly
from scipy.signal import butter, lfilter, savgol_filter

from quad_sysid.discover.accept import Unseen, judge, p_value
from quad_sysid.discover.base import best_base, both_orders
from quad_sysid.discover.screen import candidates, screen
from quad_sysid.discover.search import Scored, SearchResult, extended, search
from quad_sysid.effects import EFFECTS
from quad_sysid.effects.events import PeriodicDelay, SampleAndHold
from quad_sysid.estimate import stored
from quad_sysid.estimate.fit import Fit, Problem, Tail, fit, slowness
from quad_sysid.estimate.stored import noise_of, readings
from quad_sysid.explain import explain
from quad_sysid.explain.ladder import Models, _within_prior
from quad_sysid.explain.projection import Projected
from quad_sysid.model.angle import led_by_gyro
from quad_sysid.model.data import axis_alone, axis_data, slice_of
from quad_sysid.model.effect import Part, required
from quad_sysid.model.flight import Flight
from quad_sysid.model.structure import NOISE, Structure
from quad_sysid.record import GainChange

DT = 0.01
CUT_OFF = (GainChange(0.0, {'sensor.gyro_filter_hz': 42.0}),)
"""A bag that states the gyro's filter."""


def friction(_t, rate, _angle):
    """Of 2 rad/s²."""
    return -2.0 * np.tanh(rate / 0.005)


TORQUES = [e for e in EFFECTS if e.name in ('quadratic_drag', 'coulomb_friction', 'dead_zone')]


def test_an_angle_is_led_by_the_gyro_where_the_first_stretch_is_shorter_than_a_second():
    t, noise = DT * np.arange(2000), np.random.default_rng(1).normal(0.0, 0.01, 2000)
    data = axis_alone(0.0 * t, np.cos(t), DT, [(0, 60), (100, 2000)])
    led = led_by_gyro(replace(data, angle=np.sin(t) + noise), data.rate)
    assert np.std((led - np.sin(t))[100:]) < 0.003


def judged(data, problem, found):
    ladder = explain(problem, found, candidates(problem, TORQUES)[0])
    return judge(Unseen(data, data.validation), problem, found, ladder)


def based(data):
    """The problem of the training, and the base, by whose errors it is measured."""
    problem = Problem(data, data.train)
    base = best_base(problem)
    problem.measure(base)
    return problem, base


def score_of(problem, base, label):
    """What this effect promises beside a fit."""
    parts, _ = candidates(problem, [e for e in EFFECTS if e.label == label])
    return screen(problem, base, parts)[0]


@pytest.fixture(scope='module')
def rubbed():
    """Data, problem and base of an axis with friction."""
    data = axis_data([fly(Axis(torque=friction), 1, SHORT)], 'roll')
    return data, *based(data)


def test_a_measured_position_is_what_is_fitted_where_the_speed_was_derived():
    """A position to 20 µrad, its slope over 20 ms to either side: no effect is made up of that."""
    flight = fly(Axis(gyro_noise=0.0), 5, SHORT)
    seen = flight.angles[:, 0] + 2e-5 * np.random.default_rng(5).standard_normal(flight.n)
    derived = savgol_filter(seen, 11, 3, deriv=1, delta=flight.dt)
    data = replace(axis_data([flight], 'roll'), rate=derived, angle=seen, derived_s=0.02)
    problem = Problem(data, data.train)
    verdict = judged(data, problem, search(problem, TORQUES))
    base = {p.name: p for p in readings(problem, verdict.chosen).base}
    assert verdict.verdict == 'no_missing_effect'
    for name, truth in (('gain', 450.0), ('lag', 0.042), ('delay', 0.008), ('damping', 0.4)):
        assert abs(base[name].value - truth) < 4.0 * base[name].std, name
        assert base[name].std < 0.15 * truth
    noise = savgol_filter(seen - flight.angles[:, 0], 11, 3, deriv=1, delta=flight.dt)
    assert verdict.noise_floor == pytest.approx(np.std(noise), rel=0.25)


def test_what_is_vague_of_one_motor_is_not_of_another(monkeypatch):
    structure = Structure(tuple(Part(e) for e in EFFECTS if e.label[:-1] == 'motor_lag/motor '
                                and e.label[-1] in '12'))
    theta, sizes = np.full(len(structure.specs), math.log(0.1)), np.full(len(structure.specs), 0.1)
    sizes[6] = 5.0
    monkeypatch.setattr(stored, 'shift_by_form', lambda *_: np.zeros(theta.size))
    problem = SimpleNamespace(data=SimpleNamespace(dt=0.004), zero_terms=[])
    fitted = SimpleNamespace(structure=structure, theta=theta, values=structure.natural(theta))
    (known,), (vague,) = readings(problem, fitted, np.diag(sizes**2)).effects
    assert (known.std, vague.std) == (pytest.approx(0.01), None)


def test_friction_is_found_where_the_rate_carries_no_noise():
    """As of a simulation, or of positions that were smoothed: no noise may run away with it."""
    flight = fly(Axis(torque=friction, gyro_noise=0.0, torque_noise=0.0), 1, SHORT)
    problem, base = based(axis_data([flight], 'roll'))
    best = search(problem, TORQUES).best
    assert best.structure.labels == ('coulomb_friction',)
    assert best.value('gain') == pytest.approx(450.0, rel=0.001)
    assert best.value('coulomb_friction.torque') == pytest.approx(2.0, rel=0.01)
    assert best.evidence > base.evidence + 1000.0


def test_nothing_is_unexplained_where_the_rate_carries_no_noise():
    """What is left are the rounding errors of the integration."""
    data = axis_data([fly(Axis(gyro_noise=0.0, torque_noise=0.0), 1, SHORT)], 'roll')
    problem, _ = based(data)
    verdict = judged(data, problem, search(problem, TORQUES))
    assert (verdict.verdict, verdict.reason) == ('no_missing_effect', '')
    assert verdict.before < 1e-5


def test_noise_of_a_filter_that_was_computed_once_a_cycle_is_no_vibration():
    """Such a filter leaves nothing of the noise near half the sample rate. The innovations are
    white, the noise has its size, and no line of vibration is needed."""
    flight = fly(Axis(gyro_filter_hz=42.0, gyro_noise=1e-4), 3, LONGER)
    rates = flight.rates.copy()
    white = np.random.default_rng(3).standard_normal(rates.shape[0])
    noise = 0.01 * lfilter(*butter(2, 42.0, fs=1.0 / flight.dt), white)
    rates[:, 0] += noise
    data = axis_data([replace(flight, rates=rates, gains=CUT_OFF)], 'roll')
    problem = Problem(data, data.train)
    base = best_base(problem)
    assert base.structure.lines == 0
    e = base.prediction.innovation[problem.rows]
    for lag in (1, 2, 3):
        assert abs(e[lag:] @ e[:-lag]) < 0.06 * (e @ e)
    assert noise_of(base).measured_rms == pytest.approx(np.std(noise), rel=0.1)


@pytest.mark.parametrize('size', [0.01, 0.0])
def test_slow_noise_of_the_gyro_is_no_motion(size):
    """Beside torque noise alone, effects that are not there would have to stand for it."""
    flight = fly(Axis(gyro_noise=0.003), 3, SHORT)
    fade = math.exp(-2.0 * math.pi * 5.0 * flight.dt)
    white = math.sqrt(1.0 - fade**2) * np.random.default_rng(3).standard_normal(flight.n)
    slow = size * lfilter([1.0], [1.0, -fade], white)
    rates = flight.rates + np.outer(slow, (1.0, 0.0, 0.0))
    data = axis_data([replace(flight, rates=rates)], 'roll')
    problem = Problem(data, data.train)
    base = search(problem, TORQUES).best
    noise = noise_of(base)
    assert not base.structure.parts
    assert any(width > hz for _, hz, width in noise.lines) == (size > 0.0)
    assert noise.measured_rms == pytest.approx(math.hypot(0.003, size), rel=0.25)
    gain = readings(problem, base).base[0]
    assert abs(gain.value - 450.0) < 3.0 * required(gain.std)


def test_what_the_validation_does_not_confirm_is_dropped_and_the_rest_is_kept(rubbed):
    """Friction is there; beside it the training gave a spring that the held-out data deny."""
    data, problem, base = rubbed
    fitted, labels = base, ('coulomb_friction', 'pendulum_stiffness')
    for label in labels:
        fitted = extended(problem, fitted, score_of(problem, fitted, label))
    wrong = fitted.theta.copy()
    wrong[fitted.structure.names.index('pendulum_stiffness.stiffness')] = 2.0
    both = fit(problem, fitted.structure, wrong, rate=fitted.rate, max_steps=0)
    unseen = Unseen(data, data.validation)
    assert np.std(unseen.errors(both)) < 0.5 * np.std(unseen.errors(base))
    found = SearchResult(base, (Scored(both, 9.0), Scored(base, 0.0)), {})
    verdict = judged(data, problem, found)
    assert verdict.chosen.structure.labels == labels[:1]
    assert verdict.after < 0.7 * verdict.before
    assert verdict.probabilities[0] > 0.9


def test_without_its_main_cause_no_finer_effect_is_claimed(monkeypatch):
    """Friction and a spring, both there; no model with one of them predicts the held-out data."""
    plant = Axis(torque=lambda t, rate, angle: friction(t, rate, angle) - 4.0 * angle)
    data = axis_data([fly(plant, 1, SHORT)], 'roll')
    problem, base = based(data)
    both, labels = base, ('coulomb_friction', 'pendulum_stiffness')
    for label in labels:
        both = extended(problem, both, score_of(problem, both, label))
    found = SearchResult(base, (Scored(both, 9.0), Scored(base, 0.0)), {})
    ladder = explain(problem, found, candidates(problem, TORQUES)[0])
    for denied, claimed in zip(labels, ((), labels[:1]), strict=True):
        monkeypatch.setattr(Unseen, 'p_value', lambda _, model, other, denied=denied: float(
            denied in {*model.structure.labels} - {*other.structure.labels}))
        verdict = judge(Unseen(data, data.validation), problem, found, ladder)
        assert [fit.structure.labels for fit in verdict.rung_fits] == [(), labels[:1], labels]
        assert verdict.chosen.structure.labels == claimed


def test_a_claim_stands_where_the_model_without_it_cannot_follow_the_flight(rubbed, monkeypatch):
    """No fit of it exists then; its free runs diverge, which speaks for the effect."""
    data, problem, base = rubbed
    fitted = extended(problem, base, score_of(problem, base, 'coulomb_friction'))
    found = SearchResult(base, (Scored(fitted, 9.0), Scored(base, 0.0)), {})

    def runs_away(_, model):
        theta = model.theta[: base.theta.size].copy()
        theta[3] = -1e4
        return [replace(model, structure=base.structure, theta=theta)]

    def fitted_or_not(self, model, own=Models.fitted):
        if model.theta[3] == -1e4:
            raise FloatingPointError
        return own(self, model)

    monkeypatch.setattr(Models, 'each_left_out', runs_away)
    monkeypatch.setattr(Models, 'fitted', fitted_or_not)
    verdict = judged(data, problem, found)
    assert verdict.chosen.structure.labels == ('coulomb_friction',)
    assert verdict.claims[0].p_value < 0.01


def test_windows_that_all_speak_for_the_commands_are_few_but_enough():
    """Of the plain axis, flown for 7.5 s: neighbours are alike by chance, 0.55."""
    scores = np.array([0.76, 0.7, 0.41, 0.5, 0.99, 0.96, 0.99, 0.98, 0.96, 0.86, 0.58, 0.43, 0.68])
    assert p_value(scores) < 0.03
    assert p_value(-scores) > 0.97


def test_a_gust_at_an_angle_is_no_coupling_and_its_twin_is():
    """Pitch is another flight in the same gusts; its feedback answers them as roll's does. The
    twin is a coupling in calm air."""
    rng = np.random.default_rng(3)
    fade = math.exp(-DT / 0.4)
    gust = lfilter([math.sqrt(1.0 - fade**2)], [1.0, -fade], rng.standard_normal(4000))

    def found(coefficient, wind, plan):
        def blown(t):
            return wind * gust[int(t / DT)]

        pitch = fly(Axis(torque=lambda t, _r, _a: 0.8 * blown(t)), 7, plan)
        turned, asked = pitch.rates[:, 0], pitch.control[:, 1]

        def torque(t, _rate, _angle):
            return blown(t) + coefficient * turned[min(int(t / pitch.dt), turned.size - 1)]

        roll = Axis(torque=torque, other_rates=lambda t: (turned, 0.0 * t),
                    other_commands=lambda t: (asked, 0.0 * t))
        data = axis_data([fly(roll, 1, SHORT)], 'roll')
        tried = [e for e in EFFECTS if e.name in ('gyroscopic_coupling', 'cross_axis_input')]
        answer = search(Problem(data, data.train), tried)
        return {part.effect.name for part in answer.best.structure.parts}, answer.reasons

    still = replace(SHORT, reference=np.zeros(round(SHORT.seconds / 0.004)))
    names, reasons = found(0.0, 2.0, still)
    assert names == set()
    assert 'the same gusts' in reasons['gyroscopic_coupling/other axis 1']
    assert 'gyroscopic_coupling' in found(3.0, 0.0, SHORT)[0]


def test_a_law_that_another_one_hides_is_found_beside_it():
    """Drag beside friction, which the damping hides alone; no curve over the rate for both."""
    def torque(_t, rate, _angle):
        return -0.18 * np.tanh(rate / 0.018) - 0.57 * rate * abs(rate)

    data = axis_data([fly(Axis(torque=torque), 1, SHORT)], 'roll')
    tried = [e for e in EFFECTS
             if e.label in ('coulomb_friction', 'quadratic_drag', 'shape:rate/smooth')]
    best = search(Problem(data, data.train), tried).best.structure
    assert set(best.labels) == {'coulomb_friction', 'quadratic_drag'}


@pytest.mark.parametrize(('changes', 'label', 'truth'), [
    ({'torque': lambda t, *_: 2.0 if 6.77 < t < 7.9 else 0.0}, 'event/torque for a while',
     (6.77, 1.13, 2.0)),
    ({'torque': lambda t, *_: 0.8 if t > 7.27 else 0.0}, 'step_event/torque', (7.27, 0.8)),
    ({'command': lambda t, u, _: 0.8 * u if t > 8.7 else u}, 'step_event/gain', (8.71, -0.2)),
])
def test_what_happens_at_a_time_is_found_wherever_it_falls(changes, label, truth):
    """Between the times of a grid, and outside the part on which many starts are tried first."""
    data = axis_data([fly(Axis(**changes), 3, LONGER)], 'roll')
    events = [e for e in EFFECTS if e.name in ('event', 'step_event')]
    best = search(Problem(data, data.train), events).best
    assert best.structure.labels == (label,)
    assert best.values[5] == pytest.approx(truth[0], abs=0.05 if 'torque' in label else 0.3)
    assert best.values[6 : 5 + len(truth)] == pytest.approx(truth[1:], rel=0.15)


def test_an_event_is_as_probable_however_late_the_excitation_began(monkeypatch):
    """Ten minutes on the ground before it are none of the event's prior, nor of the ladder's."""
    flown, late = fly(Axis(torque=lambda t, *_: 0.8 if t > 7.27 else 0.0), 3, LONGER), 600.0
    data = axis_data([flown], 'roll')
    evidence = []
    for begin in (0.0, late):
        monkeypatch.setattr(type(data), 'clock', property(
            lambda seen, begin=begin: begin + seen.whole[1] * seen.dt))
        problem, base = based(data)
        score = score_of(problem, base, 'step_event/torque')
        found = extended(problem, base, score)
        assert found.values[5] == pytest.approx(begin + 7.27, abs=0.05)
        assert _within_prior(Projected(found.structure, found.theta, np.zeros(0)))
        evidence.append(found.evidence - base.evidence)
    assert evidence[0] > 20.0
    assert evidence[0] - evidence[1] < math.log(late / 30.0) + 1.0


def test_of_a_long_flight_a_search_sees_blocks_and_what_leads_is_fitted_on_all(
    rubbed, monkeypatch
):
    _, problem, base = rubbed
    monkeypatch.setattr('quad_sysid.discover.search.SEARCHED', 3000)
    part = problem.shortened(3000, 6)
    assert 2000 < part.rows.size <= 3000
    assert np.ptp(part.data.clock) > 0.9 * np.ptp(problem.data.clock)
    few = [e for e in EFFECTS if e.label in ('coulomb_friction', 'quadratic_drag')]
    found = search(problem, few)
    assert found.best.structure.labels == ('coulomb_friction',)
    assert found.best.rate.size == problem.data.rate.size
    assert found.base.log_posterior == pytest.approx(base.log_posterior, abs=0.1)


def test_a_delay_by_another_clock_is_the_same_in_segments_that_are_joined():
    flown = fly(Axis(), 4, SHORT)
    whole = axis_data([flown], 'roll')
    spans = (300, 1300), (2000, 3000)
    torn = slice_of(whole, spans)
    at = np.concatenate([np.arange(a + 20, b - 20) for a, b in spans])
    here = np.concatenate([np.arange(20, 980), np.arange(1020, 1980)])
    for effect, p in ((PeriodicDelay(), np.r_[1.3, np.full(12, 0.002)]),
                      (SampleAndHold(), np.array([47.0, 0.4]))):
        base = np.array([450.0, 0.0, 0.02, 0.4, 0.0])
        one, other = (Flight(d, d.stretches).driven(Structure((Part(effect),)), np.r_[base, p])[0]
                      for d in (whole, torn))
        np.testing.assert_allclose(other[:, here], one[:, at], atol=1e-12)
        plain = Flight(whole, whole.stretches).driven(Structure(), base)[0]
        assert np.std(one - plain) > 0.1 * np.std(plain)


def test_the_clock_of_motors_that_hold_a_command_is_found_in_a_flight_of_some_length():
    """There a step of the derivative by its frequency must not turn it by radians."""
    kept = [0.0]

    def held(t, u, _volts):
        if round(t / 0.004) % 5 == 0:
            kept[0] = u
        return kept[0]

    problem, base = based(axis_data([fly(Axis(command=held), 4)], 'roll'))
    found = extended(problem, base, score_of(problem, base, 'shape:delay:time/held'))
    assert found.values[5] == pytest.approx(50.0, abs=3e-4)


def test_every_effect_moves_the_innovations_as_its_derivatives_say() -> None:
    """Of the base's and of its own parameters, along one random direction each; one of each kind.

    A command in whole steps has no derivative, nor has one that is held or late by turns, at whole
    cycles; nor has a load where it stops dead, so that it gets more play here. What moves the
    innovations by less than a thousandth of what the base does is left out.
    """
    rng = np.random.default_rng(1)
    flown = fly(Axis(
        volts=(12.6, 11.0), throttle=lambda t: 0.5 + 0.1 * np.sin(0.8 * t),
        other_commands=lambda t: (0.05 * np.sin(3.0 * t), 0.04 * np.sin(5.0 * t + 1.0)),
        other_rates=lambda t: (0.8 * np.sin(2.0 * t), 0.6 * np.sin(4.0 * t + 1.0)),
    ), 4, SHORT)
    data = axis_data([flown], 'roll')
    problem, base = based(data)
    of_a_kind = [e for e in EFFECTS if not re.search(r'motor [234]| 2$', e.label)]
    parts, untried = candidates(problem, of_a_kind)
    assert not untried
    wrong = {}
    for one in screen(problem, base, parts):
        structure = base.structure.plus(one.part)
        at = base.theta.size - len(base.structure.noise)
        start = one.starts[0].copy()
        if one.part.effect.label == 'mode:loose_load/turning':
            start[2:] = np.log(3.0), 1.0, 0.1
        theta = np.r_[base.theta[:at], start, base.theta[at:]]
        own = np.zeros(theta.size)
        own[at : at + one.starts[0].size] = 1.0
        steps = 1e-4 * np.minimum(problem.sizes(structure), 1e3)

        def predicted(theta, steps=None, structure=structure):
            problem.flight.rate = base.rate
            found = problem.flight.predict(structure, theta, sweeps=1, steps=steps)
            return (found.innovation if steps is None else found.jacobian)[problem.rows]

        jacobian, least = predicted(theta, steps), 0.0
        for of in (1.0 - own, own):
            way = of * steps * rng.standard_normal(theta.size)
            moved = 0.5 * (predicted(theta + way) - predicted(theta - way))
            size = np.linalg.norm(moved)
            if size > least and np.linalg.norm(moved - jacobian @ way) > 0.05 * size:
                wrong[one.part.effect.label] = one.part.effect
            least = 1e-3 * size
    by_turns = {'shape:delay:time/held', 'shape:delay:time/periodic'}
    assert set(wrong) - by_turns == {'shape:gain:command/steps'}


@pytest.mark.parametrize(('lag', 'damping', 'nats'), [
    (0.05, -2.0, 0.0), (0.05, 1.0, 0.08), (0.15, 5.0, 5.8), (1.0, 20.0, 24.9)])
def test_motors_slower_than_the_body_are_less_probable(lag, damping, nats):
    """The second and the last are both readings of a flight of PX4's own firmware."""
    assert slowness(lag, damping) == pytest.approx(-nats, abs=0.05)


@pytest.mark.parametrize('lead', [-1.0, 1.0])
def test_of_both_orders_of_lag_and_damping_the_likelier_is_taken(monkeypatch, lead):
    values = [160.0, math.log(0.05), math.log(0.01), 1.0, 0.0]
    theta = np.array([*values, *(spec.centre for spec in NOISE)])
    quick = Fit(Structure(), theta, Tail(1.0, 4.0), 100.0, 0.0, np.eye(9), np.eye(9), True, None)

    def refitted(_problem, structure, start, **_):
        at = start.copy()
        return replace(quick, structure=structure, theta=at, log_posterior=100.0 + lead)

    monkeypatch.setattr('quad_sysid.discover.base.fitted_from', refitted)
    monkeypatch.setattr(Fit, 'rate', None)
    chosen = both_orders(SimpleNamespace(zero_terms=[]), quick)
    assert (chosen.value('lag') * chosen.value('damping') > 1.0) is (lead > 0.0)
    assert chosen.value('gain') / chosen.value('lag') == pytest.approx(160.0 / 0.05)
