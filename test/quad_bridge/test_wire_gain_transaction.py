"""A set of parameters is written whole or not at all, whatever the line does."""

import math

import pytest

from quad_bridge.errors import RefusedError
from quad_bridge.virtual.gain_store import GainStore
from quad_bridge.wire.frames import (
    GainsAction,
    GainsCommand,
    GainsPhase,
    ParamRequestRead,
    ParamSet,
    ParamValue,
)
from quad_bridge.wire.gain_transaction import GainTransaction, Phase
from quad_bridge.wire.params import float32

OLD = {'A': 1.0, 'B': 2.0, 'C': 3.0}
NEW = {'A': 1.5, 'B': 0.1, 'C': 3.5}
WRITTEN = {name: float32(value) for name, value in NEW.items()}


class Far:
    """An STM32's sets; `lost` counts down the requests of a kind that never arrive."""

    def __init__(self, refuses=(), lost=None, unheard=None):
        self.store = GainStore(OLD, lambda name, _: name not in refuses, 7)
        self.lost, self.unheard = dict(lost or {}), dict(unheard or {})
        self.asked = []

    def answer(self, frame):
        action = getattr(frame, 'action', None)
        kind = frame.name if action is None else GainsAction(action).name
        self.asked.append(kind)
        if self.lost.get(kind, 0) > 0:
            self.lost[kind] -= 1
            return None
        reply = self.act(frame)
        if self.unheard.get(kind, 0) > 0:
            self.unheard[kind] -= 1
            return None
        return reply

    def act(self, frame):
        if isinstance(frame, GainsCommand):
            return self.store.take(frame, 0.0)
        if isinstance(frame, ParamSet):
            self.store.write(frame.name, float32(frame.value))
        assert isinstance(frame, (ParamSet, ParamRequestRead))
        return ParamValue(frame.name, self.store.shown(frame.name), 3, 0)


def run(far, wanted=None, limit_s=30.0):
    number = far.store.state().transaction + 1
    transaction = GainTransaction(
        wanted or NEW, far.store.active, list(OLD), number=number, watch_ms=9000
    )
    now = 0.0
    while not transaction.finished and now < limit_s:
        frame = transaction.poll(now)
        reply = far.answer(frame) if frame is not None else None
        if reply is not None:
            transaction.take(reply)
        now += 0.01
    return transaction


def test_all_are_written_and_take_effect_together():
    far, versions = Far(), []
    write = far.store.write
    far.store.write = lambda *a: (write(*a), versions.append(dict(far.store.active)))
    assert run(far).phase is Phase.DONE
    assert versions == [OLD, OLD, OLD]  # nothing is in force while it is written
    assert far.store.active == WRITTEN
    assert far.store.phase is GainsPhase.WATCH
    assert far.asked == ['OPEN', 'A', 'B', 'C', 'COMMIT', 'A', 'B', 'C']


@pytest.mark.parametrize('kind', ['OPEN', 'B', 'COMMIT'])
@pytest.mark.parametrize('way', ['lost', 'unheard'])
def test_three_losses_of_any_frame_do_no_harm(kind, way):
    far = Far(**{way: {kind: 3}})
    assert run(far).phase is Phase.DONE
    assert far.store.active == WRITTEN
    assert far.asked.count(kind) >= 4


def test_one_refusal_changes_nothing():
    far = Far(refuses=['B'])
    transaction = run(far)
    assert transaction.phase is Phase.FAILED
    assert transaction.reason == 'B: the STM32 kept 2 not 0.1'
    assert far.store.active == OLD
    assert 'COMMIT' not in far.asked


@pytest.mark.parametrize(
    ('kind', 'reason'),
    [
        ('OPEN', 'no answer to 4 tries while opening'),
        ('C', 'C: no answer to 4 tries while writing'),
        ('COMMIT', 'no answer to 4 tries while committing'),
    ],
)
def test_no_answer_changes_nothing(kind, reason):
    transaction = run(far := Far(lost={kind: 4}))
    assert transaction.phase is Phase.FAILED
    assert far.store.active == OLD
    assert transaction.reason == reason
    assert not transaction.in_doubt


def test_a_commit_whose_answers_are_lost_is_taken_back():
    far = Far(unheard={'COMMIT': 4})
    assert run(far).phase is Phase.FAILED
    assert far.store.active == OLD
    assert far.store.phase is GainsPhase.IDLE


def test_a_set_that_cannot_be_read_back_whole_is_taken_back():
    far = Far(lost={'C': 0})
    answer, far.answer = far.answer, lambda frame: (
        None if isinstance(frame, ParamRequestRead) and frame.name == 'C' else answer(frame)
    )
    transaction = run(far)
    assert transaction.phase is Phase.FAILED
    assert 'while reading back' in transaction.reason
    assert far.store.active == OLD


def test_a_dead_line_is_said():
    far = Far(lost={'B': 99, 'REVERT': 99})
    transaction = run(far)
    assert transaction.phase is Phase.FAILED
    assert transaction.in_doubt
    assert transaction.reason.endswith('the STM32 goes back by itself')
    far.store.tick(3.0)
    assert far.store.active == OLD


def test_a_copy_that_differs_from_what_was_meant_is_not_committed():
    far = Far()
    take = far.store.take

    def spoil(command, now):
        if command.action == GainsAction.COMMIT:
            far.store.write('B', 7.0)  # a stray write that nobody read back
        return take(command, now)

    far.store.take = spoil
    transaction = run(far)
    assert transaction.phase is Phase.FAILED
    assert transaction.reason == 'the STM32 refused the set: checksum'
    assert far.store.active == OLD


@pytest.mark.parametrize('value', [math.nan, math.inf, -math.inf, 1e39])
def test_what_no_float32_can_be_is_refused_before_anything_is_sent(value):
    with pytest.raises(RefusedError, match='A: '):
        GainTransaction({'B': 1.0, 'A': value}, OLD, list(OLD), number=1, watch_ms=1)


def test_a_parameter_without_a_known_value_is_refused():
    with pytest.raises(RefusedError, match='X'):
        GainTransaction({'X': 1.0}, OLD, list(OLD), number=1, watch_ms=1)


def committed():
    far = Far()
    assert run(far).phase is Phase.DONE
    return far.store


def test_the_firmware_reverts_when_the_link_is_dead():
    store = committed()
    store.heard(0.0)
    assert store.tick(1.9) is None
    state = store.tick(2.1)
    assert (state.result, state.phase) == (3, GainsPhase.IDLE)
    assert store.active == OLD
    assert store.tick(9.0) is None


def test_the_firmware_reverts_without_a_confirmation():
    store = committed()
    store.heard(9.5)
    assert store.tick(9.0) is None
    assert store.tick(9.5).result == 4
    assert store.active == OLD


def test_a_confirmed_set_stays():
    store = committed()
    store.take(GainsCommand(int(GainsAction.CONFIRM), 1), 5.0)
    assert store.tick(99.0) is None
    store.take(GainsCommand(int(GainsAction.REVERT), 1), 6.0)
    assert store.active == WRITTEN


def test_a_second_step_reverts_to_before_the_first():
    far = Far()
    run(far)
    run(far, {'A': 2.5})
    assert far.store.active['A'] == 2.5
    far.store.take(GainsCommand(int(GainsAction.REVERT), 2), 5.0)
    assert far.store.active == OLD


def test_an_action_of_another_transaction_does_nothing():
    store = committed()
    assert store.take(GainsCommand(int(GainsAction.REVERT), 9), 1.0).result == 1
    assert store.active == WRITTEN
