"""An effect is one thing wherever it acts: cycle by cycle, along a flight, free, in a loop.

Each effect of the table flies in a plant of its own with seeded inputs; the flight that comes out
is what filter and free run get, without any noise.
"""

import functools
import math
from dataclasses import replace
from unittest import mock

import control as control_system
import numpy as np
import pytest
from flown_axis import model_of

from quad_sysid.contract import motors_from_wrench
from quad_sysid.craft import X
from quad_sysid.effects import EFFECTS
from quad_sysid.effects.hidden import Linear, Load, Memory
from quad_sysid.estimate.stored import estimate_of
from quad_sysid.exports import to_control
from quad_sysid.identified import Identified
from quad_sysid.loop.cascade import CascadeGains, closed_loop_radius
from quad_sysid.loop.from_model import loop_plant, not_in_the_loop, share_outside, why_outside
from quad_sysid.loop.linear import STILL, Level, loops_of
from quad_sysid.loop.plant import Flying
from quad_sysid.loop.simulation import running, simulate_cascade
from quad_sysid.model import AxisModel, EffectEstimate
from quad_sysid.model.data import AxisData, Windows
from quad_sysid.model.effect import ActingEffect, Drive, Effect, Part, Spec
from quad_sysid.model.flight import Flight, Prediction
from quad_sysid.model.plant import Plant
from quad_sysid.model.structure import Structure, coordinates
from quad_sysid.model.traced import Listing, Untraceable
from quad_sysid.units import Units
from quad_tuning.bounds import check_inside
from quad_tuning.errors import DesignRefusedError

DT, N = 0.004, 250
BASE = np.array([120.0, 0.04, 0.0093, 0.8, 0.2])
QUIET = np.array([1.0, 1.0, 0.3, 0.1])
NO_GAINS = CascadeGains(0.0, 0.0, 0.0, 0.0)


