"""What changed between two flights is told with its chance; of equal flights nothing is told."""

import json
from dataclasses import replace

import numpy as np
import pytest
from flown_axis import SHORT, Axis, fly

from quad_sysid.bags import write_bag
from quad_sysid.cli import main
from quad_sysid.comparison import Estimate, Flight, compare, flight_of, trims
from quad_sysid.record import Record, Segment
from quad_sysid.report.model_file import save_models


def flight(name: str, **parameters: float | None) -> Flight:
    """One axis; each value has an error of 0.1, but for a lag at its bound."""
    return Flight(name, {'roll': {
        key: Estimate(value, None if key == 'lag' else 0.1, '1')
        for key, value in parameters.items() if value is not None
    }}, {})


def test_a_difference_counts_by_its_error_and_by_how_many_are_looked_at():
    before = flight('a', gain=1.0, lag=0.0, damping=2.0, drag=None)
    other = flight('b', gain=1.6, lag=1.0, damping=2.2, drag=1.0)
    found = {c.name: c for c in compare(before, [other])[0][1]}
    assert found['gain'].p_value == pytest.approx(2.2e-5, rel=0.02)  # 4.24 of sqrt(2) * 0.1
    assert found['gain'].changed
    assert (found['damping'].changed, found['lag'].p_value) == (False, None)
    assert found['lag'].difference == 1.0
    assert (found['drag'].reference, found['drag'].p_value) == (None, None)


def test_where_one_flight_alone_has_an_effect_it_is_not_said_that_nothing_changed():
    before, equal = flight('a', gain=1.0), flight('b', gain=1.0)
    other = flight('c', gain=1.0, **{'quadratic_drag.coefficient': 1.0})
    assert '  nothing changed, at' in repr(compare(before, [equal]))
    said = str(compare(before, [other]))
    assert '  nothing that both have changed, at' in said
    assert 'in one of the two only, not compared: roll quadratic_drag.coefficient' in said
    assert '--no-effects' not in said
    other = flight('c', gain=2.0, **{'quadratic_drag.coefficient': 1.0})
    said = str(compare(before, [other]))
    assert '  changed: roll gain\n' in said
    assert 'gain may have changed only because that effect' in said
    assert '--no-effects' not in str(compare(before, [flight('d', gain=2.0)]))
    without_model = compare(flight('a', gain=1.0, trim=0.0), [flight('b', trim=0.0)])
    assert '  nothing that both have changed, at' in str(without_model)
    assert str(without_model).count('\n  only the trim could be compared\n') == 1
    assert 'only the trim' not in said


def test_without_effects_the_base_that_takes_up_what_they_do_is_compared(rubbed_answer):
    """As the base of the other flight does, in which no effects were looked for."""
    model = rubbed_answer.model
    (beside,), (alone,) = (flight_of(model, effects=effects).parameters.values()
                           for effects in (None, ()))
    assert beside['damping'].value == model.value('damping')
    assert 'coulomb_friction.torque' in beside
    assert alone == {p.name: Estimate(p.value, p.std, p.unit) for p in model.plain}
    assert alone['damping'].value > 3.0 * beside['damping'].value


def test_arrays_of_unlike_units_are_not_compared(refusal):
    pair = [Flight(unit, {'roll': {'gain': Estimate(1.0, 0.1, f'rad/s² per {unit}')}}, {})
            for unit in ('V', 'mV')]
    assert 'roll gain is in rad/s² per V and in rad/s² per mV' in refusal(
        compare, pair[0], pair[1:])
    pair = [Flight(unit, {'roll': {'hidden.size': Estimate(1.0, 0.1, unit)}}, {})
            for unit in ('1', '1/s')]
    (change,) = compare(pair[0], pair[1:])[0][1]
    assert (change.difference, change.unit) == (None, '1, then 1/s')


def test_many_flights_are_held_to_one_level_together():
    """Of one flight a chance of 0.7 % is a change; of ten that would come by itself too often."""
    before, odd = flight('a', gain=1.0), flight('b', gain=1.38)
    assert compare(before, [odd])[0][1][0].changed
    same = [flight(f'{k}', gain=1.0 + 0.01 * k) for k in range(9)]
    pairs = compare(before, [*same, odd])
    assert [len(found) for _, found in pairs] == [1] * 10
    assert pairs[-1][1][0].p_value == pytest.approx(0.0072, rel=0.02)
    assert not any(change.changed for _, found in pairs for change in found)


@pytest.mark.parametrize(('shift', 'changed'), [(0.0, False), (0.1, True)])
def test_a_trim_wanders_between_flights_as_it_does_within_one(shift, changed):
    def record(seed: int, offset: float) -> Record:
        rng = np.random.default_rng(seed)
        n = 5000
        slow = 0.005 * np.interp(np.arange(n), np.arange(0, n + 999, 1000),
                                 rng.standard_normal(6))
        control = np.column_stack([np.full(n, 0.5), slow + offset, slow, slow])
        control[:, 1:] += 0.02 * rng.standard_normal((n, 3))
        parts = (Segment('idle', 'none', 'roll', 'none', 0.0, 2.0),
                 Segment('train', 'none', 'roll', 'none', 2.0, 20.0))
        control[:500, 1] = 5.0  # on the ground
        return Record('flight', 0.004, np.zeros((n, 3)), control, segments=parts)

    pair = [Flight('x', {a: {'trim': e} for a, e in trims(record(seed, offset)).items()}, {})
            for seed, offset in ((1, 0.0), (2, shift))]
    assert pair[0].parameters['roll']['trim'].unit == 'normalised command'
    found = {c.axis: c for c in compare(pair[0], pair[1:])[0][1]}
    assert found['roll'].changed is changed
    assert not found['pitch'].changed
    assert found['roll'].difference == pytest.approx(shift, abs=0.02)


@pytest.mark.usefixtures('quick')
def test_a_weaker_motor_through_the_command(
        true_model, tmp_path, printed, refused, monkeypatch):
    weaker = replace(fly(Axis(gain=380.0), 12, SHORT), t0_ns=10**18)
    bag = write_bag(weaker, tmp_path / 'weaker')
    model = tmp_path / 'model.json'
    save_models({'roll': true_model}, model)
    tree = json.loads(printed(main, 'compare', model, bag, '--axis', 'roll', '--no-effects',
                              '--json'))
    assert tree['schema'] == 'quad_sysid/comparison/1'
    found = {c['name']: c for c in tree['flights'][0]['parameters']}
    assert found['gain']['difference'] == pytest.approx(-70.0, abs=15.0)
    assert found['gain']['changed']
    assert not found['damping']['changed']
    out = printed(main, 'compare', model, model, '--axis', 'roll')
    assert 'nothing changed' in out
    assert max(map(len, out.replace(str(tmp_path), '').splitlines())) <= 100
    assert refused(main, 'compare', model, model, '--axis', 'yaw', status=3).endswith(
        f'nothing can be compared: {model}: no model of yaw: not in the file\n')
    assert main(['compare', str(model)]) == 2
    monkeypatch.delattr('quad_sysid.result.identify')  # nothing is identified before all is read
    assert main(['compare', str(bag), str(tmp_path / 'no_flight')]) == 2
