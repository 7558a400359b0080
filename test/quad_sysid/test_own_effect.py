"""An effect that the package has never heard of, handed to `identify`: it goes all the way."""

import inspect
import json
import math
import os
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jsonschema
import numpy as np
import pytest
from flown_axis import SHORT, UNSEEN, Axis, fly, model_of
from node_process import python

import quad_sysid as qs
from quad_sysid.arguments import own_effects
from quad_sysid.cli import main
from quad_sysid.effects import _installed
from quad_sysid.loop.from_model import loop_plant
from quad_sysid.loop.linear import STILL, WIDE, linear, loops_of
from quad_sysid.model import EffectEstimate, Parameter
from quad_sysid.model.checked import checked
from quad_sysid.pipeline import identify
from quad_sysid.report import html, plots
from quad_sysid.result import installed_designer
from quad_tuning.cli import main as tune


class Cogging(qs.Effect):
    """The magnets of a gimbal motor: a torque that goes round twelve times in a turn."""

    name = 'cogging'
    signals = ('angle',)
    parameters = (qs.Spec('torque', 'rad/s²'),)

    def torque(self, s, p, settings):
        del settings
        return -p[0] * np.sin(12.0 * s.angle)


TRUTH = 4.0
AXIS = Axis(torque=lambda _t, _rate, angle: -TRUTH * math.sin(12.0 * angle))
OWN = (*qs.EFFECTS[:8], Cogging())
"""Beside friction, drag, springs, play and the like."""


@pytest.fixture(scope='module')
def result(quickly):
    with quickly():
        return qs.identify(fly(AXIS, 5, SHORT), axes='roll', effects=OWN)


def test_it_is_fitted_chosen_and_reported(result):
    assert [effect.name for effect in result.effects] == ['cogging']
    assert result.report['axes']['roll']['own_effects'][0]['outcome'] == 'added'
    torque = result.effects[0].parameters[0]
    assert abs(torque.value - TRUTH) < 4.0 * torque.std
    assert result.errors['after'] < 0.5 * result.errors['before']
    assert 'cogging' in str(result)
    assert 'cogging' in result._repr_html_()
    assert result.plot('effect_shape').axes


def written(folder):
    file = folder / 'mine.py'
    file.write_text(f'import numpy as np\nimport quad_sysid as qs\n{inspect.getsource(Cogging)}')
    return str(file)


@pytest.mark.usefixtures('quick')
def test_it_is_stored_read_back_simulated_and_judged(result, tmp_path, refused, refusal):
    folder = result.save(tmp_path / 'out', pictures=False).folder
    assert 'cogging' in (folder / 'report.html').read_text()
    again = qs.read_model(folder, effects=OWN)
    u = 0.01 * np.sign(np.sin(np.arange(1500) * 0.02))
    np.testing.assert_allclose(again.simulate(u), result.model.simulate(u), rtol=1e-12)
    assert np.abs(again.simulate(u) - replace(again, effects=()).simulate(u)).max() > 0.1
    unseen = qs.evaluate(again, fly(AXIS, 6, UNSEEN))
    assert unseen.after < 0.6 * unseen.before
    file, model = written(tmp_path), str(folder / 'model.json')
    lacks = f'{model}: model: roll.effects: names an effect that is not known here: found cogging'
    assert lacks in refusal(qs.read_model, folder)
    for run, words in ((main, ['export', model, '--to', 'control']), (tune, ['design', model])):
        said = refused(run, *words)
        assert lacks in said
        assert '--effects FILE.py' in said
        assert run([*words, '--effects', file, '--quiet']) == 0


def test_a_file_of_effects_imports_what_lies_beside_it(tmp_path, monkeypatch):
    monkeypatch.setattr('sys.path', [*sys.path])
    written(tmp_path)
    (tmp_path / 'chosen.py').write_text('from mine import Cogging\nEFFECTS = (Cogging(),)\n')
    assert [effect.name for effect in own_effects(str(tmp_path / 'chosen.py'))] == ['cogging']


def test_one_of_an_installed_package_is_among_ours(tmp_path):
    with Path(written(tmp_path)).open('a') as file:
        file.write('EFFECTS = (Cogging(),)\n')
    info = tmp_path / 'mine-1.dist-info'
    info.mkdir()
    (info / 'METADATA').write_text('Metadata-Version: 2.1\nName: mine\nVersion: 1\n')
    (info / 'entry_points.txt').write_text('[quad_sysid.effects]\nmine = mine:EFFECTS\n')
    done = python('-c', 'import quad_sysid as qs; print(*(e.name for e in qs.EFFECTS))',
                  env={'PYTHONPATH': f'{tmp_path}:{os.environ.get("PYTHONPATH", "")}'})
    assert 'cogging' in done.stdout.split(), done.stderr


def offered(value, load):
    return SimpleNamespace(name='pid', value=value, load=load)


