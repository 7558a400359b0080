"""The ladder to the reference, what comes again, and what the held-out data confirm."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

from quad_sysid.discover import accept, base
from quad_sysid.discover.screen import candidates
from quad_sysid.discover.search import Scored, SearchResult
from quad_sysid.effects import EFFECTS
from quad_sysid.estimate.fit import covariance, derivative_steps, fit
from quad_sysid.explain.ladder import Ladder, Models, _Climb, _within_prior, explain, resampled
from quad_sysid.explain.projection import Projected, Projection
from quad_sysid.model.effect import Part
from quad_sysid.model.sensitivity import Sensitivity
from quad_sysid.model.structure import Structure, coordinates
from quad_sysid.pipeline.assemble import axis_model
from quad_sysid.pipeline.identify import _reason
from quad_sysid.report.words import headline


def test_the_shares_and_errors_of_the_rungs_are_those_of_the_answer(rubbed_answer):
    told = rubbed_answer.findings
    (effect,) = rubbed_answer.model.effects
    assert effect.explains_pct == told.ladder.rungs[told.ladder.answer].explains_pct > 95.0
    assert told.verdict.rungs[1] == pytest.approx(told.verdict.after)


def says(told, label: str) -> SearchResult:
    """A search that found this effect alone."""
    problem, base = told.problem, told.search.base
    part = next(one for one in candidates(problem, EFFECTS)[0] if one.effect.label == label)
    start = coordinates(part.effect.parameters,
                        part.effect.starts(problem.data, part.settings)[0])
    reference = fit(problem, Structure((part,)), np.insert(base.theta, -4, start))
    return SearchResult(base, (Scored(reference, 9.0), Scored(base, 0.0)), {})


@pytest.mark.parametrize(('label', 'least'), [('shape:rate/smooth', 0.4),
                                              ('coulomb_friction/stribeck', 2.0)])
def test_what_says_friction_is_explained_by_friction(rubbed_answer, monkeypatch, label, least):
    monkeypatch.setattr('quad_sysid.explain.ladder.LEAST_OF_BEST', least)
    told = rubbed_answer.findings
    ladder = explain(told.problem, says(told, label), candidates(told.problem, EFFECTS)[0])
    assert ladder.rungs[1].labels == ('coulomb_friction',)
    assert ladder.rungs[1].explains_pct > 90.0
    assert ladder.answer == 1


def test_gains_are_designed_with_what_holds_at_other_times_too(rubbed_answer):
    """A friction as a curve over time predicts the next sample as well, and no later flight."""
    told = rubbed_answer.findings
    ladder = explain(told.problem, says(told, 'shape:time/smooth friction'),
                     candidates(told.problem, EFFECTS)[0])
    assert ladder.projection.reference.structure.labels == ('shape:time/smooth friction',)
    assert [part.effect.name for part in ladder.predicting.structure.parts] == ['coulomb_friction']
    projection = ladder.projection  # too short for a free run
    short = Models(told.search, projection.on(np.zeros(projection.windows.count, bool)))
    assert replace(ladder, models=short).predicting is projection.reference


def test_a_law_that_the_reference_lacks_comes_again_whatever_suffices(
    rubbed_answer, monkeypatch
):
    told = rubbed_answer.findings
    only = says(told, 'shape:rate/smooth')
    monkeypatch.setattr('quad_sysid.explain.ladder.ENOUGH', 101.0)
    ladder = explain(told.problem, only, candidates(told.problem, EFFECTS)[0])
    assert (ladder.rungs[1].labels, ladder.answer) == (('coulomb_friction',), 1)
    assert ladder.rungs[-1].labels == ('shape:rate/smooth',)
    monkeypatch.setattr(Ladder, 'sufficient', lambda *_: 0)  # on which side of 90 % it falls
    assert resampled(told.problem, only, ladder)[1]['coulomb_friction'] > 0.5


@pytest.mark.parametrize(('exponent', 'believed'), [(2.0, True), (12.0, False)])
def test_a_law_is_no_rung_with_parameters_that_its_prior_does_not_allow(
    rubbed_answer, exponent, believed
):
    """A thrust that halves as the battery sags by 5 % falls with time, not by the battery."""
    sag = next(effect for effect in EFFECTS if effect.name == 'battery_sag')
    structure = Structure((Part(sag),))
    start = coordinates(sag.parameters, [exponent], 1e-9)
    base = rubbed_answer.findings.search.base.theta
    model = SimpleNamespace(structure=structure, theta=np.insert(base, [-4], start))
    assert _within_prior(model) is believed


def drag_and_friction(told):
    """A reference of both, and the candidates."""
    parts, _ = candidates(told.problem, EFFECTS)
    both = [next(part for part in parts if part.effect.label == label)
            for label in ('quadratic_drag', 'coulomb_friction')]
    starts = [coordinates(part.effect.parameters, part.effect.starts(
        told.problem.data, part.settings)[0]) for part in both]
    start = np.insert(told.search.base.theta, [-4] * sum(map(len, starts)), np.concatenate(starts))
    return fit(told.problem, Structure(tuple(both)), start), parts


def test_a_rung_starts_where_the_search_was_if_that_is_nearer(rubbed_answer):
    """From a base with a tenth of the gain the projection comes back to no better than the base.

    So a second cause explained what friction on a slow plant left there.
    """
    told = rubbed_answer.findings
    reference, parts = drag_and_friction(told)
    base, first = (rung.model for rung in told.ladder.rungs[:2])
    astray = base.theta.copy()
    astray[:2] = 0.1 * astray[0], astray[1] + np.log(30.0)
    models = Models(told.search, Projection(told.problem, reference))
    climb = _Climb(models, told.search, parts, base.total)
    (part,), (where,) = first.structure.parts, first.structure.slices
    trial = climb.extended(replace(base, theta=astray), part, first.theta[where])
    assert trial.total < 0.01 * base.total


def test_the_whole_reference_names_the_main_cause_first(rubbed_answer, monkeypatch):
    monkeypatch.setattr('quad_sysid.explain.ladder.MOST_RUNGS', 1)
    monkeypatch.setattr('quad_sysid.explain.ladder.ENOUGH', 101.0)
    told = rubbed_answer.findings
    reference, parts = drag_and_friction(told)
    found = SearchResult(told.search.base, (Scored(reference, 9.0),), {})
    ladder = explain(told.problem, found, parts)
    assert [rung.labels for rung in ladder.rungs] == [
        (), ('coulomb_friction',), ('coulomb_friction', 'quadratic_drag')]

    monkeypatch.setattr(Ladder, 'answer', 2)
    monkeypatch.setattr(accept.Claim, 'accepted', True)
    unseen = accept.Unseen(told.data, told.data.validation)
    verdict = accept.judge(unseen, told.problem, found, ladder)
    assert verdict.chosen.structure.labels == ('quadratic_drag', 'coulomb_friction')
    model = axis_model(replace(told, search=found, ladder=ladder, verdict=verdict), {}, None)
    friction, drag = model.effects
    assert (friction.name, drag.name) == ('coulomb_friction', 'quadratic_drag')
    assert friction.error_reduction_pct > 30.0
    assert drag.error_reduction_pct < 10.0
    assert friction.p_value < drag.p_value


def test_a_gain_that_wanders_is_projected_onto_a_reference_without_it(rubbed_answer):
    """As where another structure leads in a resampled flight: it rests, and explains nothing."""
    found = rubbed_answer.findings
    projection, first = found.ladder.projection, found.ladder.rungs[1]
    part = next(part for part in candidates(found.problem, EFFECTS)[0] if part.effect.wanders)
    theta = np.insert(first.model.theta, -projection.noise.size, np.log([0.3, 10.0]))
    model = projection.project(first.model.structure.plus(part), theta)
    assert model.total == pytest.approx(first.model.total, abs=1e-3 * found.ladder.rungs[0].total)


def test_a_base_without_a_line_of_vibration_is_compared_with_a_reference_that_has_one(
    rubbed_answer
):
    found = rubbed_answer.findings
    plain, reference = (found.ladder.models.fitted(rung.model) for rung in found.ladder.rungs[:2])
    lined = base._with_line(found.problem, reference, 20.0, 1.0)
    assert (plain.structure.lines, lined.structure.lines) == (0, 1)
    missed, without = (Projection(found.problem, one).disagreement(plain)
                       for one in (lined, reference))
    assert missed == pytest.approx(without, abs=0.02 * without.max())


def test_a_rung_explains_slow_motion_as_well_as_fast(rubbed_answer):
    ladder = rubbed_answer.findings.ladder
    lowest, first = ladder.rungs[:2]
    slow, _, fast = ladder.projection.thirds
    rates = np.mean(ladder.projection.problem.data.rate[
        ladder.projection.windows.starts[:, None] + np.arange(100)] ** 2, axis=1)
    assert np.median(rates[slow]) < 0.5 * np.median(rates[fast])
    missed = first.missed.copy()
    missed[slow] = 0.3 * lowest.missed[slow]
    assert 1.0 - np.sum(missed) / lowest.total > 0.75
    rows, equal = np.array([lowest.missed, missed, first.missed]), np.ones(missed.size)
    ladder = replace(ladder, drift=rows[0])
    assert ladder.explained(rows) == pytest.approx([0.0, 70.0, first.explains_pct])
    assert replace(ladder, rungs=(lowest, replace(first, missed=missed), first)).answer == 2
    light = np.where(np.isin(np.arange(missed.size), slow), 1.0, 1e-9)
    dim = replace(ladder, drift=light * rows[0])
    assert ladder.sufficient(rows) == dim.sufficient(light * rows) == 2
    assert ladder.sufficient(rows[:2]) is None
    times = max(total[1] / most for total, most in ladder._by_thirds(rows, equal))
    small = 0.9 / times * rows  # the middle one misses next to nothing
    assert list(ladder.slight(small, equal)) == [False, True, True]
    assert replace(ladder, drift=small[0]).sufficient(small) == 2


def test_an_effect_is_as_probable_beside_one_that_the_ladder_put_in(rubbed_answer):
    found = rubbed_answer.findings
    friction, drag, curve = (next(
        part for part in candidates(found.problem, EFFECTS)[0] if part.effect.label == label)
        for label in ('coulomb_friction', 'quadratic_drag', 'shape:rate/smooth'))
    base = found.search.base
    reference, chosen, plain = (replace(base, structure=base.structure.plus(part).plus(drag))
                                if part else base for part in (curve, friction, None))
    search = SearchResult(base, (Scored(reference, 4.0), Scored(plain, 0.0)), {})
    ladder = replace(found.ladder, reproducible={'coulomb_friction': 0.75})
    (rubs, drags), ((rival,), _) = accept._posterior(search, chosen, ladder)
    assert rubs == 0.75
    assert rival == ('unlisted_physics', 0.25)
    assert drags == pytest.approx(1.0 / (1.0 + np.exp(-4.0)))


def test_rivals_that_are_equally_probable_stand_in_the_order_of_their_names(rubbed_answer):
    """And not in that of a set, which differs from one process to the next."""
    found = rubbed_answer.findings
    parts = {part.effect.name: part for part in candidates(found.problem, EFFECTS)[0]}
    drag, base = parts.pop('quadratic_drag'), found.search.base
    drags, others = (replace(base, structure=Structure(tuple(each)))
                     for each in ([drag], list(parts.values())[:12]))
    search = SearchResult(base, (Scored(drags, 0.0), Scored(others, 0.0)), {})
    _, (rivals,) = accept._posterior(search, drags, found.ladder)
    assert [name for name, _ in rivals] == sorted(list(parts)[:12])


@pytest.mark.parametrize('because', ['it runs away', 'its prior excludes its parameters'])
def test_a_rung_falls_out_and_leaves_the_others_and_the_axis(rubbed_answer, monkeypatch, because):
    told = rubbed_answer.findings
    parts, _ = candidates(told.problem, EFFECTS)
    if because == 'it runs away':
        monkeypatch.setattr(Models, 'follows', lambda _, model: model.structure.labels[-1:]
                            != ('coulomb_friction',))
    else:
        monkeypatch.setattr('quad_sysid.explain.ladder.PRIOR_SIGMAS', 1e-3)
    ladder = explain(told.problem, told.search, parts)
    assert len(ladder.rungs) > 1
    assert not any(rung.labels == ('coulomb_friction',) for rung in ladder.rungs[:-1])


def test_a_cause_is_confirmed_by_its_own_rung_where_a_finer_effect_contains_it(rubbed_answer):
    """Beside it the cause is needless. Two that join at once have no rung of their own."""
    found, ladder = rubbed_answer.findings, rubbed_answer.findings.ladder
    unseen = accept.Unseen(found.data, found.data.validation)
    rungs = [ladder.models.fitted(rung.model) for rung in ladder.rungs[:2]]
    (part,) = rungs[1].structure.parts
    claim = accept._claim(unseen, ladder, rungs, rungs[1], rungs[1], part.effect)
    assert claim.accepted
    assert claim.error_reduction_pct > 20.0
    other = next(part for part in candidates(found.problem, EFFECTS)[0]
                 if part.effect.name == 'quadratic_drag')
    model = ladder.rungs[1].model
    both = replace(ladder.rungs[1], explains_pct=90.0,
                   model=replace(model, structure=model.structure.plus(other)))
    joined = replace(ladder, rungs=(ladder.rungs[0], both))
    assert joined.answer == 0
    base = ladder.rungs[0]
    in_turn = replace(ladder, rungs=(  # of slow motion the first explains little
        base, replace(ladder.rungs[1], missed=0.4 * base.missed, explains_pct=10.0),
        replace(both, missed=0.1 * base.missed, explains_pct=90.0)))
    assert [in_turn.explains(label) for label in both.labels] == pytest.approx([60.0, 30.0])
    assert not accept._claim(unseen, joined, rungs, rungs[1], rungs[1], part.effect).accepted


@pytest.mark.parametrize(('again', 'because'), [
    (0.9, 'the held-out segments do not confirm'),
    (0.3, 'comes again in 30% of resampled flights only')])
def test_what_is_withdrawn_is_named_with_its_reason(rubbed_answer, again, because):
    told = rubbed_answer.findings
    withdrawn = replace(
        told, ladder=replace(told.ladder, reproducible={'coulomb_friction': again}),
        verdict=replace(told.verdict, verdict='no_missing_effect', chosen=told.verdict.base))
    assert f'the training suggests coulomb_friction, which {because}' in _reason(withdrawn, '')
    tree = {'verdict': 'no_missing_effect', 'effects': [], 'explanation': [{'answer': True}]}
    assert headline(tree) == ('none', 'No missing effect is confirmed')
    assert headline(tree | {'explanation': []}) == ('good', 'The plain model suffices')


def test_a_hundredth_of_the_motion_is_no_cause_unless_it_raises_the_error(
    rubbed_answer, monkeypatch
):
    """By a tenth: a friction may double the error of a lively flight and be less of its motion.

    In slow motion it may raise the error where it does not in fast one."""
    told = rubbed_answer.findings.ladder
    projection, missed, goal = told.projection, told.drift, told.projection.goal

    def error_of(windows):
        """What `missed` raises by a tenth, as a part of the true error."""
        return np.sqrt(np.sum(missed[windows]) / (0.2 * np.sum(goal[windows] ** 2)))

    monkeypatch.setattr(projection, 'motion', 1.01e4 * missed)
    assert (replace(told).negligible, replace(told).answer) == (False, 1)
    monkeypatch.setattr(projection, 'goal', error_of(np.arange(missed.size)) * goal)
    assert (replace(told).negligible, replace(told).answer) == (False, 1)
    monkeypatch.setattr(projection, 'goal', max(map(error_of, projection.thirds)) * goal)
    assert (replace(told).negligible, replace(told).answer) == (True, 0)


def test_both_readings_of_lag_and_damping_are_kept_where_the_data_do_not_decide(
    rubbed_answer, monkeypatch
):
    problem, fitted = rubbed_answer.findings.problem, rubbed_answer.findings.search.base
    far = fitted.theta + 40.0 * np.sqrt(np.diag(np.linalg.inv(fitted.hessian)))
    for theta, behind, kept in ((far, 1.0, True), (fitted.theta, 1.0, False), (far, 9.0, False)):
        other = replace(fitted, theta=theta, evidence=fitted.evidence - behind)
        monkeypatch.setattr(base, '_other_order', lambda *_, other=other: other)
        assert (base.second_reading(problem, fitted) is other) is kept


def test_a_standard_error_holds_what_another_structure_says(rubbed_answer):
    """Of two that are as likely half of their difference's square; one alone adds nothing."""
    found = rubbed_answer.findings.search
    moved = replace(found.base, theta=found.base.theta + 4.0 * (np.arange(9) == 3))
    both = SearchResult(found.base, (Scored(found.base, 0.0), Scored(moved, 0.0)), {})
    assert both.disagreement(found.base)[3, 3] == pytest.approx(8.0)
    assert np.count_nonzero(both.disagreement(found.base)) == 1
    assert not replace(both, all=both.all[:1]).disagreement(found.base).any()
    curved = found.base.structure.plus(next(
        part for part in candidates(rubbed_answer.findings.problem, EFFECTS)[0]
        if part.effect.label == 'shape:rate/smooth'))  # which holds part of the damping
    beside = replace(moved, structure=curved)
    assert not replace(both, all=(both.all[0], Scored(beside, 0.0))).disagreement(found.base).any()


