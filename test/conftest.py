"""What tests of all packages share: a ROS domain of its own, so that no two runs hear each other;
a probe in it and nodes as processes.

Two checkouts may be tested on one machine at the same time, beside a demo and other nodes.
"""

import gc
import importlib.util
import itertools
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path
from unittest import mock

import pytest

sys.path.insert(0, str(Path(__file__).parent))  # probe, node_process, flown_axis …

from node_process import Started, node_command
from nursery import Nursery
from probe import Probe

from quad_tuning.demo.processes import own_domain

for _number in (signal.SIGINT, signal.SIGHUP):
    if signal.getsignal(_number) is signal.SIG_IGN:
        # as in a script's background or under nohup: here too, but not in what tests start
        signal.signal(_number, lambda *_: None)


@pytest.hookimpl(tryfirst=True)  # before xdist looks at the groups
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest first, so that none begins when the others are done: loops, then searches, and
    between them what waits for processes, which leaves them the CPU.

    What a module's fixture makes is made once: tests that share one stay with one worker.
    """
    kinds: dict[str, list[pytest.Item]] = {'loop': [], 'search': [], 'wait': [], 'quick': []}
    for item in items:
        folder = item.path.parent.name
        kinds['loop' if item.get_closest_marker('timeout') else
              'search' if folder in {'quad_sysid', 'quad_tuning'} else
              'wait' if folder == 'workspace' or 'nursery' in item.fixturenames else
              'quick'].append(item)
    mixed = [(k / len(kinds[kind]), item) for kind in ('search', 'wait')
             for k, item in enumerate(kinds[kind])]
    mixed.sort(key=lambda pair: pair[0])
    items[:] = [*kinds['loop'], *(item for _, item in mixed), *kinds['quick']]
    for item in items:
        definitions = item._fixtureinfo.name2fixturedefs.values()
        if any(made[-1].scope == 'module' for made in definitions):
            item.add_marker(pytest.mark.xdist_group(item.path.name))


def pytest_collection_finish() -> None:
    """What was imported stays: no search for garbage goes through it, of which pytest makes five
    at its end."""
    gc.freeze()


@pytest.fixture(scope='session')
def quickly() -> Callable[[], AbstractContextManager[None]]:
    """A context in which an answer gets no black-box models, and gains from a few points of the
    search and a quarter of the draws: either takes longer than what the answer says."""

    @contextmanager
    def context() -> Iterator[None]:
        from quad_tuning import ensemble

        few = partial(ensemble.build, count=ensemble.DRAWS // 4)
        with (
            mock.patch('quad_sysid.pipeline.identify._black_boxes', return_value='left out'),
            mock.patch.multiple('quad_tuning.pid', STARTS=1, SHORTLIST=20, GRID=(5, 7, 2, 4, 3)),
            mock.patch.object(ensemble, 'build', few),
        ):
            yield

    return context


@pytest.fixture
def quick(quickly: Callable[[], AbstractContextManager[None]]) -> Iterator[None]:
    with quickly():
        yield


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """A function: the one line on stderr with which a command refuses these words."""

    def line_of(main: Callable[[list[str]], object], *words: object, status: int = 2) -> str:
        try:
            given = main([str(word) for word in words])
        except SystemExit as left:
            given = left.code
        error = capsys.readouterr().err
        assert (given, error.count('\n')) == (status, 1), error
        assert 'Traceback' not in error
        return error

    return line_of


@pytest.fixture
def printed(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """A function: what a command prints that succeeds with these words."""

    def told(main: Callable[[list[str]], object], *words: object) -> str:
        status = main([str(word) for word in words])
        said = capsys.readouterr()
        assert not status, said.err
        return said.out

    return told


@pytest.fixture
def ros_domain(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[int]:
    """A domain that nobody uses, set for this process and those that it starts."""
    with own_domain() as domain:
        monkeypatch.setenv('ROS_DOMAIN_ID', str(domain))
        monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
        monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path / 'ros_log'))
        yield domain


@pytest.fixture(scope='session')
def ros() -> None:
    """Skips what needs rclpy where there is none; it is not imported here."""
    if importlib.util.find_spec('rclpy') is None:
        pytest.skip('needs ROS 2 or its wheels')


@pytest.fixture(scope='session')
def workspace(ros: None) -> None:
    """Skips what needs the packages installed as colcon does, where it has not."""
    del ros
    prefixes = os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)
    if not any(Path(prefix, 'share', 'quad_tuning').is_dir() for prefix in prefixes):
        pytest.skip('needs the built workspace (make build)')


@pytest.fixture
def probe(ros: None, ros_domain: int, tmp_path: Path, nursery: Nursery) -> Iterator[Probe]:
    """A participant in the test's ROS domain; see probe.py."""
    del ros, ros_domain
    probe = Probe(tmp_path, nursery)
    yield probe
    assert probe.close() == 0, (tmp_path / 'probe.stderr').read_text()


@pytest.fixture(scope='session')
def nursery() -> Iterator[Nursery]:
    """Forks our programs, which it has imported."""
    nursery = Nursery()
    yield nursery
    nursery.close()


@pytest.fixture
def run(
    ros_domain: int, tmp_path_factory: pytest.TempPathFactory, nursery: Nursery
) -> Iterator[Callable]:
    """A function that starts a command, which is ended where it still runs in the end.

    `fresh`: with a Python of its own, also where it is one of our programs.
    """
    del ros_domain
    started, folder, number = [], tmp_path_factory.mktemp('processes'), itertools.count()

    def begin(*command: object, fresh: bool = False, **options: object) -> Started:
        by = None if fresh else nursery
        started.append(Started(command, folder / f'{next(number)}', by, **options))
        return started[-1]

    yield begin
    for process in started:
        process.send(signal.SIGTERM)
    for process in started:
        process.leave()


@pytest.fixture
def start(ros: None, run: Callable[..., Started]) -> Callable[..., Started]:
    """A function that starts a node: its name, namespace='/left', parameters by name."""
    del ros
    return lambda name, **settings: run(*node_command(name, **settings))
