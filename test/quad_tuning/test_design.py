"""The PID design: better on the plant, robust over fresh draws, one optimum, a safe way there.

What allows no design is refused in one line that says why.
"""

import dataclasses
import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import butter, lfilter

from quad_sysid.autopilot_table import ARDUPILOT, AUTOPILOT
from quad_sysid.axes import TURNING
from quad_sysid.effects import EFFECTS
from quad_sysid.estimate.stored import estimate_of
from quad_sysid.loop.cascade import CascadeGains, frequency_grid, margins, open_loop
from quad_sysid.loop.figures import square_figures, square_wave
from quad_sysid.loop.from_model import loop_plant
from quad_sysid.loop.linear import WIDE
from quad_sysid.loop.linear import loops_of as linear
from quad_sysid.loop.plant import plant_like
from quad_sysid.loop.simulation import simulate_cascade
from quad_sysid.model import LAW, Parameter
from quad_sysid.model.effect import Part
from quad_sysid.model.structure import Structure
from quad_tuning import bounds, pid
from quad_tuning import ensemble as ensembles
from quad_tuning.assess import Requirements, assess, meets, promise
from quad_tuning.designer import design
from quad_tuning.errors import DesignRefusedError
from quad_tuning.way import way_to

ACTIVE = CascadeGains.default('roll')


def loops_of(m, seed=7, **count):
    return ensembles.build(m, np.random.default_rng(seed), **count)


def held(steps, active, axis):
    """Whether each set is within one step of the one before."""
    for before, step in itertools.pairwise((active, *steps)):
        for field in bounds.DESIGNED:
            low, high = bounds.reachable(field, getattr(before, field), axis)
            assert low * (1.0 - 1e-6) <= getattr(step, field) <= high * (1.0 + 1e-6), field


def steps_of(m, proposal):
    steps = [CascadeGains.from_mapping({**m.active_gains, **s}, m.axis) for s in proposal.steps]
    held(steps, CascadeGains.default(m.axis), m.axis)
    assert proposal.gains in proposal.steps
    return steps


SLOW = {'gain': 350.0, 'lag': 0.075, 'delay': 0.004}
"""kd needs three steps: the angle's gain must not be there before it."""


@pytest.mark.parametrize(
    ('axis', 'values'),
    [('roll', SLOW), *(pytest.param(axis, values, marks=pytest.mark.long) for axis, values in (
        ('yaw', {'gain': 45.0, 'stds': {'gain': 1.0}}), ('roll', {}),
        ('roll', {'gain': 850.0, 'lag': 0.07}), ('roll', {'gain': 250.0})))],
)
def test_a_design_tracks_better_and_keeps_margins_over_fresh_draws(model, axis, values):
    m = model(axis, **values)
    proposal = design(m)
    said, steps = proposal.figures, steps_of(m, proposal)
    assert proposal.refused_because == ''
    assert not any('.sag.' in name for name in proposal.gains)
    loops, gains = loops_of(m, 99, count=300), steps[-1]
    needs = Requirements(44.0, 7.8, 1.84)  # fresh draws go a little further than the design's
    assert meets(loops.margins(gains), needs).mean() > 0.99
    assert not any(loops.unstable(step).any() for step in steps)
    flown, *lowest = (np.min(loops.margins(g).phase_margin_deg)
                      for g in (CascadeGains.default(axis), *steps))
    assert min(lowest) > min(28.0, 0.8 * flown)
    if values == SLOW:
        k = proposal.steps.index(proposal.gains)
        assert 0 < k < len(proposal.steps) - 1
        promised = promise(loops, CascadeGains.default(axis), steps[k], m.value('lag'))
        assert said['rate_rms_ratio'] == pytest.approx(promised['rate_rms_ratio'])
    reference = square_wave(np.radians(12), 2.0, 4, 0.004)
    runs = (simulate_cascade(loop_plant(m), g, reference, 0.004)
            for g in (CascadeGains.default(axis), gains))
    before, after = (square_figures(reference, run.angle, 0.004) for run in runs)
    assert after.rms_error_rad < 0.9 * before.rms_error_rad
    assert after.rise_time_s == pytest.approx(said['rise_time_s'], rel=0.05)
    assert before.rise_time_s == pytest.approx(said['rise_time_s_before'], rel=0.05)
    assert said['worst_phase_margin_deg'] >= 45.0
    assert said['worst_gain_margin_db'] >= 8.0
    assert said['worst_peak_sensitivity'] <= 1.8
    assert said['draws'] >= 200
    assert said['disturbance_rms_rad'] < said['disturbance_rms_rad_before']