def test_what_is_not_confirmed_or_too_short_to_act_widens_no_standard_error(rubbed_answer):
    told = rubbed_answer.findings
    base = told.verdict.base
    none = replace(told, search=replace(told.search, all=(Scored(told.search.base, 0.0),)),
                   verdict=replace(told.verdict, verdict='no_missing_effect', chosen=base,
                                   claims=(), probabilities=(), rivals=()))
    likely = covariance(told.problem, base) + none.search.disagreement(base)
    of_gain = axis_model(none, {}, None).covariance[0, 0]
    assert of_gain == pytest.approx(likely[0, 0], rel=0.01)

    theta = base.theta.copy()
    theta[2] = -13.0  # log of the delay in s
    short = Projected(base.structure, theta, np.zeros(0))
    spread = told.ladder.projection.covariance(short, covariance(told.problem, told.search.best))
    prior = base.structure.specs[2].spread
    assert np.sqrt(spread[2, 2]) == pytest.approx(prior, rel=0.01)
    assert abs(spread[0, 2]) < 0.01 * prior * np.sqrt(spread[0, 0])


def test_the_derivatives_of_free_runs_are_their_differences(rubbed_answer):
    problem = rubbed_answer.findings.problem.shortened(2000, 2)
    base = rubbed_answer.findings.search.base
    reference = fit(problem, base.structure, base.theta)
    problem.measure(reference)
    windows, flight = problem.data.windows(problem.spans), problem.flight
    wanted = ('pendulum_stiffness', 'quadratic_drag', 'motor_lag', 'mode:hysteresis',
              'mode:swinging', 'mode:yielding/turning', 'shape:gain:rate/smooth', 'backlash')
    for part in candidates(problem, [e for e in EFFECTS if e.label in wanted])[0]:
        own = coordinates(part.effect.parameters,
                          part.effect.starts(problem.data, part.settings)[0])
        own = np.where(own == 0.0, 0.3 * problem.sizes_of(part), own)
        structure = Structure((part,))
        theta = np.concatenate([reference.theta[:5], own, reference.theta[-4:]])
        steps = derivative_steps(problem.sizes(structure))[:-4]
        prediction = flight.predict(structure, theta, sweeps=3)
        run = flight.run(structure, theta, windows, prediction=prediction)
        found = Sensitivity(flight, structure, theta, windows, prediction, run).derivatives(steps)

        def moved(at, j, structure=structure, prediction=prediction, theta=theta):
            return flight.run(structure, theta + at * np.eye(theta.size)[j], windows,
                              prediction=prediction).errors.ravel()

        for j, step in enumerate(steps):
            ahead = (moved(0.3 * step, j) - moved(-0.3 * step, j)) / (0.6 * step)
            assert np.linalg.norm(found[:, j] - ahead) <= 0.02 * np.linalg.norm(ahead) + 1e-9, (
                part.effect.label, j)


