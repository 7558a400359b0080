"""A set of parameters is written whole or not at all, whatever the line does."""

import math

import pytest

from quad_bridge.errors import RefusedError
from quad_bridge.wire.frames import ParamRequestList, ParamRequestRead, ParamSet, ParamValue
from quad_bridge.wire.gain_names import CONTRACT_NAMES, WIRE_NAMES
from quad_bridge.wire.params import ParamReader, ParamTransaction, Phase, float32

OLD = {'A': 1.0, 'B': 2.0, 'C': 3.0}
NEW = {'A': 1.5, 'B': 0.1, 'C': 3.5}


class Far:
    """An STM32's parameters; `refuses` keep their value, `deaf` maps a name to lost writes."""

    def __init__(self, refuses=(), deaf=None):
        self.values, self.refuses, self.deaf = dict(OLD), set(refuses), dict(deaf or {})
        self.writes = []

    def answer(self, frame):
        assert isinstance(frame, ParamSet)
        self.writes.append((frame.name, frame.value))
        if self.deaf.get(frame.name, 0) > 0:
            self.deaf[frame.name] -= 1
            return None
        if frame.name not in self.refuses:
            self.values[frame.name] = float32(frame.value)
        return ParamValue(frame.name, self.values[frame.name], 3, 0)


def run(far, wanted=None, limit_s=30.0):
    transaction = ParamTransaction(NEW if wanted is None else wanted, OLD)
    now = 0.0
    while not transaction.finished and now < limit_s:
        frame = transaction.poll(now)
        reply = far.answer(frame) if frame is not None else None
        if reply is not None:
            transaction.take(reply)
        now += 0.01
    return transaction


def test_all_are_written_and_read_back():
    far = Far()
    transaction = run(far)
    assert transaction.phase is Phase.DONE
    assert far.values == {name: float32(value) for name, value in NEW.items()}
    assert transaction.read_back == far.values


def test_lost_writes_are_repeated_three_times():
    far = Far(deaf={'B': 3})
    assert run(far).phase is Phase.DONE
    assert [name for name, _ in far.writes].count('B') == 4


def test_one_refusal_puts_everything_back():
    far = Far(refuses=['B'])
    transaction = run(far)
    assert transaction.phase is Phase.FAILED
    assert far.values == OLD
    assert transaction.reason == 'B: the STM32 kept 2 instead of 0.1'
    assert 'C' not in [name for name, _ in far.writes]


def test_no_answer_puts_everything_back():
    far = Far(deaf={'C': 4})
    transaction = run(far)
    assert transaction.phase is Phase.FAILED
    assert far.values == OLD
    assert transaction.reason == 'C: no answer to 4 writes'


def test_a_dead_line_names_what_is_in_doubt():
    far = Far(deaf={'B': 99})
    transaction = run(far)
    assert transaction.phase is Phase.FAILED
    assert transaction.reason.endswith('in doubt: B, A')


@pytest.mark.parametrize('value', [math.nan, math.inf, -math.inf, 1e39])
def test_what_no_float32_can_be_is_refused_before_anything_is_sent(value):
    with pytest.raises(RefusedError, match='A: '):
        ParamTransaction({'B': 1.0, 'A': value}, OLD)


def test_a_parameter_without_a_known_value_is_refused():
    with pytest.raises(RefusedError, match='X'):
        ParamTransaction({'X': 1.0}, OLD)


def test_values_of_other_parameters_are_ignored():
    transaction = ParamTransaction({'A': 1.5}, OLD)
    transaction.poll(0.0)
    transaction.take(ParamValue('B', 1.5, 3, 1))
    assert not transaction.finished
    transaction.take(ParamValue('A', 1.5, 3, 0))
    assert transaction.phase is Phase.DONE


def test_the_reader_asks_again_for_what_did_not_come():
    reader = ParamReader()
    assert reader.poll(0.0) == ParamRequestList()
    assert reader.poll(0.01) is None
    reader.take(ParamValue('A', 1.0, 3, 0), 0.02)
    reader.take(ParamValue('C', 3.0, 3, 2), 0.03)
    assert not reader.complete
    assert reader.poll(0.5) == ParamRequestRead('', 1)
    reader.take(ParamValue('B', 2.0, 3, 1), 0.6)
    assert reader.complete
    assert reader.poll(9.0) is None
    assert reader.values == OLD


def test_wire_names_fit_and_are_unique():
    assert len(CONTRACT_NAMES) == len(WIRE_NAMES)
    assert all(len(wire) <= 16 and wire.isascii() for wire in WIRE_NAMES.values())
    for axis in ('roll', 'pitch', 'yaw'):
        for gain in ('angle.kp', 'rate.kp', 'rate.ki', 'rate.kd', 'rate.d_filter_hz'):
            assert f'{axis}.{gain}' in WIRE_NAMES
