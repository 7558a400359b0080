"""The commands as they are met on a terminal: help, completion, progress.

That a piped answer is plain and fits 80 columns, test_commands.py shows.
"""

import re
from pathlib import Path

import numba
import pytest
from node_process import python

from quad_sysid import compiled
from quad_sysid.arguments import progress
from quad_sysid.cli import main
from quad_sysid.model.laws import hats


def shown_by(arguments: list[str], capsys) -> str:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 0
    return capsys.readouterr().out


def test_every_command_has_an_example_in_its_help(capsys):
    names = re.findall(r'^    ([a-z-]+)', shown_by(['--help'], capsys), re.MULTILINE)
    assert len(names) >= 11
    for name in names:
        told = ' '.join(shown_by([name, '--help'], capsys).split())
        assert f'quad-sysid {name}' in told.partition('example: ')[2]


def test_a_first_use_says_once_that_it_compiles_and_a_second_does_not_compile(tmp_path):
    use = ('import numpy as np; from quad_sysid.model.laws import all_yielded, hats\n'
           'one = np.arange(2.0); hats(one, one, one, one, np.eye(2))\n'
           'all_yielded(one, one, 1.0, 1.0, 1.0, 0.1, np.eye(2))')
    said = [python('-c', use, env={'NUMBA_CACHE_DIR': str(tmp_path)}).stderr for _ in range(2)]
    assert said == ['compiling for this machine, once, half a minute\n', '']


def test_what_is_compiled_of_an_installed_package_outlives_its_folder(monkeypatch, tmp_path):
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path))
    monkeypatch.setattr(numba.config, 'CACHE_DIR', '')
    beside = compiled.kernel()(hats.py_func).stats.cache_path
    monkeypatch.setattr(compiled, '__file__', '/venv/site-packages/quad_sysid/compiled.py')
    kept = compiled.kernel()(hats.py_func).stats.cache_path
    monkeypatch.setattr(numba.config, 'CACHE_DIR', str(tmp_path / 'wished'))
    wished = compiled.kernel()(hats.py_func).stats.cache_path
    assert Path(beside) == Path(hats.py_func.__code__.co_filename).parent / '__pycache__'
    assert Path(kept).parent == tmp_path / 'quad_suite'
    assert Path(wished).parent == tmp_path / 'wished'
    assert str(tmp_path / 'wished') == numba.config.CACHE_DIR


def test_completion_answers(tmp_path):
    pytest.importorskip('argcomplete')
    answer = tmp_path / 'answer'
    done = python('-c', 'from quad_sysid.cli import main; main([])', env={
        '_ARGCOMPLETE': '1', 'COMP_LINE': 'quad-sysid ins', 'COMP_POINT': '14',
        '_ARGCOMPLETE_IFS': '\n', '_ARGCOMPLETE_STDOUT_FILENAME': str(answer)})
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