def flight_of_commands() -> AxisData:
    """Everything moves; the command changes every few cycles. The rate is still to come."""
    rng, t = np.random.default_rng(3), DT * np.arange(N)
    held = np.repeat(rng.uniform(-0.08, 0.08, N // 10), 10)
    control = np.stack([0.5 + 0.05 * np.sin(2.0 * t), held + 0.02 * np.sin(9.0 * t),
                        0.05 * np.sin(4.0 * t), 0.04 * np.cos(3.0 * t)], axis=1)
    control[:4, 1:] = 0.0
    others = np.stack([0.4 * np.sin(3.0 * t), 0.3 * np.cos(5.0 * t)], axis=1)
    return AxisData(
        axis='roll', dt=DT, rate=np.zeros(N), angle=0.2 * np.sin(8.0 * t), control=control,
        motors=motors_from_wrench(control), other_rates=others, other_angles=0.5 * others,
        battery_v=12.0 - 0.3 * t, gyro_filter_hz=40.0, stretches=((0, N),), train=((0, N),),
        validation=(),
    )


def parameters(effect) -> np.ndarray:
    """Small, different from each other, and where the effect does something."""
    p = effect.centre()
    for j, spec in enumerate(effect.parameters):
        if spec.spread is None or not spec.log:
            size = {'rad/s²': 0.4, '1/s': 0.3, 's': 0.002}.get(spec.unit, 0.1)
            p[j] = p[j] + size * (1.0 + 0.3 * j) * (-1.0) ** j if p[j] == 0.0 else p[j]
        if spec.positive or spec.name == 'share' or effect.term == 'friction':
            p[j] = abs(p[j])
        if effect.term == 'friction' and effect.states and j:
            p[j] = -p[j]  # it is cold at the start
    names = {spec.name: j for j, spec in enumerate(effect.parameters)}
    for name, value in {'transition': 0.3, 'stribeck_rate': 0.5, 'waves': 8.0, 'time': 0.8,
                        'duration': 0.3, 'upper': 0.55, 'lower': 0.47, 'slew': 1.0,
                        'slow_time_constant': 0.1}.items():
        if name in names:
            p[names[name]] = value
    return p


def flown(plant: Plant, data: AxisData) -> tuple[AxisData, np.ndarray, np.ndarray | None]:
    """The flight that the plant makes of the commands, its true angle, and what it begins with."""
    known = Flight(data, data.stretches).commanded(np.r_[BASE])
    x = plant.begin(known.at(np.arange(1)), np.zeros(1), np.zeros(1))
    (begin,) = x.turning.hidden or (None,)
    rates, angles = np.zeros(N), np.zeros(N)
    for k in range(N):
        rates[k], angles[k] = plant.measured(x)[0][0], x.turning.angle[0]
        x = plant.step(x, known.at(np.array([k])))
    return replace(data, rate=rates), angles, begin


@functools.cache
def plain_rate() -> np.ndarray:
    """Of the same flight where no effect acts."""
    data = flight_of_commands()
    sensor = Flight(data, data.stretches).sensor
    plant = Plant(Structure(), np.r_[BASE, QUIET], DT, sensor, X, 0, rounds=6)
    return flown(plant, data)[0].rate


def followed(flight: Flight, structure: Structure, theta: np.ndarray, sweeps: int) -> Prediction:
    """The filter's pass with its correction switched off."""
    exact = flight.filters_of

    def deaf(*given):
        return tuple(replace(one, gain=0.0 * one.gain) for one in exact(*given))

    flight.filters_of = deaf
    flight.rate = np.zeros(N)
    return flight.predict(structure, theta, sweeps=sweeps)


SHAPED = [e for e in EFFECTS if not e.wanders and max(e.motors, default=0) < 4]
FIRST = [*{(type(e), e.kind == 'shape' or e.name, e.term, e.states, e.moves_command): e
           for e in reversed(SHAPED)}.values()][::-1]
"""One of each kind; all of them fly in make test-long."""


def of_the_table(effects: list) -> list:
    """All effects, of which make test flies the first of each kind."""
    return [pytest.param(e, id=e.label, marks=() if e in FIRST else pytest.mark.long)
            for e in effects]


@pytest.mark.parametrize('effect', of_the_table(SHAPED))
def test_cycle_by_cycle_compiled_along_arrays_and_in_a_free_run_an_effect_does_the_same(effect):
    data = flight_of_commands()
    rehearsed = replace(data, rate=0.5 * np.sin(4.0 * DT * np.arange(N)))
    settings = effect.prepare(rehearsed)
    assert not isinstance(settings, str), settings
    p = parameters(effect)
    structure = Structure((Part(effect, settings),))
    values = np.r_[BASE, p, QUIET]
    plant = Plant(structure, values, DT, Flight(data, data.stretches).sensor, X, 0, rounds=6)
    record, angles, begin = flown(plant, data)
    flying = Flying(plant, Flight(data, data.stretches).commanded(BASE), steady=False)
    assert not running(flying).calls
    compiled = simulate_cascade(flying, NO_GAINS, np.zeros(N), DT,
                                control_excitation=data.command)
    np.testing.assert_allclose(compiled.rate, record.rate, atol=1e-9)
    assert np.abs(record.rate - plain_rate()).max() > 1e-5
    theta = coordinates(structure.specs, values)
    flight = Flight(record, record.stretches)
    flight.gyro, flight.late = None, 0.0 * flight.late

    def integrated(part, s, own):  # from rest, and by the rate that the filter has, not the gyro's
        if not effect.states:
            return s
        begun = np.repeat(begin, N, axis=1) if isinstance(effect, Linear | Load) else None
        return replace(s, hidden=part.effect.trace(s, own, settings, record.stretches, begun))

    flight.hidden = integrated
    flight.angle = angles
    ran = followed(flight, structure, theta, sweeps=25)
    np.testing.assert_allclose(ran.states[:, 2], record.rate, atol=1e-9)
    every = Windows(np.array([0]), N)
    errors = flight.run(structure, theta, every, prediction=ran, rounds=6).errors
    assert np.abs(errors).max() < 1e-9


class Branches(Effect):
    """Laws of a user that compiled code has no words for: a branch, `clip`, an arc tangent."""

    name, states, signals = 'branches', 2, ('rate', 'angle', 'history')
    parameters = (Spec('torque', 'rad/s²'),)

    def torque(self, s, p, _):
        pull = s.hidden[0] - s.hidden[1] if s.rate[0] > 0.1 else np.arctan(s.angle)
        return -p[0] * (pull + np.arctan(3.0 * s.rate))

    def advance(self, x, s, *_):
        late = s.hidden.clip(-9.0, 9.0)
        return x + s.dt * np.stack([np.arctan(s.angle) - late[0], np.arctan(s.rate - late[1])])


class Bends(Effect):
    """The same before the torque, of the command and of a motor that is slower one way."""

    name, signals = 'bends', ('command',)
    parameters = (Spec('width', '1', spread=0.1),)

    def command(self, s, p, _):
        return p[0] * np.arctan(s.sent.clip(-9.0, 9.0) / p[0])

    def actuate(self, drive, s, *_):
        slow = 2.0 if s.sent[0] < 0.0 else 1.0
        return Drive(drive.commands, drive.row, slow * drive.lag, ages=drive.ages,
                     fraction=drive.fraction)


class Creeps(Effect):
    """A user's memory whose law compiled code has all words for; the last is the first, late."""

    name, states, signals = 'creeps', 3, ('rate', 'angle', 'history')

    def advance(self, x, s, *_):
        gone = np.where(s.rate > 0.1, x[0] - x[1], np.tanh(x[0] + s.angle))
        return np.stack([x[0] + s.dt * (s.rate - gone), np.maximum(x[1], 0.9 * gone), x[0]])


def test_a_memory_along_a_flight_is_its_law_cycle_by_cycle_compiled_where_that_is_possible():
    data = replace(flight_of_commands(), rate=np.sin(4.0 * DT * np.arange(N)))
    s = Flight(data, data.stretches).commanded(BASE).replaced(rate=data.rate, angle=data.angle)
    spans = (0, 100), (110, N)
    for effect, called in ((Creeps(), 0), (Branches(), 1)):
        begun = np.full((effect.states, N), 0.2)
        first = [begun[:, 0]] * 2
        with mock.patch.object(type(effect), 'cycles', side_effect=effect.cycles) as plain:
            along = effect.trace(s, BASE[:1], {}, spans, begun)
        assert plain.call_count == called
        expected = effect.cycles(s, BASE[:1], {}, spans, first)
        np.testing.assert_allclose(along, expected, atol=1e-12)


@pytest.mark.parametrize(('effect', 'p', 'turns'), [(Creeps(), (), 1), (Branches(), (4.0,), 101)])
def test_a_free_run_is_made_cycle_by_cycle_compiled_where_that_is_possible(effect, p, turns):
    data = replace(flight_of_commands(), rate=0.5 * np.sin(4.0 * DT * np.arange(N)))
    structure, windows = Structure((Part(effect),)), Windows(np.array([10, 60]), 100)
    theta = coordinates(structure.specs, np.r_[BASE, p, QUIET])
    flight = Flight(data, data.stretches)
    prediction = flight.predict(structure, theta)
    with mock.patch.object(Plant, 'turn', autospec=True, side_effect=Plant.turn) as turn:
        run = flight.run(structure, theta, windows, prediction=prediction)
    assert turn.call_count == turns
    with mock.patch.object(Listing, 'places', side_effect=Untraceable('it')):
        expected = flight.run(structure, theta, windows, prediction=prediction)
    for one, other in zip((*run[:3], *run.hidden), (*expected[:3], *expected.hidden), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)
    assert np.abs(run.hidden[0]).max() > 1e-3


@pytest.mark.parametrize(('effect', 'p'), [(Branches(), 4.0), (Bends(), 0.04)])
def test_a_law_that_cannot_be_compiled_is_called_in_its_place(effect, p):
    data = flight_of_commands()
    sensor = Flight(data, data.stretches).sensor
    plant = Plant(Structure((Part(effect),)), np.r_[BASE, p, QUIET], DT, sensor, X, 0)
    flying = Flying(plant, Flight(data, data.stretches).commanded(BASE), steady=False)
    assert running(flying).calls
    called = simulate_cascade(flying, NO_GAINS, np.zeros(N), DT, control_excitation=data.command)
    np.testing.assert_allclose(called.rate, flown(plant, data)[0].rate, atol=1e-12)


def test_flights_at_once_are_each_as_alone():
    data, rng = flight_of_commands(), np.random.default_rng(2)
    sensor = Flight(data, data.stretches).sensor
    around = Flight(data, data.stretches).commanded(BASE)
    effects = [e for e in SHAPED if e.label in (
        'shape:lag:direction/smooth, motors', 'shape:throttle/smooth', 'mode:loose_load/turning')]

    def drawn(effect, p):
        part = Part(effect, effect.prepare(replace(data, rate=np.sin(4.0 * DT * np.arange(N)))))
        values = np.r_[BASE, p, QUIET] * rng.uniform(0.7, 1.4, BASE.size + p.size + QUIET.size)
        return Flying(Plant(Structure((part,)), values, DT, sensor, X, 0), around, steady=False)

    some = [drawn(e, p) for _ in range(2) for e, p in (
        *((e, parameters(e)) for e in effects), (Bends(), np.array([0.04])))]
    assert len({running(one).kind for one in some}) == len(effects) + 1 == 4
    wanted, gusts = np.repeat([0.2, -0.1], N // 2), rng.standard_normal((len(some), N))
    sets = [replace(GAINS, angle_kp=3.0 + i, rate_kd=1e-3 * i, d_on_error=i % 3 == 0,
                    d_notch_hz=30.0, d_notch_bandwidth_hz=5.0 * (i % 2)) for i in range(8)]

    def flown(plants, gains, noise):
        return np.array(simulate_cascade(plants, gains, wanted, DT, noise, initial_rate=0.1))

    alone = np.stack([flown(*one) for one in zip(some, sets, 0.01 * gusts, strict=True)], axis=1)
    np.testing.assert_allclose(flown(some, sets, 0.01 * gusts), alone, atol=1e-12)
    for i in (0, 3):  # one plant in several winds, or with several gains; the last is in Python
        of_one = flown(some[i], sets[i], 0.01 * gusts[[5, i]])
        np.testing.assert_allclose(of_one[:, 1], alone[:, i], atol=1e-12)
        of_one = flown(some[i], [sets[5], sets[i]], 0.01 * gusts[i])
        np.testing.assert_allclose(of_one[:, 1], alone[:, i], atol=1e-12)


GAINS = CascadeGains.default('roll')


def estimated(effect, p: np.ndarray, settings=None) -> EffectEstimate:
    return estimate_of(effect.name, p, effect.variant, settings=settings, std=0.01)


def smooth(effect) -> bool:
    """Whether it has a slope in small motion, which is also what a loop is judged by."""
    steep = {'dead_zone', 'backlash', 'shape:lag:direction', 'saturation'}
    warms = isinstance(effect, Memory) and not effect.leans
    acting = ActingEffect(Part(effect), effect.centre())
    steep_lag = effect.term == 'lag' and effect.signals[0] == 'command'
    sought = type(effect).starts_by_residual is not Effect.starts_by_residual
    return not (steep_lag or effect.name in steep or sought
                or warms or effect.name == 'mode:hysteresis' or why_outside(acting))


@pytest.mark.parametrize('effect', of_the_table([e for e in SHAPED if smooth(e)]))
def test_in_small_motion_the_loop_is_the_plant(effect):
    data = flight_of_commands()
    settings = effect.prepare(replace(data, rate=0.5 * np.sin(4.0 * DT * np.arange(N))))
    flying = loop_plant(model_of(estimated(effect, parameters(effect), settings)))
    loops = loops_of([(flying, STILL)])
    u = 1e-8 * np.repeat([0.0, 1.0, -1.0, 1.0, 0.0], 30)
    still, moved = (
        simulate_cascade(flying, NO_GAINS, 0.0 * u, DT, disturbance=-flying.rest_acceleration,
                         control_excitation=given).rate for given in (0.0 * u, u)
    )
    expected, x = np.zeros(u.size), np.zeros(loops.b.shape[1])
    for k in range(u.size):
        expected[k] = loops.c[0, 0] @ x
        x = loops.a[0] @ x + loops.b[0] * u[k]
    np.testing.assert_allclose(moved - still, expected, atol=0.01 * np.abs(expected).max())


MODE = {'frequency': 6.0, 'damping_ratio': 0.06, 'in_phase': 0.1, 'quadrature': 0.05}
SECOND = {'frequency': 3.0, 'damping_ratio': 0.5, 'in_phase': 0.3, 'quadrature': -0.2}
FALLS = ('pendulum_stiffness', 'from the rate', [30.0, -12.0])


@pytest.mark.parametrize(('found', 'tolerance'), [
    ((), 0.03),
    ((('mode:second_order', '', list(SECOND.values())), ('resonance', '', list(MODE.values()))),
     0.03),
    ((('mode:second_lag', '', [0.02]),), 0.03),
    ((FALLS,), 0.03),
    ((('mode:slow_state', '', [0.3, 20.0]),), 0.03),
    ((('mode:loose_load', 'turning', [4.0, 4.0, 0.3, 0.0, 0.5]),), 0.15),
], ids=['base', 'two modes', 'second lag', 'falls', 'slow state', 'loose load'])
def test_the_edge_of_stability_by_margins_is_that_of_the_simulated_flight(found, tolerance):
    effects = tuple(estimate_of(name, p, variant) for name, variant, p in found)
    level: Level = (0.1, 0.01, 0.01)

    def unstable(gain: float) -> bool:
        loops = loops_of([(loop_plant(model_of(*effects, gain=gain)), level)])
        return bool(closed_loop_radius(GAINS, loops)[0] >= 1.0)

    low, high = 200.0, 4000.0
    while high / low > 1.005:
        middle = math.sqrt(low * high)
        low, high = (low, middle) if unstable(middle) else (middle, high)
    grows = [swings(model_of(*effects, gain=edge)) for edge in
             ((1.0 - tolerance) * low, (1.0 + tolerance) * low)]
    assert grows == [False, True]


def swings(model: AxisModel) -> bool:
    """Whether a small step of the angle ends in a swing that grows."""
    reference = np.where(np.arange(1200) < 20, 0.01, 0.0)
    u = simulate_cascade(loop_plant(model), GAINS, reference, DT).control
    late, early = np.ptp(u[-300:]), np.ptp(u[100:400])
    return bool(late > early or late > 0.1)


def test_what_a_loop_cannot_hold_is_named_and_refused_where_it_is_large():
    coupled, less = (estimate_of('gyroscopic_coupling', [2.0], f'other axis {which}')
                     for which in (1, 2))
    passing = estimate_of('periodic_disturbance', [1.0, 2.0, 0.0])
    ranges = {'command': (-0.1, 0.1), 'other rate 1': (-1.0, 8.0), 'other angle 1': (-0.1, 0.4)}
    model = replace(model_of(coupled, less, passing), ranges=ranges)
    assert not_in_the_loop(model) == {
        'gyroscopic_coupling': 'it depends on the other axes',
        'periodic_disturbance': 'it is a disturbance, whatever the loop does'}
    assert share_outside(model) == pytest.approx({'gyroscopic_coupling': 16.0 / 45.0})
    with pytest.raises(DesignRefusedError, match='36 % of the drive'):
        check_inside(model)
    check_inside(replace(model, ranges={}))
    both = {**ranges, 'other rate 1': (-3.0, 3.0), 'other rate 2': (-3.0, 3.0)}
    with pytest.raises(DesignRefusedError, match='27 % of the drive'):  # 13 % of each
        check_inside(replace(model, ranges=both))
    leant = next(e for e in EFFECTS if type(e) is Memory and e.signal == 'other angle 1')
    remembers = estimated(leant, np.array([1.0, 4.5]), {'unit': 0.01, 'rest': 0.0})
    assert [*share_outside(replace(model, effects=(remembers,))).values()] == pytest.approx([0.4])


def test_python_control_flies_a_found_model():
    model = replace(model_of(estimate_of('quadratic_drag', [2.0]),
                             estimate_of('mode:slow_state', [0.3, 20.0])),
                    units=Units('V', 0.5, 0.0, 'deg/s', math.pi / 180.0, 'deg', math.pi / 180.0))
    whole, small = to_control(model), to_control(model, linear=True)
    near = control_system.linearize(whole, np.zeros(whole.nstates), [0.0])
    t = DT * np.arange(100)
    u = np.where(t < 0.1, 0.0, 1e-4)
    answers = [control_system.input_output_response(one, t, u).outputs
               for one in (whole, near, small)]
    for other in answers[1:]:
        for one, its in zip(answers[0], other, strict=True):
            np.testing.assert_allclose(one, its, atol=0.01 * np.abs(one).max())


@pytest.mark.parametrize('effect', [
    estimate_of('motor_lag', [0.12], 'motor 1'),
    estimate_of('periodic_disturbance', [2.0, 3.0, 4.0]),
])
def test_python_control_begins_at_rest_and_its_time_goes_on(effect):
    units = Units('V', 0.5, 0.0, 'turn/s', 2.0 * math.pi, 'turn', 2.0 * math.pi)
    model = Identified(**vars(replace(model_of(effect), units=units)))
    t = DT * np.arange(250)
    u = 0.05 * np.sign(np.sin(9.0 * t))
    flown = control_system.input_output_response(model.to_control(), t, u).outputs[0]
    np.testing.assert_allclose(flown, model.simulate(u), atol=1e-5)
