"""Bad input through the commands: one line on stderr that names it, and the contract's status."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import jsonschema
import numpy as np
import pytest

import quad_sysid.report
from quad_sysid.bags import write_bag
from quad_sysid.cli import main
from quad_sysid.record import Record, Segment

Run = Callable[..., tuple[int, str]]
DT = 0.004
SCHEMA = Path(quad_sysid.report.__file__).with_name('report.schema.json')


def flight(seconds: float = 30.0, *, seed: int = 1) -> Record:
    """Roll driven by a random binary command through a first-order lag; the rest stands still."""
    rng = np.random.default_rng(seed)
    n = round(seconds / DT)
    control = np.zeros((n, 4))
    control[:, 0] = 0.5
    control[:, 1] = 0.02 * np.repeat(rng.choice([-1.0, 1.0], n // 25 + 1), 25)[:n]
    rates = rng.normal(0.0, 0.002, (n, 3))
    rate = lag = 0.0
    for k in range(n):
        lag += DT / 0.05 * (control[k, 1] - lag)
        rate += DT * (400.0 * lag - 3.0 * rate)
        rates[k, 0] += rate
    return Record(source='flight', dt=DT, rates=rates, control=control, t0_ns=10**18)


def bag(path: Path, record: Record, **changed: object) -> Path:
    """Write `record` with some fields replaced."""
    values = {name: getattr(record, name) for name in record.__dataclass_fields__} | changed
    return write_bag(Record(**values), path)


@pytest.fixture(scope='module')
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bag in which nothing is wrong."""
    return bag(tmp_path_factory.mktemp('good') / 'flight', flight())


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Run a command; its exit status and its one line on stderr."""

    def command(*arguments: object) -> tuple[int, str]:
        try:
            status = main([str(argument) for argument in arguments])
        except SystemExit as left:
            status = int(left.code or 0)
        error = capsys.readouterr().err
        assert error.count('\n') == 1, error
        assert 'Traceback' not in error
        return status, error

    return command


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (['--axis', 'sideways'], "--axis: invalid choice: 'sideways'"),
        (['--train', '0:20', '--validate', '10:30'], 'training and validation overlap'),
        (['--train', '100:130'], '--train starts after the end'),
        (['--train', 'all'], '--train: needs two times'),
        (['--validate', '9:3'], '--validate: needs two times'),
        (['--inertia', 'abc'], '--inertia: needs three positive numbers'),
        (['--inertia', '0.01,0.02'], '--inertia: needs three positive numbers'),
        (['--inertia', '0.01,0.02,-1'], '--inertia: needs three positive numbers'),
        (['--colour'], 'unrecognized arguments: --colour'),
    ],
)
def test_wrong_options_of_identify(good, run, tmp_path, arguments, words):
    status, error = run('identify', good, '--out', tmp_path / 'out', *arguments)
    assert (status, words in error) == (2, True), error
    assert not (tmp_path / 'out').exists()


def test_a_place_that_cannot_be_written_is_said_before_the_work(good, run, tmp_path, monkeypatch):
    monkeypatch.setattr('quad_sysid.session.read_bag', lambda _: pytest.fail('bag was read'))
    (tmp_path / 'file').write_text('')
    for place in ('file', 'file/report'):
        status, error = run('identify', good, '--out', tmp_path / place)
        assert (status, '--out' in error, 'is no folder' in error) == (2, True, True), error


def spoil(kind: str, path: Path) -> None:
    """Damage the bag at `path`."""
    storage = next(path.glob('*.mcap'))
    if kind == 'gone':
        shutil.rmtree(path)
    elif kind == 'no storage':
        storage.unlink()
    elif kind == 'empty folder':
        shutil.rmtree(path)
        path.mkdir()
    elif kind == 'empty file':
        storage.write_bytes(b'')
    elif kind == 'cut to the header':
        storage.write_bytes(storage.read_bytes()[:60])
    elif kind == 'noise':
        storage.write_bytes(np.random.default_rng(1).bytes(5000))
    elif kind == 'text':
        storage.write_text('t,u,r\n0,1,2\n')


@pytest.mark.parametrize(
    'kind',
    ['gone', 'no storage', 'empty folder', 'empty file', 'cut to the header', 'noise', 'text'],
)
def test_bags_that_are_none(good, run, tmp_path, kind):
    spoilt = tmp_path / 'spoilt'
    shutil.copytree(good, spoilt)
    spoil(kind, spoilt)
    status, error = run('identify', spoilt, '--out', tmp_path / 'out')
    assert (status, str(spoilt) in error) == (2, True), error
    assert not (tmp_path / 'out').exists()


def still(record: Record) -> dict[str, object]:
    return {'control': np.tile(record.control.mean(axis=0), (record.n, 1))}


def first(record: Record, n: int) -> dict[str, object]:
    return {'control': record.control[:n], 'rates': record.rates[:n]}


@pytest.mark.parametrize(
    ('change', 'words'),
    [
        (still, 'the command never moves during training; excite this axis'),
        (lambda r: {'rates': np.zeros_like(r.rates)}, 'the measured rate is constant'),
        (lambda r: first(r, 3), 'is long enough'),
        (lambda r: first(r, 250), 'is long enough'),
        (lambda r: first(r, 1250), 'windows of 0.5 s'),
        (lambda _: {'segments': (Segment('train', 'prbs', 'roll', 'attitude', 0.0, 20.0),)},
         'no validation segment'),
        (lambda _: {'segments': (Segment('validation', 'prbs', 'roll', 'attitude', 0.0, 20.0),)},
         'no training segment'),
    ],
)  # fmt: skip
def test_what_cannot_be_answered_is_status_3_with_a_report(run, tmp_path, change, words):
    record = flight()
    path = bag(tmp_path / 'flight', record, **change(record))
    status, error = run('identify', path, '--axis', 'roll', '--out', tmp_path / 'out', '--quiet')
    assert (status, words in error, str(path) in error) == (3, True, True), error
    report = json.loads((tmp_path / 'out' / 'report.json').read_text())
    jsonschema.validate(report, json.loads(SCHEMA.read_text()))
    axis = report['axes']['roll']
    assert axis['verdict'] == 'cannot_tell'
    assert axis['gains'] is None
    assert (tmp_path / 'out' / 'report.html').exists()


def test_bags_of_different_rates_do_not_go_together(good, run, tmp_path):
    record = flight()
    every = {'control': record.control[::2], 'rates': record.rates[::2], 'dt': 2 * DT}
    other = bag(tmp_path / 'other', record, **every)
    status, error = run('identify', good, other, '--out', tmp_path / 'out')
    assert (status, 'must have one sample rate' in error) == (2, True), error


@pytest.mark.parametrize(
    ('content', 'words'),
    [
        (None, 'cannot be read'),
        ('{"a": 1}', 'lacks axes, schema'),
        ('[1, 2]', 'must be an object'),
        ('{"schema": "quad_sysid/report/1", "axes": {}}', 'schema: must be quad_sysid/model/1'),
        ('{"schema": "quad_sysid/model/1", "axes": {"roll": {', 'is not JSON'),
        ('schema: quad_sysid/model/1', 'is not JSON'),
        ('[' * 100_000, 'is not JSON'),
        ('{"schema": ' + '9' * 5000 + '}', 'is not JSON'),
    ],
)
def test_a_foreign_file_is_no_model(good, run, tmp_path, content, words):
    file = tmp_path / 'some.json'
    if content is not None:
        file.write_text(content)
    status, error = run('evaluate', file, good)
    assert (status, words in error, str(file) in error) == (2, True, True), error


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (['--band', '20:0.1'], '--band: needs 0 < LOW < HIGH in rad/s'),
        (['--band', 'a:b'], '--band: needs 0 < LOW < HIGH in rad/s'),
        (['--band', '1'], "in rad/s: found '1'; for example --band 0.1:20"),
        (['--band', ':20'], '--band: needs 0 < LOW < HIGH'),
        (['--band', '0.1:2000'], 'HIGH is too fast for 250 Hz'),
        (['--band', '0.1:20', '--rate', '-5'], '--rate: must be a positive number'),
        (['--band', '0.1:20', '--amplitude-deg', 'nan'], '--amplitude-deg: must be above 0'),
        (['--band', '0.1:20', '--amplitude-deg', '90'], 'at most 20°'),
        (['--band', '0.1:20', '--out', 'no/such/folder/s.yaml'], 'cannot be written'),
    ],
)
def test_wrong_options_of_design_excitation(run, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    if '--out' not in arguments:
        arguments = [*arguments, '--out', 'schedule.yaml']
    status, error = run('design-excitation', *arguments)
    assert (status, words in error) == (2, True), error
    assert list(tmp_path.iterdir()) == []


def test_a_validation_beyond_the_end_is_bad_input_to_evaluate_too(good, run, monkeypatch):
    monkeypatch.setattr('quad_sysid.report.model_file.load_models', lambda _: {'roll': None})
    monkeypatch.setattr('quad_sysid.report.blackbox_file.load_blackbox', lambda _: {})
    status, error = run('evaluate', 'model.json', good, '--validate', '1e5:2e5')
    assert (status, '--validate starts after the end' in error) == (2, True), error


@pytest.mark.parametrize('content', ['[' * 5000, 'columns: ' + '9' * 5000, 'columns: ['])
def test_a_mixer_that_is_no_yaml_is_refused(run, tmp_path, content):
    rows = [','.join([row, *3 * [row.split(',')[1]]]) for row in ROWS]
    (tmp_path / 'some.csv').write_text('\n'.join(['t,a,r,b,c,d', *rows, '']))
    (tmp_path / 'mixer.yaml').write_text(content)
    status, error = run('import', tmp_path / 'some.csv', '--axis', 'roll', '--time', 't',
                        '--motors', 'a,b,c,d', '--rate', 'r', '--mixer', tmp_path / 'mixer.yaml',
                        '--out', tmp_path / 'out')
    assert (status, 'is not YAML' in error) == (2, True), error


def test_a_mixer_without_motors_is_refused(run, tmp_path):
    (tmp_path / 'some.csv').write_text(TABLE)
    status, error = run('import', tmp_path / 'some.csv', '--axis', 'roll', '--time', 't',
                        '--control', 'u', '--rate', 'r', '--mixer', 'plus',
                        '--out', tmp_path / 'out')
    assert (status, '--mixer: belongs to --motors' in error) == (2, True), error


ROWS = [f'{DT * k:.3f},{0.1 * (k // 50 % 2)},{0.1 * k:.1f}' for k in range(600)]
TABLE = '\n'.join(['t,u,r', *ROWS, ''])


@pytest.mark.parametrize(
    ('content', 'arguments', 'words'),
    [
        (TABLE.replace('0.400,', 'soon,'), [], "line 102, column t: needs a finite number"),
        (TABLE.replace('t,u,r', 't,v,r'), [], 'no column u'),
        ('', [], 'is empty'),
        ('t,u,r\n', [], 'has a header but no rows'),
        (TABLE, ['--unit', 'r=parsec'], '--unit r: is no unit of a rate'),
        (TABLE, ['--unit', 'r'], '--unit'),
        (TABLE, ['--battery', 'volts'], 'no column volts'),
        (None, [], 'cannot be read'),
    ],
)
def test_tables_that_cannot_be_imported(run, tmp_path, content, arguments, words):
    file = tmp_path / 'log.csv'
    if content is not None:
        file.write_text(content)
    status, error = run(
        'import', file, '--axis', 'roll', '--time', 't', '--control', 'u', '--rate', 'r',
        *arguments, '--out', tmp_path / 'bag',
    )  # fmt: skip
    assert (status, words in error) == (2, True), error
    assert not (tmp_path / 'bag').exists()


@pytest.mark.parametrize('place', ['file', 'file/bag'])
def test_an_import_needs_a_free_place(run, tmp_path, place):
    (tmp_path / 'log.csv').write_text(TABLE)
    (tmp_path / 'file').write_text('')
    status, error = run(
        'import', tmp_path / 'log.csv', '--axis', 'roll', '--time', 't', '--control', 'u',
        '--rate', 'r', '--out', tmp_path / place,
    )  # fmt: skip
    assert (status, str(tmp_path / place) in error) == (2, True), error
