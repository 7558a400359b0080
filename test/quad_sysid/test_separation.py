"""Which flight tells two rivals apart: the order makes sense, it can be flown, and it works."""

import math
from dataclasses import replace

import numpy as np
import pytest
import yaml
from flown_axis import Axis, Plan
from flown_axis import fly as flown

import quad_sysid as qs
from quad_sysid.cli import main
from quad_sysid.errors import NotInformativeError
from quad_sysid.estimate.fit import Problem, fit
from quad_sysid.estimate.stored import estimate_of
from quad_sysid.model import AxisModel, Parameter
from quad_sysid.model.effect import ActingEffect, Part
from quad_sysid.model.identified import UNLISTED
from quad_sysid.model.structure import Structure, coordinates
from quad_sysid.pipeline.advice import rivalry
from quad_sysid.pipeline.identify import Options, identify
from quad_sysid.report.model_file import save_models
from quad_sysid.report.next_flight import next_flight
from quad_sysid.separation import design, words
from quad_sysid.separation.design import Separation, rivals_of, separate, variants
from quad_sysid.separation.flight import PAPER, PAPER_NOISE, fly, paper_aircraft
from quad_sysid.separation.measure import judged
from quad_sysid.signals.schedule import parse_schedule

SECONDS = 20.0


FLOWN = {
    'coulomb_friction': (0.5, 0.01), 'backlash': (0.003,), 'resonance': (5.0, 0.05, 0.0, 0.05),
    'cross_axis_input': (0.2,),
}
"""A torque, a law of the command, one with states, one of another axis."""


@pytest.mark.parametrize('name', FLOWN)
def test_what_flies_is_what_identification_fits(name):
    values = np.array(FLOWN[name])
    aircraft = paper_aircraft('roll')
    flight = replace(design.plain_prbs('roll', 12.0), throttle_steps=True, others_move=True)
    effect = variants(name)[0]
    plain = fly(aircraft, (), [flight])[0].data
    assert np.corrcoef(plain.battery_v, plain.control[:, 0])[0, 1] < -0.9  # which it loads
    settings = effect.prepare(plain)
    assert not isinstance(settings, str), settings
    acting = ActingEffect(Part(effect, settings), values)
    (strongest,) = judged(aircraft, plain).sized(acting.part, 1e9).p[:1]
    spec = effect.parameters[0]
    if spec.spread and not spec.log:  # no stronger than its prior lets it be
        assert abs(strongest - spec.centre) < 2.01 * spec.spread
    found = judged(aircraft, fly(aircraft, [acting], [flight])[0].data)
    assert found.fitted([acting.part]) > 8.0
    problem: Problem = found.problem
    own = coordinates(effect.parameters, values)
    count = found.base.theta.size - len(Structure().noise)
    start = np.r_[found.base.theta[:count], own, found.base.theta[count:]]
    fitted = fit(problem, Structure((acting.part,)), start, rate=found.base.rate)
    where = fitted.structure.slices[0]
    spread = np.sqrt(np.diag(np.linalg.inv(fitted.hessian)))[where]
    np.testing.assert_array_less(np.abs(fitted.theta[where] - own), 4.0 * spread + 1e-6)


def schedule_of(found: Separation):
    return parse_schedule(yaml.safe_load(words.schedule(found)), 'schedule')


@pytest.fixture(scope='module')
def springs() -> Separation:
    pair = ('pendulum_stiffness', 'cubic_stiffness')
    return separate(paper_aircraft('roll'), pair, SECONDS)


def test_springs_are_told_apart_by_larger_angles_than_the_plain_prbs(springs):
    best, plain = springs.best, springs.plain
    assert best.peak_angle > 1.4 * plain.peak_angle
    assert best.worst.score > 1.8 * plain.worst.score
    scores = [row.worst.score for row in springs.rows]
    assert scores == sorted(scores, reverse=True)
    assert max(math.degrees(row.peak_angle) for row in springs.rows) <= 22.5
    one = best.worst
    assert one.over(4.0 * one.seconds).distance == pytest.approx(2.0 * one.distance)
    assert one.over(one.seconds_for(0.95)).probability == pytest.approx(0.95)
    none = dict.fromkeys(('first', 'second'), replace(best.worst, mimicked=1e-9))
    told = words.why(replace(springs, rows=(replace(best, **none), *springs.rows[1:])))
    assert 'in this flight cubic_stiffness cannot imitate pendulum_stiffness' in told
    assert ' 0%' not in told
    text = words.text(springs)
    assert max(map(len, text.splitlines())) <= 80
    assert 'Fly ' in text
    assert 'cubic_stiffness' in text


