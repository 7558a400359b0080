"""A callback that fails: said once, counted each time, and not kept where it fails without end."""

import threading

import pytest

from quad_bridge.nodes import fence as module
from quad_bridge.nodes.fence import Fence, LogLimiter
from quad_bridge.status import OK, WARN


@pytest.fixture(autouse=True)
def _few(monkeypatch):
    monkeypatch.setattr(module, 'MOST_IN_A_ROW', 3)


def failing(_data=None):
    raise OverflowError('int too large\nto convert')


def taken(fence, callback):
    try:
        callback()
    except OverflowError as error:
        fence.take(error)
    else:
        fence.passed()


def test_a_fault_is_one_line_with_its_place_and_every_one_is_counted_and_told_on():
    lines, told = [], []
    fence = Fence(lines.append, lambda fault: (told.append(fault), failing()))  # it fails too
    for _ in range(10):
        taken(fence, failing)
        taken(fence, lambda: None)
    (line,) = lines
    assert 'OverflowError: int too large to convert (test_nodes_fence.py:' in line
    assert told == 10 * ['a callback failed: OverflowError: int too large to convert']
    assert fence.failed == 10


def test_ros_that_fails_without_end_is_not_kept_though_another_thread_goes_on():
    fence = Fence(lambda _line: None)
    for _ in range(3):
        taken(fence, failing)
        port = threading.Thread(target=fence.around(lambda: None))
        port.start()
        port.join()
    with pytest.raises(OverflowError):
        taken(fence, failing)
    assert fence.failed == 4


def test_a_thread_of_its_own_outlives_whatever_its_callback_raises():
    heard = []
    fence = Fence(lambda _line: None)

    def take(data):
        heard.append(data)
        if data == b'bad':
            raise KeyError(data)

    fenced = fence.around(take)
    for data in (b'bad',) * 5 + (b'good', b'bad'):
        fenced(data)
    assert (len(heard), fence.failed) == (7, 6)


def test_callbacks_that_fail_are_a_warning_for_as_long_as_they_come(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(module.time, 'monotonic', lambda: now[0])
    fence = Fence(lambda _line: None)
    assert fence.entries() == []
    for later_s, failing_now, level in ((1.0, 2, WARN), (0.1, 0, WARN), (1.0, 0, OK)):
        now[0] += later_s
        for _ in range(failing_now):
            taken(fence, failing)
        (told,) = fence.entries()
        assert (told.level, told.values) == (level, {'failed callbacks': 2})
        assert told.message.startswith('2 callbacks failed') is (level == WARN)


def test_a_log_says_things_once_and_never_floods():
    log = LogLimiter(repeat_s=30.0, burst=5, per_s=60.0)
    assert [log.allow('hung up', t) for t in (0.0, 1.0, 29.0, 30.0)] == [True, False, False, True]
    assert [log.allow(f'line {k}', 31.0) for k in range(5)] == [True] * 3 + [False] * 2
    assert log.allow('line 9', 70.0)
    assert log.left_out == 4