@pytest.mark.parametrize('memory', [0.0, 0.5, 0.8])
def test_a_claim_is_confirmed_by_chance_in_one_case_of_twenty(memory):
    """Also where a block's balance says much about the next one's; what is there is confirmed."""
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((1000, 60)) * np.sqrt(1.0 - memory**2)
    shares = np.tanh(lfilter([1.0], [1.0, -memory], noise, axis=1)[:, 20:])

    def confirmed(cases, *means):
        """Share of them, with these means of the three scores."""
        p_values = [accept.p_of_both(*(case + mean for mean in means)) for case in cases]
        return np.mean(np.array(p_values) <= accept.LEVEL)

    assert confirmed(shares, 0.0, 0.0, 0.0) < 0.1
    for means in ((1.5, 1.5, 1.5), (1.5, -1.5, -1.5), (0.0, 1.5, 1.5)):
        assert confirmed(shares[:200], *means) > 0.8, means
    if not memory:  # a test of 40 blocks whose variance is known has 0.91
        assert confirmed(shares, 0.3, 0.3, 0.3) > 0.8


def test_what_predicts_better_and_is_not_confirmed_is_no_missing_effect_either(
    rubbed_answer, monkeypatch
):
    """The contract: nothing lowers the error beyond chance there; a poor base is no reason."""
    monkeypatch.setattr(accept, '_commands_predict', lambda *of: bool(of[-1].structure.parts))
    told = rubbed_answer.findings
    unseen = accept.Unseen(told.data, told.data.validation)
    seldom = replace(told.ladder, reproducible={'coulomb_friction': 0.3})
    verdict = accept.judge(unseen, told.problem, told.search, seldom)
    assert (verdict.verdict, verdict.claims) == ('unexplained_residual', ())
    assert verdict.reason
