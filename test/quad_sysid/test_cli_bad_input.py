"""Bad input through the commands: one line on stderr that names it, and the contract's status."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from quad_sysid.bags import read_bag, split_segments, write_bag
from quad_sysid.cli import main
from quad_sysid.report import document
from quad_sysid.report.model_file import save_models


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        ('--axis sideways',
         "must be one of roll, pitch, yaw, surge, sway, climb, all, every: found 'sideways'"),
        ('--train 0:20 --validate 10:30', 'training and validation overlap'),
        ('--train 100:130', '--train starts after the end'),
        ('--train -5:30', 'expected one argument (one that begins with - is written --train=-…)'),
        *((f'--inertia {three}', '--inertia: needs three positive numbers')
          for three in ('abc', '0.01,0.02', '0.01,0.02,-1')),
        ('--mass -1', '--mass: must be a positive number: found -1.0'),
        ('--colour', 'unrecognized arguments: --colour; see quad-sysid identify --help'),
        ('--effects nothere.py', '--effects nothere.py: there is no such file; check the path'),
    ],
)
def test_wrong_options_of_identify(plain_bag, refused, tmp_path, arguments, words):
    given = 'identify', plain_bag, '--out', tmp_path / 'out', *arguments.split()
    assert words in refused(main, *given)
    assert not (tmp_path / 'out').exists()


def test_what_the_system_refuses_is_said_in_one_line(refused, monkeypatch):
    for words in ('identify', 'look', 'export --to mat', 'fleet',
                  'design-excitation --band 1:20 --out'):
        error = refused(main, *words.split(), 300 * 'a')
        assert ': is refused by the system: found File name too long; check name, perm' in error
    with Path('/dev/full').open('w') as full:
        monkeypatch.setattr('sys.stdout', full)
        error = refused(main, 'design-excitation', '--band', '1:20')
    assert error.startswith('quad-sysid: output: is refused by the system: found No space left')


@pytest.fixture
def strange_bag(plain_bag, tmp_path, monkeypatch):
    """A bag whose name is no UTF-8, and how that is shown."""
    monkeypatch.chdir(tmp_path)
    name = os.fsdecode(b'vol_\xe9.mcap')
    shutil.copy(next(plain_bag.glob('*.mcap')), name)
    return name, r'vol_\udce9.mcap'


def test_a_name_that_is_no_utf_8_is_escaped_on_a_page(strange_bag, tmp_path, printed):
    name, shown = strange_bag
    assert shown in printed(main, 'look', name, name)
    assert shown in (tmp_path / 'several_look.html').read_text()


def test_a_name_that_is_no_utf_8_is_escaped_in_a_report(strange_bag, tmp_path, refused, refusal):
    name, shown = strange_bag
    error = refused(main, 'identify', name, '--axis', 'pitch', '--out', 'result', status=3)
    assert f'{shown}: pitch: no training segment is on this axis' in error
    report = json.loads((tmp_path / 'result' / 'report.json').read_text())
    assert (report['bags'], report['axes']['pitch']['verdict']) == ([shown], 'cannot_tell')
    assert shown in (tmp_path / 'result' / 'report.html').read_text()
    line = refusal(write_bag, read_bag(name), os.fsdecode(b'bag_\xe9'))
    assert 'is no UTF-8, as the name of a bag must be' in line


def test_a_place_that_cannot_be_written_is_said_before_the_work(
    plain_bag, refused, tmp_path, monkeypatch
):
    (tmp_path / 'file.mcap').write_text('')
    for bag in ('file.mcap', 'none.mcap'):
        assert bag in refused(main, 'identify', tmp_path / bag, '--out', tmp_path / 'out')
        assert not (tmp_path / 'out').exists()
    monkeypatch.setattr('quad_sysid.bags.read_bag', lambda _: pytest.fail('bag was read'))
    monkeypatch.setattr('quad_sysid.result.read_bag', lambda _: pytest.fail('bag was read'))
    for place in ('file.mcap', 'file.mcap/report'):
        for words in (('identify', plain_bag), ('fleet', plain_bag.parent)):
            error = refused(main, *words, '--out', tmp_path / place)
            assert ('--out' in error, 'is not a folder' in error) == (True, True), error
    if Path('/proc').is_dir():  # writable for root, says its mode; no folder can be made there
        error = refused(main, 'identify', plain_bag, '--out', '/proc/x')
        assert '--out: /proc cannot be written' in error
    error = refused(main, 'compare', plain_bag, tmp_path / 'nothere')
    assert 'nothere: cannot be read' in error


@pytest.mark.parametrize('name', ['report.html', 'report.json', 'guide.md'])
def test_a_folder_of_other_things_is_no_place_for_a_report(
    plain_bag, refused, tmp_path, capsys, name
):
    out = tmp_path / 'docs'
    out.mkdir()
    (out / name).write_text('{"schema": "mine"}')
    error = refused(main, 'identify', plain_bag, '--axis', 'roll', '--out', out)
    assert [path.name for path in out.iterdir()] == [name]
    assert error == (f'quad-sysid: {out}: holds files, but no report of an identification: '
                     f'found {name}; name a new folder, or an empty one\n')
    (out / name).unlink()
    assert main(['identify', str(plain_bag), '--axis', 'yaw', '--out', str(out)]) == 3
    assert 'no training segment is on this axis' in ' '.join(capsys.readouterr().out.split())


def test_evaluate_answers_the_axes_it_can_and_names_the_others(
    plain_bag, true_model, refused, tmp_path, capsys
):
    model = tmp_path / 'model.json'
    save_models({axis: replace(true_model, axis=axis) for axis in ('roll', 'pitch')}, model)
    assert main(['evaluate', str(model), str(plain_bag), '--axis', 'all', '--json']) == 0
    said = capsys.readouterr()
    tree = json.loads(said.out)
    assert list(tree['axes']) == ['roll']
    assert 'pitch: the rate does not move' in tree['not_answered']['pitch']
    assert said.err.count('\n') == 1
    trained = [{'role': s.role, 'start_s': s.start_s, 'end_s': s.end_s}
               for s in split_segments(read_bag(plain_bag)).segments]
    of_roll = {'roll': {'segments': trained}}
    beside = {'schema': document.SCHEMA, 'bags': ['flight'], 'axes': of_roll}
    model.with_name('report.json').write_text(json.dumps(beside))
    command = ['evaluate', str(model), str(plain_bag), '--axis', 'roll', '--json']
    for more, data in ([], 'training'), (['--validate', '2:'], 'unseen'):
        assert main([*command, *more]) == 0
        said = capsys.readouterr()
        assert json.loads(said.out)['axes']['roll']['error']['data'] == data
        assert ('identified from this flight' in said.err) == (data == 'training')
    trained[0]['start_s'] += 0.1  # another flight of that name
    for other in (json.dumps(beside), '{}', 'no report'):
        model.with_name('report.json').write_text(other)
        assert main(command) == 0
        assert json.loads(capsys.readouterr().out)['axes']['roll']['error']['data'] == 'unseen'
    for words, status, told in (
        ('--axis pitch', 3, f'quad-sysid: pitch: the rate does not move in {plain_bag} ('),
        ('--axis roll,yaw', 2, 'axes: lacks yaw; it holds'),
        ('--validate 5:5.3', 3, f'quad-sysid: roll, pitch: {plain_bag} has no window'),
        ('--validate 1e5:2e5', 2, '--validate starts after'),
    ):
        assert told in refused(main, 'evaluate', model, plain_bag, *words.split(), status=status)


def test_where_a_model_is_wanted_the_folder_of_its_report_will_do(
    plain_bag, true_model, refused, tmp_path, capsys
):
    result = tmp_path / 'result'
    result.mkdir()
    save_models({'roll': true_model}, result / 'model.json')
    for words in (
        ('evaluate', result, plain_bag, '--quiet'), ('compare', result, result, '--quiet'),
        ('export', result, '--to', 'control', '--quiet'),
    ):
        assert main([str(word) for word in words]) == 0, capsys.readouterr().err
    assert (result / 'model_export.py').exists()
    capsys.readouterr()
    for model in (result, result / 'model.json'):
        error = refused(main, 'evaluate', plain_bag, model)
        swapped = f'the model comes first: quad-sysid evaluate {model} {plain_bag}'
        assert error == f'quad-sysid: {model}: is a model, where a bag is wanted; {swapped}\n'
    error = refused(main, 'evaluate', result, result)
    assert error.endswith('where a bag is wanted; give a bag\n')
    error = refused(main, 'evaluate', plain_bag, plain_bag)
    assert 'is a folder without a model.json; give the' in error


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        ('--band 20:0.1', '--band: needs 0 < LOW < HIGH in rad/s'),
        ('--band 1', "in rad/s: found '1'; for example --band 0.1:20"),
        ('--band 0.1:2000', 'HIGH is too fast for 250 Hz'),
        ('--band 0.1:20 --amplitude-deg nan', '--amplitude-deg: must be above 0'),
        ('--separate coulomb nothing', "found 'coulomb'; do you mean coulomb_friction? docs/what"),
        ('--separate stickiness nothing', 'unknown effect'),
        ('--separate coulomb_friction', 'needs two effects or none'),
        ('--separate backlash backlash', 'two different effects'),
        ('--separate', 'without effects needs --model'),
        ('--separate mode:swinging nothing --seconds 1', 'must be from 10'),
        ('--separate mode:swinging nothing --model absent.json', 'cannot be read'),
        ('--separate backlash nothing --amplitude-deg 3', '--amplitude-deg: belongs to --band'),
        ('--band 0.1:20 --out no/such/folder/s.yaml', 'cannot be written'),
    ],
)
def test_wrong_options_of_design_excitation(refused, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    given = 'design-excitation', '--out', 'schedule.yaml', *arguments.split()
    assert words in refused(main, *given)
    assert list(tmp_path.iterdir()) == []
