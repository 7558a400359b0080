"""The commands as they are met on a terminal: help, completion, 80 columns, plain when piped."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest
from probe import PATIENCE_S

from quad_sysid.cli import main
from quad_sysid.report import text

COMMANDS = ('inspect', 'identify', 'evaluate', 'import', 'design-excitation', 'export', 'fleet',
            'completion')


def shown_by(arguments: list[str], capsys) -> str:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 0
    return capsys.readouterr().out


def test_help_lists_every_command(capsys):
    listed = shown_by(['--help'], capsys)
    assert all(f'\n    {name}' in listed for name in COMMANDS)


@pytest.mark.parametrize('name', COMMANDS)
def test_every_command_has_an_example_in_its_help(name, capsys):
    told = ' '.join(shown_by([name, '--help'], capsys).split())
    assert 'example: ' in told
    assert f'quad-sysid {name}' in told.partition('example: ')[2]


def test_completion_is_printed_and_answers(capsys, tmp_path):
    pytest.importorskip('argcomplete')
    assert main(['completion']) == 0
    assert 'quad-sysid' in capsys.readouterr().out
    answer = tmp_path / 'answer'
    done = subprocess.run(
        [sys.executable, '-c', 'import sys; from quad_sysid.cli import main; main([])'],
        env={**os.environ, '_ARGCOMPLETE': '1', 'COMP_LINE': 'quad-sysid ins', 'COMP_POINT': '14',
             '_ARGCOMPLETE_IFS': '\n', '_ARGCOMPLETE_STDOUT_FILENAME': str(answer)},
        check=False, capture_output=True, timeout=PATIENCE_S,
    )
    assert answer.read_text().strip() == 'inspect', done.stderr


def test_help_loads_no_numerics():
    source = ('import sys, quad_sysid.cli\n'
              'assert not {"numba", "scipy", "matplotlib"} & set(sys.modules)')
    subprocess.run([sys.executable, '-c', source], check=True, timeout=PATIENCE_S)


def test_text_fits_80_columns_and_is_plain(plain_bag, tmp_path, capsys):
    out = tmp_path / 'out'
    assert main(['identify', str(plain_bag), '--no-effects', '--table2', '--out', str(out)]) == 0
    told = capsys.readouterr()
    lines = told.out.splitlines()
    assert max(map(len, lines[:-1])) <= 80
    assert 'verdict' in told.out
    assert '\x1b' not in told.out + told.err
    assert told.err == ''
    report = json.loads((out / 'report.json').read_text())
    tree = report['axes']['roll']
    tree['not_tested'] = [{'name': 'thrust_curve', 'because': 'the throttle stays ' * 6}]
    tree['effects'] = [{
        'name': 'shape:gain:battery', 'variant': 'a rather long name of a variant',
        'p_value': 1.23e-30, 'probability': 0.5, 'error_reduction_pct': 1234.0, 'parameters': [],
        'rivals': [],
    }]
    assert max(map(len, text.lines(report))) <= 80


def test_several_bags_apart_and_one_bad_among_them(plain_bag, tmp_path, capsys):
    arguments = ['identify', str(plain_bag), str(tmp_path / 'none'), '--apart', '--no-effects',
                 '--out', str(tmp_path / 'out')]
    assert main(arguments) == 0
    told = capsys.readouterr()
    assert 'roll: ' in told.out
    assert 'no such bag' in told.err
    assert (tmp_path / 'out' / 'flight' / 'report.json').exists()
    assert max(map(len, text.brief(json.loads(
        (tmp_path / 'out' / 'flight' / 'report.json').read_text())))) <= 80
