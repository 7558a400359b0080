"""The written report: schema, every figure with units, no links out, parts may be missing."""

import dataclasses
import json
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import jsonschema
import pytest

from quad_sysid.model import GainProposal
from quad_sysid.pipeline.answer import AxisAnswer
from quad_sysid.report import document, plots, selection_tables, store, tables, text
from quad_sysid.report.canvas import Picture, panels, svg
from quad_sysid.report.html import page

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
        {'closed_loop': None}, {'proposal': None}, {'rows': (), 'selected': None},
        {'train': None}, {'selected': None}, {'attitude_reference': None, 'rate_reference': None},
        {'judgement': None, 'closed_loop': None}, {'model': None, 'closed_loop': None},
        {'discovery': None, 'judgement': None}, {'proposal': GainProposal(None, 'too noisy')},
        {'segments': (), 'blackbox_error': None},
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


def test_page_is_the_same_for_the_same_answer(answers):
    report = document.document(answers, ['bag'])
    assert page(report, answers) == page(report, answers)
