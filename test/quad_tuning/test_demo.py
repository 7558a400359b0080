"""The demo's processes are watched and all stopped; test/integration/test_loop.py flies it."""

import os
import socket
import sys
from pathlib import Path

import pytest
from node_process import until

pytest.importorskip('ament_index_python', reason='the demo runs in a ROS 2 workspace')

from quad_tuning.demo import processes

SLEEP = 'import time; time.sleep(600)'


def python(source: str) -> list[str]:
    return [sys.executable, '-c', source]


def test_leaving_stops_all_and_one_that_ignores_sigint_is_killed_with_its_children(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(processes, 'STOP_TIMEOUT_S', 0.3)
    grandchild = tmp_path / 'grandchild'
    source = (
        'import os, signal, subprocess, sys\n'
        'signal.signal(signal.SIGINT, signal.SIG_IGN)\n'
        f'p = subprocess.Popen([sys.executable, "-c", {SLEEP!r}])\n'
        f'open("{grandchild}.new", "w").write(str(p.pid))\n'
        f'os.rename("{grandchild}.new", "{grandchild}")\n{SLEEP}'
    )
    with processes.Crew(tmp_path, 1) as crew:
        crew.start('talker', python(SLEEP))
        crew.start('stubborn', python(source))
        until(grandchild.exists)
        crew.check('now')
    assert crew.children['talker'].process.returncode is not None
    assert (tmp_path / 'logs/talker.log').exists()
    assert crew.children['stubborn'].process.returncode == -9
    status = Path(f'/proc/{grandchild.read_text()}/stat')

    def ended() -> bool:
        try:
            return status.read_text().rpartition(')')[2].split()[0] == 'Z'
        except OSError:  # nobody of that number is left
            return True

    until(ended)


def test_a_death_is_told_with_its_last_words(tmp_path: Path) -> None:
    with processes.Crew(tmp_path, 1) as crew:
        crew.start('done', python(''), may_end=True).process.wait()
        crew.check('fly')
        crew.start('failed', python('raise SystemExit(3)'), may_end=True).process.wait()
        with pytest.raises(processes.StageFailedError, match='failed ended with status 3'):
            crew.check('fly')
    with processes.Crew(tmp_path, 1) as crew:
        crew.start('bridge', python('import sys; sys.exit("no such port")')).process.wait()
        with pytest.raises(processes.StageFailedError, match='bridge ended with status 1: no s'):
            crew.check('connect')
    with pytest.raises(processes.StageFailedError, match='no_such_package is not in this wor'):
        processes.executable('no_such_package', 'x')


def test_two_runs_never_share_a_domain(tmp_path: Path) -> None:
    environment = processes.Crew(tmp_path, 77).environment()
    assert (environment['ROS_DOMAIN_ID'], environment['PATH']) == ('77', os.environ['PATH'])
    with processes.own_domain() as one, processes.own_domain() as two:
        assert one != two
    for offset in (0, 10):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as user:
            with processes.own_domain() as free:  # so that no other test takes it meanwhile
                user.bind(('', processes.PORT_BASE + processes.PORT_GAIN * free + offset))
            with processes.own_domain() as other:
                assert other != free