@pytest.mark.parametrize(('second', 'words'), [
    (lambda: 1 / 0, 'entry point b:E: cannot be loaded: found ZeroDivisionError: division by'),
    (lambda: (Cogging(),), 'entry point b:E: two effects have one name: found cogging'),
])
def test_a_package_that_fails_or_repeats_a_name_is_said_in_one_line(
        monkeypatch, refusal, second, words):
    entries = [offered('a:E', lambda: (Cogging(),)), offered('b:E', second)]
    monkeypatch.setattr('quad_sysid.effects.entry_points', lambda **_: entries)
    assert words in refusal(_installed)


def test_another_packages_designer_comes_before_quad_tunings(monkeypatch):
    ours, mine, other = (offered(f'{name}:design', lambda name=name: name)
                         for name in ('quad_tuning.designer', 'mine', 'other'))
    broken = offered('broken:design', lambda: 1 / 0)
    for entries, designer, words in (
        ([ours], 'quad_tuning.designer', ''), ([mine, ours], 'mine', ''),
        ([ours, mine], 'mine', ''), ([mine, ours, other], None, '(mine:design, other:design); un'),
        ([ours, broken], None, 'broken:design cannot be loaded: ZeroDivisionError'),
        ([], None, 'install quad_tuning'),
    ):
        monkeypatch.setattr('quad_sysid.result.entry_points', lambda entries=entries, **_: entries)
        found, because = installed_designer()
        assert found == designer
        assert words in because


class Late(Cogging):
    """The same a tenth of a second later; the size of its parameter follows from the flight."""

    states = 1

    def torque(self, s, p, _):
        return -p[0] * s.hidden[0]

    def advance(self, x, s, *_):
        return x + 10.0 * s.dt * (np.sin(12.0 * s.angle) - s.hidden)


class Unmeasured(Cogging):
    """What needs a signal that the flight lacks."""

    name = 'unmeasured'

    def prepare(self, data):
        del data
        return 'nobody measured it'


@pytest.mark.usefixtures('quick')
def test_one_that_loses_is_reported_with_its_evidence(plain_flight):
    result = qs.identify(plain_flight, 'roll', effects=(Late(), Unmeasured()))
    tree = result.report['axes']['roll']
    lost, not_tested = tree['own_effects']
    assert (lost['name'], lost['outcome']) == ('cogging', 'not_added')
    assert lost['log_evidence_over_base'] <= lost['best']['log_evidence_over_base']
    assert any('cogging' in structure['effects'] for structure in tree['tried'])
    assert not_tested == {'name': 'unmeasured', 'outcome': 'not_tested',
                          'because': 'nobody measured it'}
    said = ' '.join(str(result).split())
    assert 'your effect cogging: tried and not added: log evidence over the base' in said
    assert 'your effect unmeasured: not tested: nobody measured it' in said
    page = html.page(result.report, result.answers, {'roll': plots.Gallery({}, ())})
    assert 'tried and not added: log evidence' in page
    schema = Path(html.__file__).with_name('report.schema.json').read_text()
    jsonschema.validate(result.report, json.loads(schema))


def test_it_is_linearised_designed_for_and_separated(result, monkeypatch):
    (part, _), *_ = linear(loop_plant(result.model), STILL).plant.torque_effects
    slope = part.effect.rows[0, 1]
    assert slope == pytest.approx(-12.0 * TRUTH, rel=0.05)
    assert result.gains['roll.rate.kp'] > 0.0
    monkeypatch.setattr('quad_sysid.separation.design.FITTED', 1)
    found = qs.separate(result.model, ('cogging', 'pendulum_stiffness'), 10.0)
    assert found.best.worst.nats > 0.0
    words = ['design-excitation', '--quiet', '--seconds', '10', '--separate', 'cogging', 'nothing']
    assert main(words) == 2


class SlowDrag(qs.Effect):
    """Drag by the square of the rate, which builds up over a third of a second."""

    name, signals, states = 'slow_drag', ('rate',), 1
    parameters = (qs.Spec('coefficient', '1/rad'),)

    def torque(self, s, p, _):
        return -p[0] * s.hidden[0]

    def advance(self, x, s, *_):
        return x + s.dt / 0.3 * (s.rate * np.abs(s.rate) - s.hidden)


class SlowMotors(qs.Effect):
    """A second lag of the motors; it does not say that it has a history."""

    name, signals, states = 'slow_motors', ('command',), 1
    parameters = (qs.Spec('lag', 's', spread=0.1, centre=0.06),)

    def command(self, s, *_):
        return s.hidden[0]

    def advance(self, x, s, p, _):
        return x + s.dt / p[0] * (s.sent - x)


