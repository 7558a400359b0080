"""What `make shell` offers of `ros2` where ROS 2 is not installed: it starts what was built."""

import os
import pty
import subprocess
from pathlib import Path

import pytest
from node_process import ended
from probe import PATIENCE_S

ROOT = Path(__file__).resolve().parents[2]
PARAMETERS = 'rcl_interfaces/srv/SetParametersAtomically'


@pytest.fixture
def ros2(tmp_path):
    """Run the stand-in with one package whose executable prints its arguments."""
    folder = tmp_path / 'lib/quad_bridge'
    folder.mkdir(parents=True)
    script = folder / 'talk'
    script.write_text('#!/bin/sh\necho "talks: $*"\nexit 7\n')
    script.chmod(0o755)

    def command(*words: str) -> subprocess.CompletedProcess[str]:
        return ended('timeout', PATIENCE_S, 'ros2', *words, env={
            'AMENT_PREFIX_PATH': str(tmp_path),
            'PATH': os.pathsep.join([str(ROOT / 'tools/bin'), os.environ['PATH']])})

    return command


def test_it_becomes_the_executable(ros2):
    done = ros2('run', 'quad_bridge', 'talk', '--ros-args', '-p', 'port:=stm32')
    assert (done.returncode, done.stdout) == (7, 'talks: --ros-args -p port:=stm32\n')


@pytest.mark.parametrize(
    ('words', 'told'),
    [
        (('run', 'quad_bridge', 'tlak'), 'quad_bridge has no tlak; it has talk'),
        (('topic', 'list'), 'without ROS 2 installed there is only'),
        (('service', 'call', '/x', 'std_srvs/srv/SetBool', '{up: true}'), 'no up; it has data'),
        (('service', 'call', '/x', 'std_srvs/srv/SetBool', '{data'), 'service call: {data: '),
        (('service', 'call', '/x', PARAMETERS, '{parameters: [{nome: a}]}'),
         'the Parameter has no nome; it has name, value'),
        (('service', 'call', '/x', PARAMETERS, '{parameters: [a]}'), "not 'a'"),
    ],
)
def test_what_it_cannot_do_is_one_line(ros2, words, told, request):
    if 'service' in words:
        request.getfixturevalue('ros')
    done = ros2(*words)
    assert (done.returncode, done.stdout) == (2, '')
    assert told in done.stderr
    assert done.stderr.count('\n') == 1


def test_leaving_the_shell_is_no_failure_of_make_and_its_script_is_one():
    make = ['make', '--old-file=build', 'shell']
    done = subprocess.run(make, cwd=ROOT, input=b'exit 3\n', capture_output=True, check=False)
    assert done.returncode != 0
    person, terminal = pty.openpty()
    os.write(person, b'exit 3\n')
    done = subprocess.run(make, cwd=ROOT, stdin=terminal, capture_output=True, check=False)
    os.close(terminal)
    os.close(person)
    assert done.returncode == 0


@pytest.mark.usefixtures('ros')
def test_a_request_holds_lists_of_messages(monkeypatch):
    """As the documents call the bridge's gate, a whole number for a float included."""
    monkeypatch.syspath_prepend(ROOT / 'tools')
    from rcl_interfaces.srv import SetParametersAtomically
    from ros2_stand_in import fill

    request = SetParametersAtomically.Request()
    fill(request, {'parameters': [{'name': 'roll.rate.kp',
                                   'value': {'type': 3, 'double_value': 1}}]})
    (gain,) = request.parameters
    assert (gain.name, gain.value.type, gain.value.double_value) == ('roll.rate.kp', 3, 1.0)
