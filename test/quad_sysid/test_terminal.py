"""The commands as they are met on a terminal: help, completion, 80 columns, plain when piped."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys

import pytest
from probe import PATIENCE_S

from quad_sysid.cli import main
from quad_sysid.progress import Progress, duration, progress
from quad_sysid.report import text

COMMANDS = ('inspect', 'identify', 'evaluate', 'import', 'design-excitation', 'export', 'fleet',
            'completion')


def shown_by(arguments: list[str], capsys) -> str:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 0
    return capsys.readouterr().out


def test_every_command_is_listed_and_has_an_example_in_its_help(capsys):
    listed = shown_by(['--help'], capsys)
    for name in COMMANDS:
        assert f'\n    {name}' in listed
        told = ' '.join(shown_by([name, '--help'], capsys).split())
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


def test_text_fits_80_columns_and_is_plain(plain_bag, tmp_path, capsys):
    """Several bags apart, one bad among them, which is a line on stderr."""
    words = ['identify', str(plain_bag), '--no-effects', '--out', str(tmp_path / 'a')]
    assert main(words) == 0
    told = capsys.readouterr()
    assert max(map(len, told.out.splitlines()[:-1])) <= 80
    assert 'verdict' in told.out
    assert '\x1b' not in told.out
    assert told.err == ''
    words = ['identify', str(plain_bag), str(tmp_path / 'none'), '--apart', '--no-effects',
             '--out', str(tmp_path / 'b')]
    assert main(words) == 0
    told = capsys.readouterr()
    assert 'roll: ' in told.out
    assert 'no such bag' in told.err
    report = json.loads((tmp_path / 'b' / 'flight' / 'report.json').read_text())
    assert max(map(len, text.brief(report))) <= 80


def shown(lines: list[tuple[float, str]]) -> list[str]:
    stream, times = io.StringIO(), iter([time for time, _ in lines])
    report = Progress(stream, (), lambda: next(times))
    for _, line in lines:
        report(line)
    return [text.removeprefix('\x1b[2K') for text in stream.getvalue().split('\r')[1:]]


def test_counted_work_tells_what_is_left_but_for_short_work(capsys):
    """And only on a terminal."""
    out = shown([(0.0, 'flight 1 of 5'), (10.0, 'flight 2 of 5'), (20.0, '')])
    assert out == ['flight 1 of 5', 'flight 2 of 5  (10 s so far, about 40 s left)', '']
    assert shown([(0.0, 'a 1 of 2'), (0.9, 'a 2 of 2')])[-1] == 'a 2 of 2'
    progress()('reading')
    assert capsys.readouterr().err == ''
    assert list(map(duration, (0.2, 59.4, 200.0, 7500.0))) == [
        '1 s', '59 s', '3 min 20 s', '2 h 5 min'
    ]
