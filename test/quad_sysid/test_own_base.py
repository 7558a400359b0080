"""A base of one's own is recovered and completed; what the data cannot give is named."""

import math
from dataclasses import replace

import numpy as np
import pytest
from flown_axis import LONGER, SHORT, Axis, fly, model_of

import quad_sysid as qs
from quad_sysid.estimate.stored import estimate_of
from quad_sysid.model.effect import Signals
from quad_sysid.own_base import BUILT_IN_TERMS

DT = 0.004
STICKING = Axis(torque=lambda _t, rate, _a: -6.0 * math.tanh(rate / 0.005))


def law(x, u, p):
    """A rig that turns by its motors against its own drag."""
    return {'rate': p['gain'] * u['u'] - p['drag'] * x['rate'] + p['trim']}


RIG = qs.Base('rig', states=('rate',), keep=('lag', 'delay'), rhs=law, parameters=(
    qs.Quantity('gain', 'rad/s² per V', 20.0), qs.Quantity('drag', '1/s', 1.0),
    qs.Quantity('trim', 'rad/s²', 0.0, positive=False)))


def arrays(axis, plan=SHORT):
    flight = fly(axis, 5, plan)
    return {'u': 20.0 * flight.control[:, 1], 'y': flight.rates[:, 0], 'dt': DT,
            'units': {'u': 'V', 'y': 'rad/s'}}


@pytest.fixture(scope='module')
def answer(quickly):
    """What `identify` says of arrays with a base."""
    def identified(base, effects=qs.EFFECTS[:4], **given):
        with quickly():
            return qs.identify(base=base, effects=effects, **given)

    return identified


@pytest.fixture(scope='module')
def found(answer):
    battery = next(one for one in qs.EFFECTS if one.name == 'battery_sag')
    return answer(RIG, (*qs.EFFECTS[:4], battery), **arrays(STICKING, LONGER))


def test_its_parameters_and_what_it_lacks_are_found(found):
    """The base alone is as good as it can be: no worse than the built-in one, 0.119 rad/s."""
    assert found.verdict == 'effects_added'
    parameters = found.model.parameters
    for name, truth in (('gain', 450.0 / 20.0), ('drag', 0.4), ('trim', 0.2)):
        p = parameters[f'rig.{name}']
        assert abs(p.value - truth) < 4.0 * p.std, name
        assert p.std < 0.15 * abs(truth)
    assert parameters['rig.gain'].unit == 'rad/s² per V'
    assert {'lag', 'delay'} < parameters.keys()
    assert not {'gain', 'damping', 'bias'} & parameters.keys()
    (friction,) = found.effects
    assert (friction.name, friction.parameters[0].value) == (
        'coulomb_friction', pytest.approx(6.0, rel=0.03))
    assert friction.probability > 0.99
    assert found.errors['before'] < 0.5 * found.errors['hold_last_value']
    assert found.errors['after'] < 0.15 * found.errors['before']
    tree = found.report['axes']['roll']
    assert tree['reproducible']['coulomb_friction'] > 0.9
    assert [rung['effects'] for rung in tree['explanation']] == [['coulomb_friction']]
    assert {one['name']: one['because'] for one in tree['not_tested']}['battery_sag'].startswith(
        "it acts on the gain, which the base of one's own replaces")
    assert 'rig.drag' in str(found)
    assert 'built-in base only' in found.answer.proposal.refused_because


def test_the_time_of_a_law_begins_anew_with_each_flight():
    seen = []

    def warming(x, u, p):
        seen.append(np.max(u['time']))
        return {'rate': p['gain'] * u['u'] * (1.0 - np.exp(-u['time'])) - p['drag'] * x['rate']}

    base = qs.Base('warming', states=('rate',), inputs=('u', 'time'), keep=('lag', 'delay'),
                   rhs=warming, parameters=RIG.parameters[:2])
    given = arrays(STICKING)
    qs.undetermined(base, [qs.from_arrays(**{**given, 'y': given['y'] + 1e-9 * k})
                           for k in range(2)])
    assert 10.0 < max(seen) < 21.0  # s, the length of each


