"""A callback that fails: said once, counted each time, and not kept where it fails without end."""

import threading

import pytest

from quad_bridge.nodes import fence as module
from quad_bridge.nodes.fence import Fence


@pytest.fixture(autouse=True)
def _few(monkeypatch):
    monkeypatch.setattr(module, 'MAX_IN_A_ROW', 3)


def failing():
    raise OverflowError('int too large\nto convert')


def taken(fence, callback):
    try:
        callback()
    except OverflowError as error:
        fence.take(error)
    else:
        fence.passed()


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