@pytest.mark.usefixtures('quick')
def test_friction_of_a_real_bearing_does_not_hunt_with_the_new_gains(model):
    """Stiction that drops with speed, in no list of ours: RMS falls, at rest the axis rests.

    Hunting would be a standing oscillation: the rate over the last third of each half period
    stays below 0.02 rad/s, a hundredth of what the step takes.
    """
    m = model(effects=[estimate_of('coulomb_friction', (2.5,), std=0.1)])
    stribeck = next(e for e in EFFECTS if e.label == 'coulomb_friction/stribeck')
    base = loop_plant(m).plant.p[:5]
    plant = plant_like('roll', np.r_[base, 2.0, 0.005, 2.0, 0.1], 0.004, 42.0,
                       structure=Structure((Part(stribeck),)))
    reference = square_wave(np.radians(12), 3.0, 3, 0.004)
    before, after = (
        simulate_cascade(plant, g, reference, 0.004) for g in (ACTIVE, steps_of(m, design(m))[-1])
    )
    old, new = (square_figures(reference, run.angle, 0.004) for run in (before, after))
    assert new.rms_error_rad < 0.85 * old.rms_error_rad
    assert new.overshoot_pct < 20.0
    assert np.sqrt(np.mean(after.rate[750:].reshape(-1, 750)[:, 500:] ** 2)) < 0.02


@pytest.mark.usefixtures('few_draws')
@pytest.mark.parametrize('starts', [3, pytest.param(5, marks=pytest.mark.long)])
def test_every_search_ends_at_the_same_gains(model, monkeypatch, starts):
    monkeypatch.setattr(pid, 'STARTS', starts)
    first = pid.retune(loop_plant(model()), ACTIVE, loops_of(model()))
    assert first.agreeing == first.searches == starts


@pytest.mark.usefixtures('quick')
def test_where_nothing_keeps_the_margins_no_search_finds_any(model):
    problem = pid.pose(loop_plant(model()), ACTIVE, loops_of(model()),
                       Requirements(peak_sensitivity=1.01))  # fmt: skip
    assert pid.search(problem) == []


@pytest.mark.parametrize(('damping', 'stiffness'), [(0.4, 1.0), (-0.5, 0.0), (0.4, -5.0)])
def test_the_grid_knows_which_loops_are_stable_also_around_an_unstable_plant(
        model, damping, stiffness):
    m = model(damping=damping, effects=[estimate_of('pendulum_stiffness', (stiffness,))])
    problem = pid.pose(loop_plant(m), ACTIVE, loops_of(m, count=3), Requirements())
    points, ensemble = pid._grid(problem)[::80], problem.ensemble
    poles = np.abs(np.linalg.eigvals(ensemble.cycle.a)) > pid.OUTSIDE
    for row, gains in zip(problem.constants(points), problem.gains(points), strict=True):
        loop, _ = pid._loops_of(row[None], ensemble.response, ensemble.omega)
        unstable = pid._turns(loop[0], poles.sum(axis=1)) != 0
        assert (unstable == ensemble.unstable(gains)).all()