def test_every_row_is_a_schedule_that_the_node_can_fly(springs):
    for row in springs.rows:
        schedule = schedule_of(replace(springs, rows=(row, *springs.rows)))
        train = [part for part in schedule.parts if part.role == 'train']
        assert sum(part.duration_s for part in train) == pytest.approx(SECONDS, abs=0.2)
        assert train[-1].signal == row.excitation.part.signal
        assert train[-1].amplitude == pytest.approx(row.excitation.part.amplitude, rel=1e-4)
        like = [part for part in schedule.parts if part.role == 'validation'][-1]
        assert (like.signal, like.parameters) != (train[-1].signal, train[-1].parameters)
        assert schedule.mount == 'rig'
    moved = replace(springs.best.excitation, others_move=True)  # by sticks, which a rig forbids
    rows = (replace(springs.best, excitation=moved), *springs.rows)
    assert schedule_of(replace(springs, rows=rows)).mount == 'hover'


def model_with_rival(probability: float) -> AxisModel:
    names = ('gain', 'lag', 'delay', 'damping', 'bias')
    base = tuple(
        Parameter(name, value, 0.01, '') for name, value in zip(names, PAPER['roll'], strict=True))
    friction = estimate_of(
        'coulomb_friction', (0.12,), std=0.01, probability=1.0 - probability,
        rivals=(('quadratic_drag', probability),),
    )
    return AxisModel(
        'roll', 0.004, 42.0, base, (friction,), (*names, 'coulomb_friction.torque'),
        noise=PAPER_NOISE,
    )


def test_a_model_brings_its_effect_and_its_nearest_rival(tmp_path, printed, monkeypatch):
    monkeypatch.setattr(design, 'FITTED', 1)
    model, out = tmp_path / 'model.json', tmp_path / 'schedule.yaml'
    save_models({'roll': model_with_rival(0.3)}, model)
    said = printed(main, 'design-excitation', '--separate', '--model', model, '--seconds', 10,
                   '--out', out)
    assert 'coulomb_friction (torque 0.12 rad/s²' in said
    assert 'quadratic_drag (coefficient' in said
    assert parse_schedule(yaml.safe_load(out.read_text()), 'x').parts


def test_the_report_advises_the_flight_where_a_rival_is_near(refusal):
    (near,) = rivalry(model_with_rival(0.3))
    assert '--separate coulomb_friction quadratic_drag --axis roll' in near
    assert list(rivalry(model_with_rival(0.05))) == []
    (near,) = rivalry(replace(model_with_rival(0.3), axis='surge'))
    assert 'design-excitation' not in near  # which flies none of it
    with pytest.raises(NotInformativeError, match='no effect of this model has a rival'):
        rivals_of(model_with_rival(0.0))
    lonely = model_with_rival(0.0)
    (friction,) = lonely.effects
    doubted = replace(friction, probability=0.2, rivals=((UNLISTED, 0.8),))
    assert list(rivalry(replace(lonely, effects=(doubted,)))) == []
    rivals = [{'name': UNLISTED, 'probability': 0.8}]
    assert next_flight('roll', {'verdict': 'effects_added', 'effects': [
        {'name': friction.name, 'probability': 0.2, 'rivals': rivals}]}) == ()
    backwards = replace(lonely, base=(Parameter('gain', -400.0, 1.0, ''), *lonely.base[1:]))
    asked = ('mode:swinging', 'nothing')
    assert 'gain is not positive' in refusal(qs.separate, backwards, asked, 20.0)


@pytest.mark.long
def test_flown_for_real_the_right_one_is_surer_than_with_the_plain_prbs(springs):
    """A pendulum of 0.18 rad/s² per rad, two flights each, as the tests' own simulator flies."""
    axis = Axis(torque=lambda _t, _r, a: -0.18 * math.sin(a), torque_noise=0.015)

    def probability(parts, seed: int) -> float:
        samples = np.concatenate([
            [part.at(0.004 * k) for k in range(round(part.duration_s / 0.004))] for part in parts
        ])
        seconds = 0.004 * samples.size
        plan = Plan(2.0 * seconds + 3.0, (
            ('train', 'prbs', 1.0, seconds + 1.0),
            ('validation', 'prbs', seconds + 2.0, 2.0 * seconds + 3.0),
        ), reference=np.concatenate([np.zeros(250), samples, np.zeros(250), samples,
                                     np.zeros(250)]))
        answer = identify([flown(axis, seed, plan)], Options(axes=('roll',)))['roll']
        return sum(e.probability for e in answer.model.effects if e.name == 'pendulum_stiffness')

    best = [part for part in schedule_of(springs).parts if part.role == 'train']
    plain = [replace(springs.plain.excitation.part, duration_s=SECONDS)]
    surer, before = ([probability(parts, seed) for seed in (0, 2)] for parts in (best, plain))
    assert min(surer) > 0.9
    assert np.mean(before) < np.mean(surer) - 0.1
