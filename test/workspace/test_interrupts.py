"""Ctrl-C in a command: one line and status 130 wherever it comes, and nothing is left behind."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable

import pytest
from node_process import SIGNAL_AT_IMPORT, ended, until
from probe import PATIENCE_S

COMMANDS = {
    'quad-sysid': ('quad_sysid.start', 'main'), 'demo': ('quad_tuning.start', 'demo'),
    'recover': ('quad_bridge.start', 'recover'),
}
"""Name of a program, the module and the function of its console entry; others begin as these."""
AT_WORK = """
import atexit, os, signal, threading
from pathlib import Path
from quad_sysid import interrupt, session
from quad_sysid.beside import side_by_side
def interrupted():
    os.kill(os.getpid(), 2)
def threads_that_fail():
    thread = threading.Thread(target=lambda: 1 / 0)
    thread.start()
    thread.join()
def run(*given):
    {0}
    print('went on')
    raise SystemExit(0)
session.run = run
"""
START = '\nimport sys; from {0} import {1} as start; sys.exit(start())'
IDENTIFY = ('identify', '.', '--out', 'out')


def command(program: str, before: str, *words: str) -> list[str]:
    return [sys.executable, '-c', before + START.format(*COMMANDS[program]), *words]


@pytest.fixture
def work(tmp_path, nursery) -> Callable[[str], tuple[int, str, str]]:
    """A function that starts `quad-sysid identify` with this at work: its status and words.

    It ends only once no process of its is left that could write there.
    """

    def run(where: str) -> tuple[int, str, str]:
        code = command('quad-sysid', AT_WORK.format(where))[2]
        modules = ['quad_sysid.cli', 'quad_sysid.session', 'quad_sysid.beside']
        (out, told), (err, complained) = os.pipe(), os.pipe()
        streams = os.open(os.devnull, os.O_RDONLY), told, complained
        process = nursery.fork(modules, code, IDENTIFY, streams, tmp_path)
        for stream in streams:
            os.close(stream)
        with os.fdopen(out) as said, os.fdopen(err) as warned:
            words = said.read(), warned.read()
        return process.wait(PATIENCE_S), *words

    return run


@pytest.mark.parametrize(
    ('program', 'module'),
    [('quad-sysid', 'numpy'), ('demo', 'quad_tuning.demo.main'), ('recover', 'yaml')],
)
def test_while_it_imports(tmp_path, program, module):
    done = ended(*command(program, SIGNAL_AT_IMPORT.format(module, 2)), cwd=tmp_path)
    told = done.returncode, done.stdout, done.stderr
    assert told == (130, '', f'{program}: interrupted\n')


BESIDE = """
    from quad_sysid.files import unfinished
    begun, told = os.pipe()
    def beside():
        os.write(told, b'!')
        signal.pause()
    def here():
        os.read(begun, 1)
        with unfinished(Path()) as room:
            (room / 'half').write_text('half')
            interrupted()
    os.sched_getaffinity = lambda _: (0, 1)  # also where there is one core
    side_by_side([here, beside])"""
"""Neither a process, whose output would stay open, nor what is half written is left."""
HELD = """
    with interrupt.uninterrupted():
        interrupted()
        Path('done').touch()"""


@pytest.mark.parametrize(
    ('where', 'left'),
    [
        ('try: interrupted()\n    except BaseException: pass', []),
        ('try: interrupted()\n    except BaseException as e: raise SystemError("of numba") from e',
         []),
        ('type("Lost", (), {"__del__": lambda _: interrupted()})()', []),
        ('atexit.register(threads_that_fail)\n    interrupted()', []), (BESIDE, []),
        (HELD, ['done']),
    ],
    ids=['dropped', 'made another error', 'ignored in a destructor', 'threads lose what they had',
         'half written, with a process beside', 'what must not be half done is done first'],
)
def test_wherever_it_comes_at_work(tmp_path, work, where, left):
    assert work(where) == (130, '', 'quad-sysid: interrupted\n')
    assert [path.name for path in tmp_path.iterdir()] == left


def test_a_second_one_ends_it_at_once(tmp_path):
    """Here while it removes what is left, which takes for ever."""
    where = """
    atexit.register(lambda: (Path('ending').touch(), signal.pause()))
    interrupted()"""
    process = subprocess.Popen(command('quad-sysid', AT_WORK.format(where), *IDENTIFY),
                               cwd=tmp_path)
    until((tmp_path / 'ending').exists)
    process.send_signal(signal.SIGINT)
    assert process.wait(PATIENCE_S) == -signal.SIGINT


def test_one_that_ignores_it_goes_on(tmp_path):
    """As in the background of a script."""
    done = ended('sh', '-c', 'trap "" INT; exec "$@"', 'sh',
                 *command('quad-sysid', AT_WORK.format('interrupted()'), *IDENTIFY), cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, 'went on\n', '')


def test_a_fleet_ends_with_its_processes(tmp_path):
    """A terminal sends the signal to all of them: the first that works interrupts the group."""
    flights = tmp_path / 'flights'
    flights.mkdir()
    for name in 'abc':
        (flights / f'{name}.mcap').touch()
    (tmp_path / 'sitecustomize.py').write_text("""
import os, signal, sys
if any('forkserver' in word for word in sys.orig_argv):
    import importlib.abc
    class At(importlib.abc.MetaPathFinder):
        def find_spec(self, name, path, target=None):
            if name == 'quad_sysid.bags.storage':
                os.killpg(0, signal.SIGINT)
    sys.meta_path.insert(0, At())
""")
    done = ended(*command('quad-sysid', '', 'fleet', 'flights', '--workers', '2'), cwd=tmp_path,
                 start_new_session=True,
                 env={'PYTHONPATH': f'{tmp_path}:{os.environ.get("PYTHONPATH", "")}'})
    assert (done.returncode, done.stdout, done.stderr) == (130, '', 'quad-sysid: interrupted\n')
