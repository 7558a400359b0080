"""A set of parameters is written whole or not at all, whatever the line does."""

import math

import pytest
from flight_controller import DROPPED, Fault, FlightController

from quad_bridge.errors import RefusedError
from quad_bridge.wire.frames import (
    GainsAction,
    GainsCommand,
    GainsPhase,
    ParamRequestRead,
)
from quad_bridge.wire.gain_transaction import GainTransaction, Phase
from quad_bridge.wire.params import float32

OLD = {'A': 1.0, 'B': 2.0, 'C': 3.0}
NEW = {'A': 1.5, 'B': 0.1, 'C': 3.5}
WRITTEN = {name: float32(value) for name, value in NEW.items()}


def controller(**options):
    return FlightController(parameters=OLD, **options)


def label(frame):
    """`OPEN`, `COMMIT`, or the name of a parameter."""
    return GainsAction(frame.action).name if isinstance(frame, GainsCommand) else frame.name


def lost(what, times=99):
    return Fault(lambda frame: label(frame) == what, DROPPED, times=times)


def same(frame):
    return [frame]


def run(far, wanted=None, *, up=same, deaf=same):
    """A transaction to its end; `up` loses requests, `deaf` their answers."""
    wanted = NEW if wanted is None else wanted
    number = far.store.state().transaction + 1
    transaction = GainTransaction(
        wanted, far.store.active, list(OLD), number=number, watch_ms=9000
    )
    for k in range(3000):
        if transaction.finished:
            break
        frame = transaction.poll(0.01 * k)
        for arrived in up(frame) if frame is not None else []:
            replies = far.answer(arrived)
            for reply in replies if deaf(arrived) else []:
                transaction.take(reply)
    return transaction


def test_all_are_written_and_take_effect_together():
    far, versions = controller(), []
    write = far.store.write
    far.store.write = lambda *a: (write(*a), versions.append(dict(far.store.active)))
    assert run(far).phase is Phase.DONE
    assert versions == [OLD, OLD, OLD]  # nothing is in force while it is written
    assert far.store.active == WRITTEN
    assert far.store.phase is GainsPhase.WATCH
    assert [label(x) for x in far.heard] == ['OPEN', *'ABC', 'COMMIT', *'ABC']


@pytest.mark.parametrize('what', ['OPEN', 'B', 'COMMIT'])
@pytest.mark.parametrize('way', ['up', 'deaf'])
def test_three_losses_of_any_frame_do_no_harm(what, way):
    far, fault = controller(), lost(what, times=3)
    assert run(far, **{way: fault}).phase is Phase.DONE
    assert far.store.active == WRITTEN
    assert fault.times == 0


def loses_reading_back():
    return {'up': Fault(lambda x: isinstance(x, ParamRequestRead) and x.name == 'C', DROPPED)}


@pytest.mark.parametrize(
    ('faults', 'reason'),
    [
        ({'up': lost('OPEN', 4)}, 'no answer to 4 tries while opening'),
        ({'up': lost('C', 4)}, 'C: no answer to 4 tries while writing'),
        ({'up': lost('COMMIT', 4)}, 'no answer to 4 tries while committing'),
        ({'deaf': lost('COMMIT', 4)}, 'no answer to 4 tries while committing'),
        (loses_reading_back(), 'C: no answer to 4 tries while reading back'),
    ],
)
def test_what_stays_unanswered_changes_nothing(faults, reason):
    transaction = run(far := controller(), **faults)
    assert transaction.phase is Phase.FAILED
    assert (far.store.active, far.store.phase) == (OLD, GainsPhase.IDLE)
    assert transaction.reason == reason
    assert not transaction.in_doubt


def test_one_refusal_changes_nothing():
    transaction = run(far := controller(refuses=['B']))
    assert transaction.phase is Phase.FAILED
    assert transaction.reason == 'B: the STM32 kept 2 not 0.1'
    assert far.store.active == OLD
    assert 'COMMIT' not in [label(x) for x in far.heard]


def test_a_false_report_after_the_commit_takes_the_set_back():
    far = controller()

    def lie(frame):
        if label(frame) == 'COMMIT':
            far.reports['B'] = 7.0
        return [frame]

    transaction = run(far, up=lie)
    assert transaction.phase is Phase.FAILED
    assert far.store.active == OLD


def test_a_dead_line_is_reported():
    far = controller()
    dead = Fault(lambda x: label(x) in {'B', 'REVERT'}, DROPPED)
    transaction = run(far, up=dead)
    assert transaction.phase is Phase.FAILED
    assert transaction.in_doubt
    assert transaction.reason.endswith('the STM32 goes back by itself')
    far.store.tick(3.0)
    assert far.store.active == OLD


def test_a_copy_that_differs_from_what_was_meant_is_not_committed():
    far = controller()

    def spoil(frame):
        if label(frame) == 'COMMIT':
            far.store.write('B', 7.0)  # a stray write that nobody read back
        return [frame]

    transaction = run(far, up=spoil)
    assert transaction.phase is Phase.FAILED
    assert transaction.reason == 'the STM32 refused the set: checksum'
    assert far.store.active == OLD


@pytest.mark.parametrize(
    ('wanted', 'name'),
    [({'B': 1.0, 'A': value}, 'A') for value in (math.nan, math.inf, -math.inf, 1e39)]
    + [({'X': 1.0}, 'X')],
)
def test_what_no_float32_can_be_and_unknown_names_are_refused_before_anything_is_sent(
    wanted, name
):
    with pytest.raises(RefusedError, match=name):
        GainTransaction(wanted, OLD, list(OLD), number=1, watch_ms=1)


# The firmware's side.


@pytest.fixture
def store():
    """With a set that is watched, transaction 1."""
    far = controller()
    assert run(far).phase is Phase.DONE
    return far.store


@pytest.mark.parametrize(
    ('heard_s', 'alive_s', 'late_s', 'result'), [(0.0, 1.9, 2.1, 3), (9.5, 9.0, 9.5, 4)]
)
def test_the_firmware_reverts_without_a_link_or_a_confirmation(
    store, heard_s, alive_s, late_s, result
):
    store.heard(heard_s)
    assert store.tick(alive_s) is None
    state = store.tick(late_s)
    assert (state.result, state.phase) == (result, GainsPhase.IDLE)
    assert store.active == OLD
    assert store.tick(99.0) is None


def test_a_confirmed_set_stays_and_another_transaction_changes_nothing(store):
    assert store.take(GainsCommand(int(GainsAction.REVERT), 9), 1.0).result == 1
    assert store.active == WRITTEN
    store.take(GainsCommand(int(GainsAction.CONFIRM), 1), 5.0)
    assert store.tick(99.0) is None
    store.take(GainsCommand(int(GainsAction.REVERT), 1), 6.0)
    assert store.active == WRITTEN


def test_a_second_step_reverts_to_before_the_first():
    far = controller()
    run(far)
    run(far, {'A': 2.5})
    assert far.store.active['A'] == 2.5
    far.store.take(GainsCommand(int(GainsAction.REVERT), 2), 5.0)
    assert far.store.active == OLD