def test_a_search_that_stands_before_a_kink_ends_there():
    """Within 1e-3 of the corner (0.4, 0.45), after less than a quarter of 40 line searches."""
    points = []

    def judged(some):
        points.extend(some)
        x, y = some.T
        return np.stack([(x - 0.8)**2 + 0.3 * (y - 0.5)**2, 0.4 - x - np.abs(y - x - 0.05)], 1)

    end = pid._slsqp(judged, np.array([0.5, 0.5]), np.zeros(2))
    np.testing.assert_allclose(end, [0.4, 0.45], atol=1e-3)
    assert len(points) < 110


def test_a_way_through_instability_is_refused(model):
    """The target itself is not judged here; the sets before it are, and none of them holds."""
    wanted = dataclasses.replace(ACTIVE, angle_kp=15.0, rate_kp=0.5, rate_kd=0.0)
    with pytest.raises(DesignRefusedError, match='poor margins'):
        way_to(wanted, ACTIVE, loops_of(model()))


def test_the_promised_change_of_the_rate_is_that_of_the_simulation(model):
    m, rng = model(), np.random.default_rng(3)
    loops = loops_of(m, 0, count=8)
    new = dataclasses.replace(ACTIVE, rate_kp=1.5 * ACTIVE.rate_kp, angle_kp=6.0)
    said = promise(loops, ACTIVE, new, 0.043)
    gusts, state = np.empty(50_000), 0.0
    for k, push in enumerate(rng.normal(size=gusts.size)):
        state += TURNING.gust_rad_s * m.dt * (push - state)
        gusts[k] = state
    before, after = (
        simulate_cascade(loop_plant(m), g, np.zeros(gusts.size), m.dt, disturbance=gusts).rate
        for g in (ACTIVE, new)
    )
    assert said['rate_rms_ratio'] == pytest.approx(np.std(after) / np.std(before), rel=0.05)
    at = 2.0 * np.pi * np.fft.rfftfreq(gusts.size, m.dt)
    old, new_power = (np.abs(np.fft.rfft(rate)) ** 2 for rate in (before, after))
    bands = [(at > w / np.sqrt(2.0)) & (at < w * np.sqrt(2.0)) for w in TURNING.bands_rad_s]
    worst = max(np.sqrt(new_power[band].sum() / old[band].sum()) for band in bands)
    assert said['oscillation_ratio'] == pytest.approx(worst, rel=0.1)
    assert 0.99 < said['peak'] < 1.8
    assert said['peak'] == promise(loops, new, new, 0.043)['peak']
    same = promise(loops, ACTIVE, ACTIVE, 0.043)
    assert same['rate_rms_ratio'] == same['oscillation_ratio'] == 1.0


def test_the_noise_in_the_command_is_that_of_a_gyro_behind_its_filter(model):
    m, gains = model(), dataclasses.replace(ACTIVE, rate_kd=0.003, d_filter_hz=100.0)
    noise = lfilter(*butter(2, 42.0, fs=250.0), np.random.default_rng(5).normal(size=40_000))
    noise *= m.noise_rms / np.std(noise)
    run = simulate_cascade(loop_plant(m), gains, np.zeros(noise.size), m.dt, noise=noise)
    said = assess(loop_plant(m), gains, loops_of(m, count=1)).named(m.noise_rms)
    assert said['motor_noise_rms'] == pytest.approx(np.std(run.control), rel=0.08)


def with_gains(m, **values):
    gains = dict(m.active_gains) | {k.replace('__', '.'): v for k, v in values.items()}
    return dataclasses.replace(m, active_gains=gains)


def with_base(m, name, value):
    base = tuple(Parameter(p.name, value if p.name == name else p.value, p.std, p.unit)
                 for p in m.base)  # fmt: skip
    return dataclasses.replace(m, base=base)


def with_stds(*variances):
    return lambda m: dataclasses.replace(m, covariance=np.diag(variances))


