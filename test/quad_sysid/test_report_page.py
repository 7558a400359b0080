"""The written report: schema, every figure with units, no links out, parts may be missing."""

import dataclasses
import json
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from quad_sysid.model import GainProposal
from quad_sysid.pipeline.answer import AxisAnswer
from quad_sysid.report import document, plots, selection_tables, store, tables, text
from quad_sysid.report.canvas import MOST_POINTS, Picture, panels, svg, thinned
from quad_sysid.report.html import page

SCHEMA = json.loads(
    (Path(document.__file__).parent / 'report.schema.json').read_text(encoding='utf-8')
)

pytestmark = pytest.mark.xdist_group('rubbed')


@pytest.fixture(scope='module')
def answers(rubbed_answer) -> dict[str, AxisAnswer]:
    return {'roll': rubbed_answer}


@pytest.fixture(scope='module')
def written(answers, tmp_path_factory):
    folder = tmp_path_factory.mktemp('report')
    store.write(folder, document.document(answers, ['flights/<one>']), answers)
    return folder


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


def test_written_report_follows_the_schema(written):
    report = json.loads((written / 'report.json').read_text())
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    jsonschema.validate(report, SCHEMA)
    report['axes']['roll']['verdict'] = 'perhaps'
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(report, SCHEMA)


def test_every_figure_is_in_the_page_and_beside_it(answers, written):
    assert answers['roll'].verdict == 'effects_added'
    expected = {name for name, _ in plots.PICTURES} - {'gain'}
    shown = Page((written / 'report.html').read_text()).figures
    assert {one.removeprefix('roll-') for one in shown} == expected
    assert len(shown) == len(set(shown))
    files = {path.stem.removeprefix('roll_') for path in (written / 'pictures').iterdir()}
    assert files == expected
    for path in (written / 'pictures').iterdir():
        content = path.read_bytes()
        assert content.startswith(b'\x89PNG')
        assert len(content) > 4000


def test_every_panel_names_both_axes_with_a_unit(answers):
    drawn = plots.gallery(answers['roll'])
    assert not drawn.failed
    for name, picture in drawn.pictures.items():
        for x, y in picture.labels:
            assert ', ' in x, name
            assert ', ' in y or (name == 'rivals' and y == 'explanation'), name


def test_page_is_self_contained_and_well_formed(written):
    text = (written / 'report.html').read_text()
    found = Page(text)
    assert not found.stack
    assert all(link.startswith('#') for link in found.links)
    assert {link[1:] for link in found.links} <= set(found.ids)
    assert 'http' not in text
    assert '<script' not in text
    assert not re.search(r'url\((?!#)', text)
    assert '@import' not in text
    assert 'flights/<one>' not in text  # what a user named is escaped
    assert 'prefers-color-scheme:dark' in text
    assert '@media print' in text
    assert 'name="viewport"' in text


def test_clip_paths_of_different_pictures_do_not_collide(written):
    clips = re.findall(r'<clipPath id="([^"]+)"', (written / 'report.html').read_text())
    assert clips
    assert len(clips) == len(set(clips))


def test_words_come_before_pictures_and_say_what_was_found(written):
    text = (written / 'report.html').read_text()
    answer, rest = text.split('<figure', 1)
    assert 'dry friction' in answer
    error = json.loads((written / 'report.json').read_text())['axes']['roll']['error']
    for key in ('before', 'after', 'noise_floor'):
        assert f'{error[key]:.3g}' in answer
    assert 'roll.rate.kp 0.12' in answer
    assert 'coulomb_friction' in rest


def test_numbers_in_tick_labels_are_not_rounded():
    figure, (one,) = panels()
    one.plot([0.0, 1.0], [0.1234, 0.1236])
    one.set_yticks([0.1234], ['0.1234'])
    text = svg(Picture('ticks', 'Ticks', '', figure), 'roll')
    assert '>0.1234<' in text
    assert not re.search(r'<path d="[^"]*\d\.\d{3}', text)


@pytest.mark.parametrize(
    'parts',
    [
        {'closed_loop': None, 'proposal': None, 'attitude_reference': None,
         'rate_reference': None},
        {'rows': (), 'selected': None, 'proposal': GainProposal(None, 'too noisy')},
        {'selected': None, 'train': None, 'segments': (), 'blackbox_error': None},
        {'judgement': None, 'closed_loop': None}, {'model': None, 'closed_loop': None},
        {'discovery': None, 'judgement': None, 'model': None, 'rows': (), 'selected': None,
         'closed_loop': None, 'proposal': None, 'train': None, 'verdict': 'cannot_tell',
         'reason': 'too short'},
    ],
    ids='+'.join,
)
def test_missing_parts_do_not_break_it(answers, parts):
    partial = {'roll': dataclasses.replace(answers['roll'], **parts)}
    report = document.document(partial, ['bag'])
    jsonschema.validate(report, SCHEMA)
    drawn = plots.gallery(partial['roll'])
    assert not drawn.failed
    found = Page(page(report, partial, {'roll': drawn}))
    assert not found.stack
    assert len(found.figures) == len(drawn.pictures)


def test_cannot_tell_says_why_once():
    answer = AxisAnswer('yaw', 250.0, (), 'cannot_tell', 'yaw: the command never moves; excite it',
                        proposal=GainProposal(None, 'the same'))
    text = page(document.document({'yaw': answer}, ['bag']), {'yaw': answer})
    assert text.count('command never moves') == 1
    assert '<figure' not in text


