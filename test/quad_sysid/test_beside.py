"""Calls side by side: same results as one after the other, errors as they are, nothing left."""

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable

import pytest
from node_process import python

from quad_sysid import beside

KILLED = """
import os, signal
os.environ['OPENBLAS_NUM_THREADS'] = '1'
from quad_sysid.beside import side_by_side
side_by_side([lambda: os.kill(os.getpid(), signal.SIGTERM), signal.pause])
"""
ON_CORES = pytest.mark.skipif(sys.platform != 'linux' or len(os.sched_getaffinity(0)) < 2,
                              reason='needs two cores and /proc')


@pytest.fixture
def two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in the command's process on a machine with two cores."""
    monkeypatch.setattr(beside, '_single_threaded', lambda: True)
    monkeypatch.setattr(os, 'sched_getaffinity', lambda _: {0, 1})
    monkeypatch.setattr(multiprocessing, 'parent_process', lambda: None)


@pytest.mark.usefixtures('two_cores')
@pytest.mark.parametrize('count', [0, 1, 2, 3, 5])
def test_results_are_in_the_order_of_the_calls(count: int) -> None:
    assert beside.side_by_side([lambda n=n: n * n for n in range(count)]) == [
        n * n for n in range(count)]


@pytest.mark.usefixtures('two_cores')
@pytest.mark.parametrize('failing', [0, 1, 2])
def test_an_error_is_raised_as_it_is(failing: int) -> None:
    def call(n: int) -> int:
        return n if n != failing else {}[n]

    with pytest.raises(KeyError, match=str(failing)):
        beside.side_by_side([lambda n=n: call(n) for n in range(3)])
    assert not multiprocessing.active_children()


def killed() -> None:
    os.kill(os.getpid(), 9)


def killed_as_it_sends() -> bytes:
    threading.Timer(0.1, killed).start()
    return bytes(1 << 20)


def not_packed() -> Callable[[], None]:
    return lambda: None


def not_unpacked() -> UnicodeDecodeError:
    error = UnicodeDecodeError('utf-8', b'', 0, 1, '')
    error.args = ()
    return error


@pytest.mark.usefixtures('two_cores')
@pytest.mark.parametrize('there', [killed, killed_as_it_sends, not_packed, not_unpacked])
def test_a_call_whose_result_did_not_come_is_made_here(there: Callable[[], object]) -> None:
    here = os.getpid()

    def call() -> object:
        if os.getpid() != here:
            return there()
        for process in multiprocessing.active_children():
            process.join()
        return 7

    assert beside.side_by_side([call, call, call]) == [7, 7, 7]


@ON_CORES
def test_nobody_goes_on_where_the_command_was_killed() -> None:
    """The output of a process that still ran would stay open."""
    done = python('-c', KILLED)
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGTERM, '', '')
