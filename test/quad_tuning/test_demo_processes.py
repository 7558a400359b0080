"""Processes of a run are watched, measured and all stopped, also the stubborn ones."""

from __future__ import annotations

import os
import socket
import sys
import time
from pathlib import Path

import pytest
from probe import PATIENCE_S

pytest.importorskip('ament_index_python', reason='the demo runs in a ROS 2 workspace')

from quad_tuning.demo import processes
from quad_tuning.demo.domain import PORT_BASE, PORT_GAIN, own_domain
from quad_tuning.demo.errors import StageFailedError
from quad_tuning.demo.processes import Crew, executable

SLEEP = 'import time; time.sleep(600)'


def python(source: str) -> list[str]:
    return [sys.executable, '-c', source]


def wait_for(path: Path) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not path.exists():
        assert time.monotonic() < deadline, path
        time.sleep(0.02)


def gone(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


def test_leaving_stops_all_and_keeps_the_logs(tmp_path: Path) -> None:
    with Crew(tmp_path, 1) as crew:
        crew.start('talker', python(f'print("hello", flush=True); {SLEEP}'))
        pids = [child.process.pid for child in crew.children.values()]
        crew.check('now')
    assert all(gone(pid) for pid in pids)
    assert (tmp_path / 'logs/talker.log').exists()


def test_one_that_ignores_sigint_is_killed_with_its_children(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(processes, 'STOP_PATIENCE_S', 0.3)
    grandchild = tmp_path / 'grandchild'
    source = (
        'import signal, subprocess, sys, pathlib\n'
        'signal.signal(signal.SIGINT, signal.SIG_IGN)\n'
        f'p = subprocess.Popen([sys.executable, "-c", {SLEEP!r}])\n'
        f'pathlib.Path({str(grandchild)!r}).write_text(str(p.pid))\n'
        f'{SLEEP}'
    )
    with Crew(tmp_path, 1) as crew:
        crew.start('stubborn', python(source))
        wait_for(grandchild)
        time.sleep(0.1)
    assert crew.children['stubborn'].process.returncode == -9
    status = Path(f'/proc/{grandchild.read_text()}/stat')
    deadline = time.monotonic() + PATIENCE_S
    while status.exists() and status.read_text().rpartition(')')[2].split()[0] != 'Z':
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_a_death_is_told_with_its_last_words(tmp_path: Path) -> None:
    with Crew(tmp_path, 1) as crew:
        child = crew.start('bridge', python('import sys; sys.exit("no such port: /dev/x")'))
        child.process.wait()
        with pytest.raises(
            StageFailedError, match=r'connect: bridge ended with status 1: no such'
        ):
            crew.check('connect')


def test_one_that_may_end_may_end_but_not_fail(tmp_path: Path) -> None:
    with Crew(tmp_path, 1) as crew:
        crew.start('done', python(''), may_end=True).process.wait()
        crew.check('fly')
        crew.start('failed', python('raise SystemExit(3)'), may_end=True).process.wait()
        with pytest.raises(StageFailedError, match='failed ended with status 3'):
            crew.check('fly')


def test_cpu_time_is_measured(tmp_path: Path) -> None:
    with Crew(tmp_path, 1) as crew:
        source = (
            'import time\nt = time.process_time()\nwhile time.process_time() - t < 0.4: pass\n'
        )
        ready = tmp_path / 'ready'
        crew.start('busy', python(f'{source}open({str(ready)!r}, "w").close()\n{SLEEP}'))
        crew.start('idle', python(SLEEP))
        wait_for(ready)
    cpu = crew.cpu()
    assert 0.3 < cpu['busy']['cpu_s'] < 5.0
    assert cpu['idle']['cpu_s'] < cpu['busy']['cpu_s']


def test_children_get_the_domain_and_the_whole_environment(tmp_path: Path) -> None:
    environment = Crew(tmp_path, 77).environment()
    assert environment['ROS_DOMAIN_ID'] == '77'
    assert environment['PATH'] == os.environ['PATH']


def test_a_missing_executable_is_one_clear_line() -> None:
    with pytest.raises(StageFailedError, match='no_such_package is not in this workspace'):
        executable('no_such_package', 'x')


def test_two_runs_never_share_a_domain() -> None:
    with own_domain() as one, own_domain() as two, own_domain() as three:
        assert len({one, two, three}) == 3


@pytest.mark.parametrize('offset', [0, 10])
def test_a_domain_in_use_is_left_alone(offset: int) -> None:
    with own_domain() as free:
        pass
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as user:
        user.bind(('', PORT_BASE + PORT_GAIN * free + offset))
        with own_domain() as other:
            assert other != free