@pytest.mark.parametrize(
    ('change', 'said'),
    [
        (lambda m: with_base(m, 'gain', -450.0), 'a positive command lowers the rate'),
        (lambda m: with_base(m, 'gain', 0.0), 'lowers the rate'),
        (lambda m: with_base(m, 'gain', float('nan')), 'plant gain is nan'),
        (lambda m: with_base(m, 'gain', 8.0), 'may be zero or negative'),
        (lambda m: with_base(m, 'lag', float('nan')), 'lag is nan'),
        (lambda m: dataclasses.replace(m, covariance=None), 'no covariance'),
        (lambda m: dataclasses.replace(m, covariance=np.eye(2)), 'covariance is (2, 2)'),
        (with_stds(1e4, 0, 0, 0, 0), 'gain 450 +- 1e+02 is too uncertain'),
        (with_stds(25, 0, 0.01**2, 0, 0), 'delay 0.008 +- 0.01 s is too uncertain'),
        (with_stds(np.nan, 0, 0, 0, 0), 'lacks the plant gain'),
        (lambda m: dataclasses.replace(m, active_gains={}), "flight's gains are not known"),
        (lambda m: with_gains(m, roll__angle__kp=0.0), 'so the stick commanded the rate'),
        (lambda m: with_gains(m, roll__rate__kp=float('nan')), 'must be finite'),
        (lambda m: with_gains(m, roll__rate__kp=0.4), 'gains that flew are unstable'),
        (lambda m: dataclasses.replace(m, trusted_band_rad_s=(0.1, 5.0)), 'excite that band'),
        (lambda m: with_base(m, 'delay', 0.08), 'gains that flew are unstable'),
        (lambda m: dataclasses.replace(m, own_effects=(SimpleNamespace(kind=LAW),)), 'built-in'),
    ],
)
@pytest.mark.usefixtures('quick')
def test_a_model_that_allows_no_design_is_refused_with_the_reason(model, change, said):
    proposal = design(change(model()))
    assert proposal.gains is None
    assert said in proposal.refused_because
    assert proposal.refused_because.startswith('roll')
    assert '\n' not in proposal.refused_because


@pytest.mark.parametrize(
    ('check', 'gains', 'said'),
    [
        *((bounds.check_finite, {'roll.rate.kp': value}, r'roll\.rate\.kp: must be finite')
          for value in (float('nan'), float('inf'), -float('inf'), True)),
        *((bounds.check_bounds, gains, 'must lie in') for gains in (
            {'roll.angle.kp': 16.0}, {'roll.rate.kp': -0.01}, {'roll.rate.kd': 0.03})),
        (bounds.check_bounds, {'roll.rate.output_limit': 0.3}, 'roll.rate.output_limit'),
        (lambda given: bounds.check_bounds(given, {'roll.rate.ki': 1.3}), {'roll.rate.ki': 1.4},
         'must lie in'),
    ],
)
def test_what_must_never_reach_an_aircraft_is_refused_by_name(check, gains, said):
    with pytest.raises(DesignRefusedError, match=said):
        check(gains)


def test_a_gain_that_flies_on_other_firmware_is_a_start_though_beyond_our_bounds(model):
    beyond = with_gains(model(), roll__rate__ki=1.12)  # Betaflight's default of 80
    with pytest.raises(DesignRefusedError, match='must lie in'):
        bounds.flown_gains(beyond)
    gains = bounds.flown_gains(with_gains(beyond, roll__rate__tpa_kp=1.0))
    low, high = bounds.reachable('rate_ki', gains.rate_ki, 'roll')
    assert gains.rate_ki == pytest.approx(high) == pytest.approx(1.12)
    assert low < 1.0
    weak = with_gains(model('yaw'), yaw__rate__kp=0.6)  # more than roll may have
    assert bounds.flown_gains(weak).rate_kp == 0.6


def test_gains_for_an_autopilot_are_gains_that_its_parameters_can_be():
    units = (0.4, 0.4, 0.4)
    own = bounds.bounds_of('roll', {AUTOPILOT: 3.0, 'roll.rate.output_limit': units[0]})
    most = {f'roll.{name}': own[f'roll.{name}'].upper
            for name in ('angle.kp', 'rate.kp', 'rate.ki')}
    assert most == {'roll.angle.kp': 12.0, 'roll.rate.kp': 0.2, 'roll.rate.ki': 0.4}
    assert ARDUPILOT.parameters(most, {}, units)['ATC_ANG_RLL_P'] == 12.0
    around = bounds.bounds_of('surge', {AUTOPILOT: 3.0})  # a loop of the user's own
    assert bounds.bounds_of('roll', {}) is around is bounds.BOUNDS


