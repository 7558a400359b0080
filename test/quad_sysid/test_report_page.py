"""The written report: schema, every figure with units, no links out, parts may be missing."""

import dataclasses
import json
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from flown_axis import model_of

from quad_sysid.effects import EFFECTS
from quad_sysid.estimate.stored import estimate_of
from quad_sysid.model import GainProposal, RungModel
from quad_sysid.pipeline.answer import AxisAnswer
from quad_sysid.report import document, plots, store, tables
from quad_sysid.report.html import model_excerpt, page
from quad_sysid.report.words import causes, on_this_flight, reach
from quad_sysid.whole import whole_of

SCHEMA = json.loads(
    (Path(document.__file__).parent / 'report.schema.json').read_text(encoding='utf-8')
)


@pytest.fixture(scope='module')
def answers(rubbed_answer) -> dict[str, AxisAnswer]:
    return {'roll': rubbed_answer}


@pytest.fixture(scope='module')
def written(answers, tmp_path_factory):
    folder = tmp_path_factory.mktemp('report')
    store.write(folder, document.document(answers, ['flights/<one>']), answers)
    return folder


@pytest.fixture(scope='module')
def drawn(rubbed_answer) -> plots.Gallery:
    return plots.gallery(rubbed_answer)


class Page(HTMLParser):
    """Ids of figures, links and whether the tags nest."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.figures: list[str] = []
        self.links: list[str] = []
        self.ids: list[str] = []
        self.stack: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.links += [values[k] for k in ('href', 'src', 'xlink:href', 'action') if k in values]
        if 'id' in values:
            self.ids.append(values['id'])
        if tag == 'figure':
            self.figures.append(values['id'])
        if tag not in ('meta', 'br', 'link'):
            self.stack.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        self.stack.pop()

    def handle_endtag(self, tag):
        assert self.stack.pop() == tag


def test_the_page_begins_with_the_answer(written, answers):
    fact = {'name': 'mass', 'value': 1.2, 'std': 0.1, 'unit': 'kg', 'how': 'by its weight'}
    report = json.loads((written / 'report.json').read_text())
    text = page({**report, 'aircraft': {'facts': [fact], 'urdf': ''}}, answers,
                {'roll': plots.Gallery({})})
    assert 0 < text.index('The plain model lacks dry friction') < text.index('1.20 ± 0.10')
    assert 'URDF' not in text


def test_an_aircraft_without_motors_is_not_described(rubbed_flight):
    motors = np.full((rubbed_flight.n, 4), 0.5)
    known = dataclasses.replace(rubbed_flight.craft, nominal=False)
    for change, described in (({'motors': motors}, True), ({'motors': None}, False),
                              ({'motors': None, 'craft': known}, True)):
        record = dataclasses.replace(rubbed_flight, **change)
        assert bool(whole_of({}, [record]).urdf) == described


def test_written_report_follows_the_schema(written, tmp_path):
    report = json.loads((written / 'report.json').read_text())
    jsonschema.validate(report, SCHEMA)
    still = {'yaw': AxisAnswer('yaw', 250.0, (), 'cannot_tell', 'still')}
    for more, options in (['report.html'], {}), ([], {'html': False}):
        folder = tmp_path / f'{len(more)}'
        store.write(folder, document.document(still, ['bag']), still, pictures=False, **options)
        assert sorted(path.name for path in folder.iterdir()) == [*more, 'report.json']
    report['axes']['roll']['verdict'] = 'perhaps'
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(report, SCHEMA)


def test_a_report_leaves_nothing_of_an_earlier_one(written, tmp_path):
    out, answers = tmp_path / 'out', {'yaw': AxisAnswer('yaw', 250.0, (), 'cannot_tell', 'still')}
    shutil.copytree(written, out)
    (out / 'pictures' / 'mine.png').write_bytes(b'mine')
    (out / 'gains.json').write_text('{}')
    assert (out / 'model.json').exists()
    store.write(out, document.document(answers, ['bag']), answers)
    left = sorted(str(p.relative_to(out)) for p in out.rglob('*') if p.is_file())
    assert left == ['gains.json', 'pictures/mine.png', 'report.html', 'report.json']
    assert list(json.loads((out / 'report.json').read_text())['axes']) == ['yaw']


def test_every_figure_is_in_the_page_and_beside_it(answers, written):
    assert answers['roll'].verdict == 'effects_added'
    answer, rest = (written / 'report.html').read_text().split('<figure', 1)
    for words in ('The plain model lacks dry friction', 'roll.rate.kp 0.12'):  # before pictures
        assert words in answer
    assert 'coulomb_friction' in rest
    expected = {one.name for one in plots.PICTURES}
    if not any(effect.rivals for effect in answers['roll'].model.effects):
        expected.discard('rivals')
    shown = Page((written / 'report.html').read_text()).figures
    assert sorted(one.removeprefix('roll-') for one in shown) == sorted(expected)
    files = {p.stem.removeprefix('roll_'): p.read_bytes() for p in written.glob('pictures/*')}
    assert set(files) == expected
    assert all(png.startswith(b'\x89PNG') and len(png) > 4000 for png in files.values())


def test_page_is_self_contained_well_formed_and_the_same_for_the_same_answer(
    answers, written, drawn
):
    text = (written / 'report.html').read_text()
    tree = document.document(answers, ['flights/<one>'])
    assert page(tree, answers, {'roll': drawn}) == text
    found = Page(text)
    assert not found.stack
    assert all(link.startswith('#') for link in found.links)
    assert {link[1:] for link in found.links} <= set(found.ids)
    assert not re.search(r'url\((?!#)', text)
    for absent in ('http', '<script src', '@import', 'flights/<one>'):  # a user's name is escaped
        assert absent not in text
    for there in ('prefers-color-scheme:dark', '@media print', 'name="viewport"'):
        assert there in text
    clips = re.findall(r'<clipPath id="([^"]+)"', text)
    assert len(clips) == len(set(clips)) > 0


@pytest.mark.parametrize(
    'parts',
    [
        {'closed_loop': None, 'proposal': None, 'attitude_reference': None,
         'rate_reference': None, 'rows': (), 'selected': None},
        {'selected': None, 'train': None, 'segments': (), 'blackbox_error': None,
         'proposal': GainProposal(None, 'too noisy')},
        {'findings': None, 'closed_loop': None},
        {'findings': None, 'model': None, 'rows': (), 'selected': None, 'closed_loop': None,
         'proposal': GainProposal(None, 'the same'), 'train': None, 'verdict': 'cannot_tell',
         'reason': 'roll: the command never moves; excite it'},
    ],
    ids='+'.join,
)
def test_missing_parts_do_not_break_it(answers, parts):
    partial = {'roll': dataclasses.replace(answers['roll'], **parts)}
    report = document.document(partial, ['bag'])
    jsonschema.validate(report, SCHEMA)
    assert not plots.gallery(partial['roll']).failed
    text = page(report, partial, {'roll': plots.Gallery({})})
    assert not Page(text).stack
    assert text.count('command never moves') == ('reason' in parts)


def test_the_answer_begins_with_the_cause_and_how_much_it_explains(tree):
    sentence = causes(tree)
    (effect,) = tree['effects']
    assert sentence.startswith(f'Dry friction of {effect["parameters"][0]["value"]:.3g} rad/s²')
    assert f'explains {effect["explains_pct"]:.0f} % of what the base misses' in sentence
    assert 'resampled flights' in sentence
    assert causes({**tree, 'effects': []}) == ''
    for kind, name, parameters, said in (
            ('named', 'battery_sag', [('exponent', 2.11, '1')], '(exponent 2.11)'),
            ('named', 'step_event', [('time', 18.0, 's')], 'in flight at 18 s'),
            ('named', 'resonance', [('frequency', 6.0, 'Hz')], 'lightly damped mode of 6 Hz'),
            ('named', 'periodic_disturbance', [('amplitude', 3.0, 'rad/s²'), (
                'frequency', 6.0, 'Hz')], 'disturbance of 3 rad/s² at 6 Hz'),
            ('mode', 'mode:second_order', [('frequency', 6.0, 'Hz')],
             'damped mode (such as motors under a speed controller) at 6 Hz')):
        other = {**effect, 'name': name, 'kind': kind, 'parameters': [
            dict(zip(('name', 'value', 'unit'), p, strict=True)) for p in parameters]}
        assert f'{said} explains' in causes({**tree, 'effects': [other]})
    large = {**effect, 'parameters': [{'name': 'torque', 'value': 1380.0, 'unit': 'rad/s²'}]}
    assert 'of 1380 rad/s²' in causes({**tree, 'effects': [large]})
    motors = {**effect, 'name': 'mode:lead', 'kind': 'mode'}
    assert 'otors that overshoot explain ' in causes({**tree, 'effects': [motors]})
    assert tables.effects(tree).rows[0][-1] == f'-{effect["error_reduction_pct"]:.0f} %'
    first, *finer = tables.explanation(tree).rows
    assert first[1] == 'coulomb_friction'
    assert all(row[1] != 'coulomb_friction' for row in finer)
    for error in (3.7e18, None):  # what is infinite is null in report.json
        gone = {**tree['explanation'][0], 'error': error}
        assert tables.explanation({**tree, 'explanation': [gone]}).rows[0][-1] == 'runs away'
    assert sentence in page({'axes': {'roll': tree}, 'bags': ['flight']}, {}, {})
    assert '<h1>Identification of .</h1>' in page({'axes': {}, 'bags': ['.']}, {}, {})


@pytest.fixture(scope='module')
def tree(written) -> dict:
    return json.loads((written / 'report.json').read_text())['axes']['roll']


def test_a_models_cell_says_what_each_rung_adds_and_marks_the_answer():
    rubs, sticks = (estimate_of('coulomb_friction', [], form) for form in ('', 'stribeck'))
    rungs = tuple(RungModel((), (one,), None, percent, 0.1)
                  for one, percent in ((rubs, 90.0), (sticks, 100.0)))
    shown = model_excerpt(dataclasses.replace(model_of(rubs), rungs=rungs), {})
    assert 'coulomb_friction: 90 %' in shown
    assert 'coulomb_friction in another form: 100 %' in shown
    assert shown.count('opacity:1') == 1


def test_friction_is_seen_in_what_the_base_leaves_and_gone_when_it_is_added(tree):
    before, after = tree['residual']['before'], tree['residual']['after']
    assert list(tree['residual']) == ['before', 'after', 'blackbox']
    assert after['rms'] < before['rms']
    assert after['missing_torque']['rms'] < 0.7 * before['missing_torque']['rms']
    assert before['missing_torque']['unit'] == 'rad/s²'
    for one in tree['residual'].values():
        assert one['samples'] > 1000
        assert 0.0 <= one['p_white'] <= 1.0
        assert abs(one['largest_cross_correlation']['value']) <= 1.0


def test_every_panel_names_both_axes_with_a_unit(drawn):
    assert not drawn.failed
    for name, picture in drawn.pictures.items():
        for x, y in picture.labels:
            assert ', ' in x, name
            assert ', ' in y or (name == 'rivals' and y == 'explanation'), name
    picture = drawn.pictures['effect_shape']
    assert picture.labels == (('rate, rad/s', 'torque / inertia, rad/s²'),)
    points = [box.lines[0].get_xydata() for box in picture.figure.axes[0].containers]
    x, y = np.concatenate(points).T
    away = np.abs(x) > 0.4
    assert away.sum() >= 4
    np.testing.assert_allclose(y[away], -0.8 * np.sign(x[away]), atol=0.2)


def test_the_error_over_the_horizon_grows_from_the_noise_and_is_told(tree):
    listed = tree['error']['horizons']
    assert [h['horizon_s'] for h in listed] == [0.02, 0.05, 0.1, 0.2, 0.5, 1.0]
    for h in listed[1:]:
        assert h['after'] < h['before'] < h['hold'], h
        assert h['blackbox'] is not None
    assert listed[0]['after'] < 2.0 * tree['error']['noise_floor']
    assert listed[-1]['before'] > 2.0 * listed[1]['before']
    noise = {p['name']: p['value'] for p in tree['base']['noise']}
    assert set(noise) >= {'disturbance_rms', 'disturbance_correlation', 'measurement_rms'}


@pytest.mark.parametrize(
    ('after', 'far'), [((0.1, 0.1, 0.1), 1.0), ((0.1, 0.2, 0.9), 0.1), ((0.4, 0.8, 0.9), None)]
)
def test_worth_ends_where_holding_is_no_longer_twice_as_wrong(after, far):
    error = {'unit': 'rad/s', 'horizons': [
        {'horizon_s': s, 'hold': hold, 'before': 1.0, 'after': one, 'blackbox': None}
        for s, hold, one in zip((0.05, 0.1, 1.0), (0.5, 1.0, 1.2), after, strict=True)
    ]}
    assert reach(error) == far


@pytest.mark.parametrize(('before', 'after', 'said', 'unsaid'), [
    (0.4, 0.2, f'{EFFECTS[0].name} lowers the error by 50 %', 'hold'),
    (0.2, 0.2, 'hardly changes the error', 'hold'),
    (0.2, 0.3, 'raises the error by 50 %. The model does not hold here', 'holding'),
    (1.2, 1.1, 'no better than holding the last value (1.1 to 1 rad/s)', 'raises'),
    (0.4, 0.11, 'Its error is 11 % of the motion here and was 5 %', 'does not hold'),
    (0.4, 0.09, 'by 78 %', 'same aircraft'),
])
def test_what_a_stored_model_does_on_another_flight(before, after, said, unsaid):
    error = {'before': before, 'after': after, 'hold_last_value': 1.0, 'unit': 'rad/s'}
    error |= {'own': (0.05, 1.0)} if after < 0.2 else {}
    text = on_this_flight({'effects': [EFFECTS[0]], 'error': error})
    assert said in text
    assert unsaid not in text


def test_the_figures_of_a_design_stand_beside_its_own_gains(tree):
    """Where the update that is sent lies on the way, the table has the target, and names both."""
    first, end = ({'roll.rate.kp': kp} for kp in (0.0755, 0.0912))
    text = '\n'.join(tables.gains(
        {**tree, 'gains': first, 'gain_steps': [first, end]}, 'roll', {}).text())
    assert re.search(r'roll\.rate\.kp +\S+ +0\.0912 ', text)
    assert 'send roll.rate.kp 0.0755 first' in ' '.join(text.split())