def test_its_model_runs_as_any_other(found, refusal):
    given, model = arrays(STICKING), found.model
    z = qs.IOData(given['u'], given['y'], DT)
    assert model.compare(z, 1) > 95.0
    assert model.to_control().ninputs == 1
    again = qs.Identified.from_json(model.to_json(), effects=(RIG.law(),))
    np.testing.assert_array_equal(again.simulate(z.u[:300]), model.simulate(z.u[:300]))
    assert 'whose law is not here' in refusal(qs.Identified.from_json, model.to_json())
    rpm = replace(model, units=replace(model.units, per_rate=np.pi / 30.0))
    law, = qs.Identified.from_json(rpm.to_json(), effects=(RIG.law(),)).own_effects
    assert law.units == rpm.units
    judged = qs.evaluate(model, qs.from_arrays(**given))
    assert judged.after < 0.2 * judged.before < 0.2 * judged.hold
    # in wide motion, where friction is little, it is the plant: gain over lag and damping
    w = 8.0
    plain = replace(model, effects=())
    truth = 22.5 / abs((0.4 + 1j * w) * (1.0 + 0.042j * w))
    assert plain.bode([w]).magnitude[0] == pytest.approx(truth, rel=0.05)
    assert 'flies the built-in base only' in refusal(
        qs.separate, model, ('coulomb_friction', 'nothing'))


def test_nothing_is_added_where_nothing_is_missing(answer):
    found = answer(RIG, **arrays(Axis()))
    assert (found.verdict, found.effects) == ('no_missing_effect', ())
    assert found.errors['after'] < 4.0 * found.errors['noise_floor']


def test_a_step_is_flown_as_it_stands_with_its_hidden_state():
    def step(x, u, p, dt):
        drive = u['u'] + (x['drive'] - u['u']) * math.exp(-dt / p['lag'])
        return {'drive': drive, 'rate': 0.9 * x['rate'] + dt * 0.5 * (drive + x['drive'])}

    motor = qs.Base('motor', ('rate', 'drive'), (qs.Quantity('lag', 's', 0.03),), step=step)
    model = model_of(gyro_filter_hz=None, **dict.fromkeys(BUILT_IN_TERMS, 0.0),
                     **{'motor.lag': 0.03})
    u, expected, x = np.repeat([0.3, -0.2, 0.1], 20), [], {'rate': 0.0, 'drive': 0.0}
    for one in u:
        expected.append(x['rate'])
        x = step(x, {'u': one}, {'lag': 0.03}, DT)
    run = qs.simulate(replace(model, own_effects=(motor.law(),)), u)
    np.testing.assert_allclose(run, expected, atol=2e-3 * np.ptp(expected))


def test_a_law_may_use_the_methods_of_arrays_on_its_hidden_states():
    slow = qs.Base('slow', ('rate', 'drive'), parameters=(qs.Quantity('limit', '1/s', 1.0),),
                   rhs=lambda x, u, p: {'rate': x['drive'], 'drive': (
                       u['u'] - x['drive']).clip(-p['limit'], p['limit'])})
    t = 0.01 * np.arange(50)
    s = Signals.at_rest(t, t, lagged=np.full(50, 3.0), dt=0.01)
    np.testing.assert_allclose(slow.law().trace(s, np.ones(1), {}, ((0, 50),)), [t], atol=1e-12)