@pytest.mark.usefixtures('quick')
@pytest.mark.parametrize(
    ('flown', 'stays'),
    [({AUTOPILOT: 12.0}, True), ({AUTOPILOT: 3.0}, False), ({'yaw.rate.tpa_kp': 1.0}, True),
     ({}, False)],
)
def test_a_filter_that_all_axes_share_stays_as_it_flew(model, flown, stays):
    """A weak yaw's design takes it to its lower bound, which would cost the others' margins."""
    m = model('yaw', gain=13.3, stds={'gain': 0.13})
    own = {'yaw.rate.kp': 0.2, 'yaw.rate.ki': 0.1, 'yaw.rate.d_filter_hz': 30.0}
    m = dataclasses.replace(m, active_gains={**m.active_gains, **own, **flown})
    assert (design(m).steps[-1]['yaw.rate.d_filter_hz'] == 30.0) == stays


@pytest.mark.parametrize(('name', 'values', 'stds'), [
    ('mode:second_lag', (0.01,), (0.006,)), ('mode:slow_state', (0.3, 5.0), (0.2, 2.0))])
def test_a_time_constant_that_is_hardly_known_is_drawn_above_zero(model, name, values, stds):
    """Below zero the plant of a draw would run away, and no gains keep its margins."""
    effect = estimate_of(name, values)
    effect = dataclasses.replace(effect, parameters=tuple(
        dataclasses.replace(p, std=std) for p, std in zip(effect.parameters, stds, strict=True)))
    m = model(effects=[effect])
    variances = [*np.diag(m.covariance), *np.square(stds)]
    names = (*m.parameter_names, *(f'{name}.{p.name}' for p in effect.parameters))
    m = dataclasses.replace(m, parameter_names=names, covariance=np.diag(variances))
    drawn = ensembles.draw_models(m, np.random.default_rng(1), 200)
    first = np.array([one.effects[0].parameters[0].value for one in drawn])
    assert first.min() > 0.0
    assert np.median(first) == pytest.approx(values[0], rel=0.15)
    assert np.std(np.log(first)) == pytest.approx(stds[0] / values[0], rel=0.15)


def test_margins_see_a_resonance_between_the_points_of_the_grid():
    """0.5 % damping, 0.15 rad/s wide, where the points are 1.1 rad/s apart."""
    light = next(e for e in EFFECTS if e.label == 'resonance')
    gains = CascadeGains(4.0, 0.15, 0.03, 0.003)
    fine = np.geomspace(0.1, 0.999 * np.pi / 0.004, 40_000)
    for hz in np.linspace(4.3, 4.8, 5):
        loops = linear([(plant_like(
            'roll', np.r_[100.0, 0.04, 0.01, 0.5, 0.0, hz, 0.005, 0.006, 0.0], 0.004, None,
            structure=Structure((Part(light),))), WIDE)])
        seen, known = (margins(open_loop(gains, loops.response(grid), grid, 0.004), grid)
                       for grid in (frequency_grid(0.004, loops=loops), fine))
        assert seen.gain_margin_db[0] == pytest.approx(known.gain_margin_db[0], abs=0.3)
        assert seen.peak_sensitivity[0] == pytest.approx(known.peak_sensitivity[0], rel=0.02)


def test_an_axis_driven_by_another_ones_command_is_refused(model):
    def crossed(fraction):
        return estimate_of('cross_axis_input', (fraction,), 'other axis 1', std=0.01)

    bounds.check_polarity(model(effects=[crossed(0.1)]))
    with pytest.raises(DesignRefusedError, match="motors' order"):
        bounds.check_polarity(model(effects=[crossed(-0.9)]))
