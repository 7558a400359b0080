"""The `ros2` command on our nodes and launch files; skips where ROS 2 is not installed.

The wheels of rclpy bring no `ros2`; what `make shell` has in its place is not a command on PATH.
"""

import shutil
import signal
import time
from pathlib import Path

import pytest
from node_process import Started, ended
from probe import EVENT, PATIENCE_S, TRIGGER

INSTALLED = Path(shutil.which('ros2') or 'tools').resolve()
pytestmark = pytest.mark.skipif('tools' in INSTALLED.parts, reason='no ros2 is installed here')
NODES = {'/serial_bridge', '/bag_logger', '/excitation', '/identification'}
PATIENTLY = ('--no-daemon', '--spin-time', '3')
NAN = (
    '{node: test, stamp: now, changed_parameters: '
    '[{name: roll.rate.kp, value: {type: 3, double_value: .nan}}]}'
)


def ros2(*words: str) -> str:
    done = ended('ros2', *words)
    return done.stdout + done.stderr


def seen(wanted: set[str], *words: str) -> None:
    """Ask until all `wanted` lines are printed: discovery takes what it takes."""
    end_s = time.monotonic() + PATIENCE_S
    while missing := wanted - {line.strip() for line in ros2(*words, *PATIENTLY).splitlines()}:
        assert time.monotonic() < end_s, f'never: {missing}'


@pytest.fixture
def demo(ros_domain, tmp_path):
    """`ros2 launch quad_tuning demo.launch.py`, with all that it starts."""
    del ros_domain
    words = ['quad_tuning', 'demo.launch.py', f'link:={tmp_path}/stm32', f'folder:={tmp_path}']
    launch = Started(['ros2', 'launch', *words], tmp_path / 'launch')
    yield launch
    if launch.poll() is None:
        launch.end()  # its processes with it
    ros2('daemon', 'stop')  # some of the commands start one


def test_the_launched_demo_answers_every_command_and_ends_at_once(demo):
    seen(NODES, 'node', 'list')
    seen({'port', 'log'}, 'param', 'list', '/serial_bridge')
    seen({'active [3]'}, 'lifecycle', 'get', '/serial_bridge')
    latched = ('--qos-durability', 'transient_local', '--qos-reliability', 'reliable')
    assert 'roll.rate.kp' in ros2('topic', 'echo', '--once', *latched, '/gains/active')
    assert 'success=True' in ros2('service', 'call', '/bag_logger/start', TRIGGER)
    # the logger may be matched first, so it is said more than once
    ros2('topic', 'pub', '-t', '10', '-w', '1', '/gains/update', EVENT, NAN)
    demo.until(lambda: 'must be finite: found nan' in demo.printed + demo.said, 'refusal of NaN')
    demo.send(signal.SIGINT)
    assert demo.wait() == 0
    assert 'process has died' not in demo.printed + demo.said