def test_nothing_is_completed_where_nothing_was_added(answers):
    tree = document.document(answers, ['bag'])['axes']['roll']
    told = [tables.errors, tables.parameters, selection_tables.residuals]
    assert all('completed' in tell(tree) for tell in told)
    assert any('completed' in line for line in text.lines({'axes': {'roll': tree}}))
    bare = {**tree, 'effects': [], 'verdict': 'no_missing_effect'}
    assert not any('completed' in tell(bare) for tell in told)
    assert all('base' in tell(bare) for tell in told)
    assert not any('completed' in line for line in text.lines({'axes': {'roll': bare}}))


def test_a_picture_that_fails_is_named_and_the_rest_stand(answers, monkeypatch):
    def broken(_):
        raise ValueError('no such window')

    monkeypatch.setattr(plots, 'PICTURES', (('spectra', broken), *plots.PICTURES[3:5]))
    drawn = plots.gallery(answers['roll'])
    assert drawn.failed == (('spectra', 'no such window'),)
    assert list(drawn.pictures) == ['coherence', 'free_run']
    text = page(document.document(answers, ['bag']), answers, {'roll': drawn})
    assert 'picture spectra could not be drawn: no such window' in text


def test_pictures_can_be_skipped(answers, tmp_path):
    report = document.document(answers, ['bag'])
    store.write(tmp_path / 'a', report, answers, pictures=False)
    assert sorted(p.name for p in (tmp_path / 'a').iterdir()) == [
        'model.json', 'report.html', 'report.json',
    ]
    store.write(tmp_path / 'b', report, answers, html=False, pictures=False)
    assert sorted(p.name for p in (tmp_path / 'b').iterdir()) == ['model.json', 'report.json']


def test_matplotlib_is_loaded_only_when_something_is_drawn():
    code = 'import sys, quad_sysid.report.store; sys.exit("matplotlib" in sys.modules)'
    subprocess.run([sys.executable, '-c', code], check=True)


def test_page_is_the_same_for_the_same_answer(answers, written):
    report = document.document(answers, ['flights/<one>'])
    assert page(report, answers) == (written / 'report.html').read_text()


@pytest.fixture(scope='module')
def tree(written) -> dict:
    return json.loads((written / 'report.json').read_text())['axes']['roll']


def test_friction_is_seen_in_what_the_base_leaves_and_gone_when_it_is_added(tree):
    before, after = tree['residual']['before'], tree['residual']['after']
    assert list(tree['residual']) == ['before', 'after', 'blackbox']
    assert not before['uncorrelated_with_input']
    left = [abs(one['largest_cross_correlation']['value']) for one in (after, before)]
    assert left[0] < 0.5 * left[1]
    assert after['rms'] < before['rms']
    assert after['missing_torque']['rms'] < 0.7 * before['missing_torque']['rms']
    assert before['missing_torque']['unit'] == 'rad/s²'
    for one in tree['residual'].values():
        assert one['samples'] > 1000
        assert 0.0 <= one['p_white'] <= 1.0
        assert abs(one['largest_cross_correlation']['value']) <= 1.0


def test_the_picture_of_the_missing_torque_shows_the_friction_over_the_rate(answers):
    """Points of the mean torque, 0.8 rad/s² against the rate: within a quarter away from zero."""
    picture = plots.gallery(answers['roll']).pictures['effect_shape']
    assert picture.labels == (('rate, rad/s', 'torque / inertia, rad/s²'),)
    points = [box.lines[0].get_xydata() for box in picture.figure.axes[0].containers]
    x, y = np.concatenate(points).T
    away = np.abs(x) > 0.4
    assert away.sum() >= 4
    np.testing.assert_allclose(y[away], -0.8 * np.sign(x[away]), atol=0.2)


def test_a_thinned_line_keeps_extremes_and_gaps():
    n = 50_000
    signal = np.sin(np.arange(n) * 0.01)
    signal[12_345], signal[30_000:40_000] = 7.0, np.nan
    time_s, values = thinned(np.arange(n) * 0.004, signal)
    assert values.size <= MOST_POINTS + 2
    assert np.nanmax(values) == 7.0
    assert time_s[np.nanargmax(values)] == pytest.approx(12_345 * 0.004)
    assert np.isnan(values).any()
    assert np.all(np.diff(time_s) >= 0.0)


SELECTION = {
    'approaches': [
        {'name': 'direct', 'possible': True, 'because': 'command and rate are recorded'},
        {'name': 'indirect', 'possible': False, 'because': 'gains < unknown'},
    ],
    'feedback': True,
    'table2': [
        {'name': 'ARX 10 10 5', 'paper': {'prbs': 73.84, 'square': 80.15, 'train': 98.3,
                                          'kept': True},
         'fit_train_pct': 99.02, 'fit_validation_pct': {'prbs': 95.41, 'square': None},
         'passed_first_step': True, 'because': ''},
    ],
    'roll_and_pitch': {'agree': True, 'because': 'bands overlap', 'model': None,
                       'fit_validation_pct': {'roll': 91.26, 'pitch': None}},
}


def test_approaches_table_2_and_the_shared_model_are_told_where_they_are():
    assert 'gains &lt; unknown' in selection_tables.approaches(SELECTION)
    row = selection_tables.table2(SELECTION)
    assert all(part in row for part in ('ARX 10 10 5 *', '99.0', '98.3', '95.4', '73.8', '80.2'))
    told = selection_tables.shared(SELECTION)
    assert 'roll 91.3 %' in told
    assert 'pitch –' not in told
    for part in ('approaches', 'table2', 'shared', 'residuals'):
        assert getattr(selection_tables, part)({}) == ''
