"""The commands as they are met on a terminal: help, completion, progress.

That a piped answer is plain and fits 80 columns, test_commands.py shows.
"""

from __future__ import annotations

import os
import subprocess
import sys
from types import SimpleNamespace

import pytest
from probe import PATIENCE_S

from quad_sysid import session
from quad_sysid.arguments import progress
from quad_sysid.cli import main
from quad_sysid.model import recursion

COMMANDS = ('inspect', 'identify', 'evaluate', 'import', 'design-excitation', 'export', 'compare',
            'fleet')


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


def test_a_first_use_says_that_it_compiles(monkeypatch, tmp_path):
    found = SimpleNamespace(save=lambda _: None)
    monkeypatch.setattr(session, 'identify', lambda _, progress: progress('roll: gains') or found)
    for index in ('recursion.motors-1.py311.nbi', 'recursion.predict-1.py311.nbi'):
        (tmp_path / index).touch()
        monkeypatch.setattr(recursion, 'predict', SimpleNamespace(
            stats=SimpleNamespace(cache_path=str(tmp_path))))
        told: list[str] = []
        session.run(['bag'], tmp_path / 'out', {}, told.append)
        assert told[0] == ('roll: gains' + ' (compiling, once)' * ('motors' in index))
        assert told[-1] == ''


def test_completion_answers(tmp_path):
    pytest.importorskip('argcomplete')
    answer = tmp_path / 'answer'
    done = subprocess.run(
        [sys.executable, '-c', 'import sys; from quad_sysid.cli import main; main([])'],
        env={**os.environ, '_ARGCOMPLETE': '1', 'COMP_LINE': 'quad-sysid ins', 'COMP_POINT': '14',
             '_ARGCOMPLETE_IFS': '\n', '_ARGCOMPLETE_STDOUT_FILENAME': str(answer)},
        check=False, capture_output=True, timeout=PATIENCE_S,
    )
    assert answer.read_text().strip() == 'inspect', done.stderr


def test_progress_rewrites_one_line_on_a_terminal_alone(capsys, monkeypatch):
    progress()('roll: what is missing')
    assert capsys.readouterr().err == ''
    monkeypatch.setattr('sys.stderr.isatty', lambda: True, raising=False)
    show = progress()
    for line in ('flight 1 of 5' + 200 * ' and on', ''):
        show(line)
    first, last = capsys.readouterr().err.split('\r\x1b[2K')[1:]
    assert (first[:13], len(first) < 200, last) == ('flight 1 of 5', True, '')