def test_margins_have_the_memory_of_an_effect_of_ones_own():
    """A damping is no spring that drives away, and a lag of the command turns its phase."""
    drag, motors = (
        loop_plant(replace(model_of(EffectEstimate(one.name, 'named', one.signals, (
            Parameter(one.parameters[0].name, value, 0.1, ''),))), own_effects=(one,)))
        for one, value in ((SlowDrag(), 3.0), (SlowMotors(), 0.06)))
    (part, _), *_ = linear(drag, WIDE).plant.torque_effects
    assert part.effect.rows[0, 0] == pytest.approx(1.0 - 0.004 / 0.3)
    assert abs(part.effect.rows[0, 2]) < 0.2 * part.effect.rows[0, 1] * (4.0 / 0.35)
    w = np.array([10.0])
    late, usual = (loops_of([(one, WIDE)]).response(w)[0, 0, 0]
                   for one in (motors, loop_plant(model_of())))
    assert np.angle(late / usual) == pytest.approx(-math.atan(0.6), abs=0.05)


def test_ours_would_be_accepted_from_anybody():
    assert checked(qs.EFFECTS, 'ours') == qs.EFFECTS


def like(torque=Cogging.torque, **changes):
    """A class like Cogging, another torque or other fields in it."""
    return type('Mine', (Cogging,), {'torque': torque, **changes})


@pytest.mark.parametrize(
    ('effects', 'words'),
    [
        (Cogging(), 'must be a sequence of effects'),
        ((Cogging,), 'must hold instances of quad_sysid.Effect: found the class Cogging'),
        (('coulomb_friction',), "quad_sysid.Effect: found 'coulomb_friction'"),
        ((*OWN, Cogging()), 'two effects have one name: found cogging'),
        ((like(signals=('angel',))(),), "unknown one: found 'angel'; there are rate, angle, com"),
        ((like(lambda _, s, p, __: p[0] * s.rates)(),), 'evaluated: found AttributeError'),
        ((like(lambda *given: -given[2][0])(),), '`torque` must give an array like s.rate'),
        ((like(lambda _, s, p, __: p[0] * np.sqrt(s.rate))(),), '`torque` must be finite'),
        ((like(lambda _, s, p, __: s.rate * p[0] ** 2)(),), 'not linear in its parameters'),
        ((like(lambda _, s, p, __: p[0] * np.gradient(s.rate))(),), '`torque` must take each sam'),
        ((like(lambda _, s, p, __: np.multiply(p[0], s.rate, s.rate))(),), 'array is read-only'),
        ((like(command=lambda _, __, p, ___: p[0])(),), '`command` must give an array like s.ra'),
        ((like(actuate=lambda _, drive, *__: drive.lag)(),), "no attribute 'commands'"),
        ((like(advance=lambda _, x, *__: x[0], states=2)(),), '(500,) for (2, 500)'),
        ((like(advance=lambda _, x, s, *__: x + np.sqrt(s.rate), states=1)(),), '`advance` must'),
        ((like(prepare=lambda *_: None)(),), 'is not a mapping'),
        ((like(lambda _, s, p, by: p[0] * (2.0 * by['knots'])[0] * s.angle,
               prepare=lambda *_: {'knots': np.ones(3)})(),), "can't multiply sequence"),
        ((like(parameters=2 * Cogging.parameters)(),), 'two parameters have one name'),
        ((like(parameters=(qs.Spec('torque', 'rad/s²', log=True),))(),), '`spread` must be a pos'),
    ],
)
def test_an_effect_that_is_none_is_refused_before_the_flight_is_read(
    tmp_path, refusal, effects, words
):
    assert words in refusal(qs.identify, tmp_path / 'none', 'roll', effects=effects)


def test_an_effect_that_fails_at_large_rates_is_named_in_one_line(tmp_path, result, refused):
    model = result.save(tmp_path / 'out', pictures=False).folder / 'model.json'
    file = Path(written(tmp_path))
    law = 'assert np.abs(s.rate).max() < 1.001, "beyond my table"'
    file.write_text(file.read_text().replace('del settings', law))
    error = refused(tune, 'design', model, '--effects', file)
    assert f'{file}:11: Cogging.torque fails: found AssertionError: beyond my table; see' in error


@pytest.mark.parametrize(('given', 'words'), [
    ({'roll.rate.kp': 0.06}, "the designer gave {'roll.rate.kp': 0.06} instead of a GainProposal"),
    (qs.GainProposal({'roll.rate.kp': math.nan}), 'what is no gain of roll: roll.rate.kp = nan'),
    (qs.GainProposal({'pitch.rate.kp': 0.06}), 'what is no gain of roll: pitch.rate.kp = 0.06'),
    (qs.GainProposal({'roll.rate.kp': np.float32(0.06)}), ''),
    (lambda model: 1.0 / (model.axis == 'yaw'), 'found ZeroDivisionError: float division by zero'),
])
def test_what_a_designer_of_ones_own_gives_is_gains_of_its_axis_or_refused(given, words):
    options = identify.Options(designer=given if callable(given) else lambda _: given)
    proposal = identify._proposal(SimpleNamespace(axis='roll'), model_of(), options, str)
    assert words in proposal.refused_because
    assert (proposal is given) == (not words)
