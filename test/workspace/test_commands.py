"""Every command of README and docs: run for real where that takes moments, else checked.

A command is a line of an indented block that begins with one of our programs. The offline ones run
in-process, in a folder with small bags. Which are only checked stands in ONLY_PARSED and
STARTED_ELSEWHERE, with the reason; a new command that no list knows is run, and so fails where it
does not work.
"""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from flown_axis import Axis, Plan, fly
from node_process import ended

from quad_sysid import cli as sysid
from quad_sysid.bags import write_bag
from quad_tuning import cli as tuning

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / 'README.md', *sorted((ROOT / 'docs').rglob('*.md')), ROOT / 'CONTRIBUTING.md']
PLAN = Plan(15.0, (('train', 'prbs', 1.0, 9.5), ('validation', 'prbs', 10.0, 15.0)))

PROGRAMS = {'quad-sysid': sysid.main, 'quad-tune': tuning.main}
STARTED_ELSEWHERE = {
    'make': 'its targets are in test_documents.py; .ci/run calls build, lint and test',
    'ros2': 'executables, launch files: test_documents.py; nodes have their tests',
    'pip': 'needs a network; the packages named must exist',
    'echo': "a setting of the reader's machine",
}
ONLY_PARSED = {
    'quad-tune rollback': 'needs ROS; test_gain_history.py rolls back',
    'quad-tune send': 'needs a bridge; test_update_node.py and test_gain_updates.py send',
    'quad-tune history': 'needs gains that flew; test_gain_history.py',
    'quad-tune design': 'ten seconds each; the fixture runs one, test_climb.py those of --axis',
    'quad-sysid import': 'its files are not at hand; test_foreign_logs.py, test_import_tables.py',
    'quad-sysid fleet': 'starts processes; test_fleet.py',
    'quad-sysid app': 'serves until it is ended; test_app.py',
    'quad-sysid compare': 'identifies bags; test_comparison.py',
    'quad-sysid identify': 'half a minute each; the fixture runs one as README has it',
    'quad-sysid design-excitation --separate': 'test_separation.py',
}
RUN_ALL_THE_SAME = ('quad-sysid import log.csv', 'quad-tune design result/model.json --flight')


def commands() -> list[tuple[str, str]]:
    """(page, command) of every block, continued lines joined, comments cut, each command once."""
    found: dict[str, str] = {}
    for path in PAGES:
        text = re.sub(r'\\\n\s*', '', path.read_text())
        for line in re.findall(r'^(?: {4,}|\$ )(\S.*)$', text, re.MULTILINE):
            command = re.split(r'\s+#\s', line)[0].strip()
            program = command.split()[0]
            if program in PROGRAMS or program in STARTED_ELSEWHERE:
                found.setdefault(command, str(path.relative_to(ROOT)))
    return [(page, command) for command, page in found.items()]


COMMANDS = commands()
OURS = [(page, line) for page, line in COMMANDS if line.split()[0] in PROGRAMS]


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Bags, table and result by the names that the docs use.

    The result is made as by a new user: nothing is sourced, nothing is left to be compiled, and
    what is said is plain text that fits a terminal.
    """
    here = tmp_path_factory.mktemp('docs')
    for seed, name in enumerate(('my_flight', 'another_flight')):
        write_bag(fly(Axis(), seed, PLAN), here / name)
    (here / 'emps_pulses').symlink_to('another_flight')
    columns = {'t': 1e-3, 'u': 1e-5, 'gx': 0.02, 'Time [ms]': 1.0, 'cmd roll': 0.01,
               'Gyro (deg/s)': 0.02}
    rows = [','.join(f'{scale * 4 * k:.6g}' for scale in columns.values()) for k in range(1000)]
    (here / 'log.csv').write_text('\n'.join([','.join(columns), *rows]) + '\n')
    without = {'NUMBA_DEBUG_CACHE': '1', 'HOME': str(here)}
    for program, *arguments in (
        ('quad-sysid', 'identify', 'my_flight', '--axis', 'roll', '--out', 'result'),
        ('quad-tune', 'design', 'result/model.json', '--out', 'gains.json'),
    ):
        done = subprocess.run(
            [Path(sys.prefix) / 'bin' / program, *arguments], env=without, cwd=here, check=False,
            capture_output=True, text=True,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        assert 'data loaded from' in done.stdout
        assert 'data saved to' not in done.stdout, 'quad-sysid compile misses types of arguments'
        assert ('\x1b' in done.stdout, done.stderr) == (False, '')
        said = [line for line in done.stdout.splitlines() if not line.startswith('[cache]')]
        assert program == 'quad-tune' or max(map(len, said)) <= 80, said
    return here


def test_the_docs_have_commands_and_the_lists_no_others() -> None:
    lines = [line for _, line in COMMANDS]
    assert len(OURS) > 25
    for known in (*ONLY_PARSED, *STARTED_ELSEWHERE):
        assert any(line.startswith(known) for line in lines), known


@pytest.mark.parametrize(('page', 'line'), OURS, ids=[line for _, line in OURS])
def test_a_command_works(
    page: str, line: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys, tmp_path: Path
) -> None:
    """Run in a folder where its files are (an `import` elsewhere: its bag must be new)."""
    program, *arguments = shlex.split(line)
    monkeypatch.chdir(folder)
    monkeypatch.setenv('HOME', str(tmp_path))
    if line.startswith(tuple(ONLY_PARSED)) and not line.startswith(RUN_ALL_THE_SAME):
        with pytest.raises(SystemExit) as left:  # an option that is unknown ends with 2
            PROGRAMS[program]([*arguments, '--help'])
        assert left.value.code == 0
        known = capsys.readouterr().out
        for option in (word for word in arguments if word.startswith('--')):
            assert option in known, f'{page}: {line}: {option}'
        return
    if line.startswith('quad-sysid import'):
        arguments[arguments.index('--out') + 1] = str(tmp_path / 'imported')
    assert PROGRAMS[program](arguments) == 0, f'{page}: {line}\n{capsys.readouterr().err}'


def test_the_installed_fleet_starts_its_processes(tmp_path: Path) -> None:
    """Each imports the program that started it, which must not begin a fleet of its own then."""
    (tmp_path / 'flights').mkdir()
    (tmp_path / 'flights/no_bag.mcap').write_text('no bag')
    done = ended(Path(sys.prefix) / 'bin/quad-sysid', 'fleet', 'flights', '--out', 'fleet',
                 cwd=tmp_path)
    row = (tmp_path / 'fleet/fleet.csv').read_text()
    assert ('Traceback' in done.stderr, 'process died' in row) == (False, False), done.stderr


def test_pip_installs_our_folders_or_what_they_need() -> None:
    needed = ''.join(one.read_text() for one in ROOT.glob('src/*/setup.py'))
    for page, line in COMMANDS:
        if line.startswith('pip install'):
            for word in shlex.split(line)[2:]:
                ours = (ROOT / word.split('[')[0] / 'setup.py').exists()
                assert ours or re.search(rf'[\'"]{re.escape(word)}\b', needed), f'{page}: {line}'