def test_what_the_data_cannot_give_is_named_with_its_partner_before_the_fit():
    rig = qs.Base('rig', ('rate',), keep=('lag', 'delay'), parameters=(
        qs.Quantity('inertia', 'kg m²', 0.02), qs.Quantity('arm', 'N m per V', 0.4),
        qs.Quantity('wind', 'N m', 1.0)),
        rhs=lambda x, u, p: {'rate': (p['arm'] * u['u'] - 1e-9 * p['wind'] * x['rate'])
                             / p['inertia']})
    lines = qs.undetermined(rig, **arrays(Axis()))
    assert 'wind: the data do not depend on it' in lines
    assert any(f'{one}: only together with {other}' in line for line in lines
               for one, other in (('arm', 'inertia'), ('inertia', 'arm')))


@pytest.mark.parametrize(('changes', 'words'), [
    ({'parameters': ()}, 'parameters must be a tuple of different names'),
    ({'rhs': None}, 'needs one of rhs and step'),
    ({'rhs': lambda *_: {'speed': 0.0}}, "law cannot be evaluated: found KeyError: 'rate'"),
    ({'rhs': lambda *seen: seen[2]['mass']}, "found KeyError: 'mass'"),
    ({'rhs': lambda *seen: {'rate': np.sqrt(seen[1]['u'])}}, 'its law must be finite'),
    ({'rhs': lambda *seen: {'rate': np.mean(seen[1]['u'])}}, 'law must take each sample by it'),
    ({'keep': ('mass',)}, "keep must be among gain, lag, delay, damping, bias: found 'mass'"),
    ({'output': 'speed'}, "output must be among rate: found 'speed'"),
    ({'inputs': ('u', 'wind')}, "inputs must be among battery, throttle, time: found 'wind'"),
    ({'parameters': (qs.Quantity('gain', '1', -1.0),)}, 'gain must start at a positive number'),
], ids=range(10))
def test_a_base_that_is_none_is_refused_in_one_line(refusal, changes, words):
    known = {'name': 'rig', 'states': ('rate',), 'parameters': RIG.parameters, 'rhs': law}
    assert words in refusal(qs.Base, **{**known, **changes})


def test_a_base_of_an_effects_name_is_refused(refusal):
    other = replace(RIG, name='quadratic_drag')
    assert 'the name of an effect' in refusal(qs.identify, 'nowhere', base=other)


def test_a_position_without_its_measurement_is_said(refusal):
    pendulum = qs.Base('pendulum', ('rate', 'angle'), position='angle', parameters=(
        qs.Quantity('stiffness', '1/s²', 5.0),),
        rhs=lambda x, u, p: {'rate': u['u'] - p['stiffness'] * np.sin(x['angle'])})
    assert 'needs what was not measured' in refusal(
        qs.identify, base=pendulum, **arrays(Axis()))


def test_an_experiment_stays_within_its_limits_and_tells_more(true_model, refusal):
    model = qs.Identified(**vars(true_model))
    design = qs.design_experiment(model, amplitude=0.05, rate=3.0, angle=2.0, seconds=3.0)
    assert np.abs(design.u).max() <= 0.05
    assert design.largest_rate <= 3.0
    assert design.largest_angle <= 2.0
    assert repr(design) == str(design)  # a notebook shows it so
    assert np.abs(model.simulate(design.u)).max() == pytest.approx(design.largest_rate)
    assert design.ranking[0][1] >= design.ranking[-1][1]
    for name, now in design.std_now.items():
        if now is not None:
            assert design.std_expected[name] <= now * (1.0 + 1e-9)
    throttled = estimate_of('thrust_curve', (0.3,), settings={'throttle': 0.5})
    twice = [estimate_of('step_event', (1.0, size), of) for of, size in (('torque', 2.0),
                                                                         ('gain', -0.2))]
    expected = qs.design_experiment(replace(model, effects=(throttled, *twice)), amplitude=0.05,
                                    seconds=3.0).std_expected
    assert expected['thrust_curve.curvature'] > 1e3  # which constant throttle does not tell
    assert expected['step_event.change'] < 0.05
    for wrong in ({'amplitude': 0.0}, {'amplitude': 1.0, 'criterion': 'C'}):
        refusal(qs.design_experiment, model, **wrong)
