"""Calls side by side: same results as one after the other, errors as they are, nothing left."""

import multiprocessing
import os
import subprocess
import sys

import pytest

from quad_sysid import beside

WHERE = """
import os, sys, threading
os.environ['OPENBLAS_NUM_THREADS'] = '1'
from quad_sysid.beside import side_by_side
if 'thread' in sys.argv:
    threading.Thread(target=threading.Event().wait, daemon=True).start()
print(len(set(side_by_side([os.getpid] * 3))))
"""


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


@pytest.mark.usefixtures('two_cores')
def test_a_call_whose_process_was_killed_is_made_here() -> None:
    here = os.getpid()

    def call() -> int:
        if os.getpid() != here:
            os.kill(os.getpid(), 9)
        return 7

    assert beside.side_by_side([call, call, call]) == [7, 7, 7]


@pytest.mark.skipif(sys.platform != 'linux' or len(os.sched_getaffinity(0)) < 2,
                    reason='needs two cores and /proc')
@pytest.mark.parametrize(('argument', 'processes'), [('', '2'), ('thread', '1')])
def test_only_a_process_of_one_thread_forks(argument: str, processes: str) -> None:
    done = subprocess.run([sys.executable, '-c', WHERE, argument], capture_output=True, text=True,
                          check=True)
    assert done.stdout.split() == [processes], done.stderr
