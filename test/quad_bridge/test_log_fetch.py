"""An autopilot's log over a line that loses: whole, in order, resumed, and never fetched twice."""

import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest

from quad_bridge.autopilots.flight import FlightState
from quad_bridge.autopilots.kinds import KINDS
from quad_bridge.autopilots.log_fetch import CHUNK, TRIES, LogFetch, Phase
from quad_bridge.autopilots.log_store import LogStore
from quad_bridge.nodes.autopilot_logs import AutopilotLogs
from quad_bridge.wire import frames as f

LOG = np.random.default_rng(3).bytes(150_007)


class Card:
    """An autopilot with one log; `says` is the size that its list gives."""

    def __init__(self, says=None, loses=0.0, fails=None):
        """`fails`: from where on it is not read for once, which ends what is sent."""
        self.says, self.loses, self.fails = says or len(LOG), loses, fails
        self.random, self.sent = np.random.default_rng(1), 0

    def answers(self, asked):
        if isinstance(asked, f.LogRequestList):
            yield f.LogEntry(7, 3, 7, 0, self.says)
        elif isinstance(asked, f.LogRequestData):
            for at in range(asked.offset, min(asked.offset + asked.count, len(LOG) + 1), CHUNK):
                end = min(at + CHUNK, asked.offset + asked.count)
                self.sent += 1
                if self.fails and at >= self.fails:
                    self.fails = None
                    yield f.LogData(7, at, b'')
                    return
                if self.random.random() >= self.loses:
                    yield f.LogData(7, at, LOG[at:end])


def fetched(card, folder, until=None):
    """Fetch until it is done or `until` says so; the file's path, and the fetch."""
    store = LogStore(lambda job: job())
    store.open(folder, '.bin')
    fetch = LogFetch()
    fetch.there = store.there
    fetch.begin(0.0, wait_s=0.0)
    now_s = 0.0
    while fetch.busy and not (until and until(fetch)):
        now_s += 0.02
        for asked in fetch.poll(now_s):
            for answer in card.answers(asked):
                fetch.take(answer, now_s)
        parts, fetch.parts = fetch.parts, []
        store.write(parts)
    if fetch.phase is Phase.DONE:
        store.finish()
    return store, fetch


@pytest.mark.parametrize(('says', 'fails'), [
    (None, None), (len(LOG) + 4000, None), (None, 60_000)])
def test_whole_through_losses_on_the_disk_and_not_fetched_again(
        tmp_path, says, fails, monkeypatch):
    synced = []  # before it has its name: a power cut would leave one that is empty
    monkeypatch.setattr(os, 'fsync', lambda fd: synced.append(os.fstat(fd).st_size))
    store, fetch = fetched(Card(loses=0.2, says=says, fails=fails), tmp_path)
    assert (fetch.phase, synced) == (Phase.DONE, [len(LOG)])
    assert Path(store.whole).read_bytes() == LOG
    card = Card(says=says)
    store, again = fetched(card, tmp_path)
    assert (again.phase, card.sent) == (Phase.DONE, 0)
    assert store.whole.endswith(f'log_7_{card.says}.bin')


def test_resumed_after_a_lost_line(tmp_path):
    _, half = fetched(Card(), tmp_path, until=lambda fetch: fetch.got > 60_000)
    assert half.phase is Phase.FETCHING
    half.stop('the pilot wants to fly')  # ArduPilot arms once it is told, at once
    assert [half.poll(1e3), half.poll(2e3)] == [[f.LogRequestEnd()], []]
    card = Card()
    store, _ = fetched(card, tmp_path)
    assert card.sent < 1 + (len(LOG) - 60_000) / CHUNK
    assert Path(store.whole).read_bytes() == LOG


def test_a_full_disk_leaves_no_log_that_looks_whole(tmp_path, monkeypatch):
    write = Path.open

    def full(path, mode='r', **more):
        if '+' in mode and path.exists() and path.stat().st_size > 50_000:
            raise OSError(28, 'No space left on device')
        return write(path, mode, **more)

    monkeypatch.setattr(Path, 'open', full)
    store, _ = fetched(Card(), tmp_path)
    assert 'No space left on device' in store.fault
    assert (store.whole, [path.suffix for path in tmp_path.iterdir()]) == ('', ['.part'])
    monkeypatch.undo()
    store, _ = fetched(Card(), tmp_path)
    assert Path(store.whole).read_bytes() == LOG


def test_each_flight_announces_its_own_log_and_a_stay_on_the_ground_none(tmp_path):
    flight, node = FlightState(), MagicMock()
    node.get_clock().now().nanoseconds, node.get_fully_qualified_name.return_value = 0, '/bridge'
    craft = SimpleNamespace(flight=flight, kind=replace(KINDS[1], log_closes_s=0.0))
    logs = AutopilotLogs(node, lambda: craft, lambda: tmp_path, lambda: None, lambda job: job(),
                         by_itself=True)
    logs.configure()
    for landed, more in ((2, 1), (2, 2), (1, 0)):
        for flight.armed, flight.landed in ((True, landed), (False, 1)):
            logs.tick()
        while logs._fetch.busy:
            for asked in logs.poll():
                for answer in Card(says=len(LOG) + more).answers(asked):
                    logs.take(answer, 0)
        logs.poll()
        logs.tick()
    said = [[p.value.string_value for p in call.args[0].changed_parameters]
            for call in node.publisher().publish.mock_calls]
    first, second = (str(tmp_path / f'logs/log_7_{len(LOG) + k}.bin') for k in (1, 2))
    begun = ['expected', ''], ['fetching', '']
    assert said == [*begun, ['complete', first], *begun, ['complete', second],
                    begun[0], ['failed', '']]


def test_of_a_list_in_no_order_the_latest_is_fetched_once_all_are_known():
    """PX4 1.16: numbers from 0, `last` is their count, the order is the directory's."""
    fetch = LogFetch()
    fetch.begin(0.0, wait_s=0.0, by_time=True)
    assert fetch.poll(0.1) == [f.LogRequestList()]
    entries = [f.LogEntry(k, 3, 3, 1000 + t, 10 + k) for k, t in enumerate((20, 30, 10))]
    for entry in (entries[0], entries[2]):  # one is lost
        fetch.take(entry, 0.2)
    assert fetch.phase is Phase.LISTING
    assert fetch.poll(2.0) == [f.LogRequestList()]
    fetch.take(entries[1], 2.1)
    assert fetch.entry == entries[1]
    assert fetch.poll(2.2) == [f.LogRequestData(1, 0, 11)]


def test_a_silent_autopilot_and_an_empty_card_are_told():
    fetch = LogFetch()
    fetch.begin(0.0, wait_s=2.0)
    for k in range(2 * TRIES):
        fetch.poll(2.0 * k)
    assert fetch.reason == f'no answer to {TRIES} requests'
    fetch.begin(0.0, wait_s=0.0)
    fetch.poll(0.1)
    fetch.take(f.LogEntry(0, 0, 0, 0, 0), 0.2)
    assert fetch.reason == 'the autopilot has no log'
