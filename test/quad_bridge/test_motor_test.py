"""A motor spins only while the enable is held, for its time, and its caller hears what became."""

import pytest

from quad_bridge.arming import OperatorEnable
from quad_bridge.errors import RefusedError
from quad_bridge.motor_test import AGAIN_S, ANSWER_S, COMMAND, MotorTest, read
from quad_bridge.wire.frames import CommandAck

ASKED = {'motor': 3, 'throttle': 0.1, 'duration_s': 1.0}


class Bench:
    def __init__(self):
        self.enable, self.now_s, self.told, self.sent = OperatorEnable(required=False), 0.0, [], []
        self.test = MotorTest(self.enable)

    def ask(self, **settings):
        settings = {'armed': False, **settings}
        self.sent.append(self.test.ask(
            ASKED, lambda good, words: self.told.append((good, words)), self.now_s, **settings
        ))  # fmt: skip

    def run(self, seconds, *, held=True, answer=0):
        for _ in range(round(seconds / 0.05)):
            self.now_s += 0.05
            if held:
                self.enable.take(0.0, self.now_s)
            sent = self.test.tick(self.now_s)
            self.sent += [sent] if sent is not None else []
            if answer is not None:
                self.test.acknowledged(CommandAck(COMMAND, answer))


def test_it_is_asked_for_again_and_stopped_at_its_end():
    bench = Bench()
    bench.enable.take(0.0, 0.0)
    bench.ask()
    bench.run(1.2)
    assert bench.told == [(True, 'motor 3 spun at 10 %')]
    *spins, stop = [frame.parameters for frame in bench.sent]
    assert len(spins) == pytest.approx(1.0 / AGAIN_S, abs=2)
    assert {p[0] for p in spins} == {3.0}
    assert {round(p[2], 6) for p in spins} == {10.0}
    assert stop[2] == 0.0


@pytest.mark.parametrize(
    ('way', 'words'),
    [({'held': False}, 'let go'), ({'answer': None}, 'no answer'), ({'answer': 1}, 'not now')],
)
def test_it_ends_at_once_where_it_is_let_go_or_not_answered_or_refused(way, words):
    bench = Bench()
    bench.enable.take(0.0, 0.0)
    bench.ask()
    bench.run(ANSWER_S + 0.2, **way)
    assert len(bench.told) == 1
    assert not bench.told[0][0]
    assert words in bench.told[0][1]
    assert not bench.test.running


@pytest.mark.parametrize(
    ('state', 'words'), [({'armed': True}, 'armed'), ({'armed': None}, 'may be armed'),
                         ({'armed': False}, 'hold /operator/enable')],
)  # fmt: skip
def test_it_does_not_begin_armed_unheard_or_without_the_enable(state, words):
    with pytest.raises(RefusedError, match=words):
        Bench().ask(**state)


@pytest.mark.parametrize(
    'wrong', [{}, {'motor': 5}, {'motor': 1.0}, {'motor': True}, {'motor': 1, 'throttle': 0.3},
              {'motor': 1, 'throttle': float('nan')}, {'motor': 1, 'duration_s': 60},
              {'motor': 1, 'speed': 1}],
)  # fmt: skip
def test_a_meaningless_request_is_refused(wrong):
    with pytest.raises(RefusedError):
        read(wrong)
