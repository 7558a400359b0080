"""Requests to arm and disarm: who gets which answer, what is sent again and what never."""

import pytest

from quad_bridge.arming import ARM_DISARM, Arming
from quad_bridge.errors import RefusedError
from quad_bridge.wire.frames import CommandAck

GOOD, DENIED = CommandAck(ARM_DISARM, 0), CommandAck(ARM_DISARM, 2)


class Desk:
    def __init__(self):
        self.arming, self.answers = Arming(), []

    def ask(self, arm, now_s):
        return self.arming.ask(arm, self.answers.append, now_s)


@pytest.fixture
def desk():
    return Desk()


@pytest.mark.parametrize(('ack', 'told'), [(GOOD, 'accepted'), (DENIED, 'denied')])
@pytest.mark.parametrize('arm', [True, False])
def test_the_answer_goes_to_who_asked_once(desk, arm, ack, told):
    assert desk.ask(arm, 0.0).parameters == (1.0 if arm else 0.0,)
    desk.arming.acknowledged(CommandAck(511, 0), 0.1)
    desk.arming.acknowledged(ack, 0.1)
    desk.arming.acknowledged(GOOD, 0.2)
    assert desk.answers == [told]
    assert desk.arming.tick(0.3) is None


def test_arming_is_sent_once_and_a_second_one_waits_its_turn(desk):
    desk.ask(True, 0.0)
    assert desk.arming.tick(0.5) is None
    with pytest.raises(RefusedError, match='earlier request'):
        desk.ask(True, 0.6)
    assert desk.arming.tick(1.1) is None
    assert desk.answers == ['no answer in 1 s']
    with pytest.raises(RefusedError, match='earlier request'):
        desk.ask(True, 2.0)  # an answer to the first could still come
    desk.ask(True, 2.2)
    desk.arming.acknowledged(DENIED, 2.3)
    assert desk.answers == ['no answer in 1 s', 'denied']


def test_an_aircraft_that_has_armed_has_answered(desk):
    desk.ask(True, 0.0)
    assert desk.arming.tick(1.1, armed=True) is None
    assert desk.answers == ['accepted']
    assert desk.arming.late(1.2, armed=True) == ''


def test_one_that_arms_after_it_was_given_up_is_told_once_and_disarmed_by_nobody(desk):
    """It may lie in a buffer until a pilot has armed by radio and flies."""
    desk.ask(True, 0.0)
    assert [desk.arming.tick(k / 16) for k in range(60)] == [None] * 60
    assert desk.arming.late(3.0, armed=False) == ''
    assert 'armed 9 s after a request' in desk.arming.late(10.1, armed=True)
    assert desk.arming.late(10.2, armed=True) == ''


def test_disarming_passes_while_arming_waits_and_takes_no_answer_of_its(desk):
    desk.ask(True, 0.0)
    assert desk.ask(False, 0.1).parameters == (0.0,)
    assert desk.answers == ['given up for a request to disarm']
    desk.arming.acknowledged(GOOD, 0.2)  # to the arming
    assert len(desk.answers) == 1
    assert desk.arming.tick(0.25) is None
    assert desk.arming.tick(0.35).parameters == (0.0,)
    desk.arming.acknowledged(GOOD, 0.4)
    assert desk.answers[1:] == ['accepted']


def test_disarming_is_sent_until_it_is_answered_and_given_up_after_a_second(desk):
    desk.ask(False, 0.0)
    sent = [desk.arming.tick(k / 16) for k in range(1, 30)]
    assert [k for k, command in enumerate(sent, 1) if command is not None] == [4, 8, 12, 16]
    assert desk.answers == ['no answer in 1 s']


def test_all_who_ask_to_disarm_are_told(desk):
    desk.ask(False, 0.0)
    desk.ask(False, 0.5)
    desk.arming.acknowledged(GOOD, 0.6)
    assert desk.answers == ['accepted'] * 2


def test_who_waits_is_told_when_the_node_ends(desk):
    desk.ask(True, 0.0)
    desk.arming.end('the node was deactivated')
    desk.arming.end('again')
    assert desk.answers == ['the node was deactivated']


def test_the_answers_to_a_repeated_disarm_are_none_to_the_next_arm(desk):
    """A slow line: three disarms are on the way before the first answer."""
    desk.ask(False, 0.0)
    assert desk.arming.tick(0.2)
    assert desk.arming.tick(0.4)
    desk.arming.acknowledged(GOOD, 0.5)
    with pytest.raises(RefusedError, match='earlier request'):
        desk.ask(True, 0.55)
    desk.arming.acknowledged(GOOD, 0.7)
    desk.arming.acknowledged(GOOD, 0.9)
    desk.ask(True, 0.95)
    desk.arming.acknowledged(DENIED, 1.4)
    assert desk.answers == ['accepted', 'denied']


def test_an_answer_to_the_disarm_of_before_is_as_good_for_the_next_one(desk):
    """Five disarms went into a line that came back: who asks again hears the first answer."""
    desk.ask(False, 0.0)
    for k in range(1, 18):
        desk.arming.tick(k / 16)
    assert desk.answers == ['no answer in 1 s']
    desk.ask(False, 1.2)
    desk.arming.acknowledged(GOOD, 1.25)
    assert desk.answers[1:] == ['accepted']
    with pytest.raises(RefusedError, match='earlier request'):
        desk.ask(True, 1.3)  # the others' answers are on the way
    desk.ask(True, 2.3)
    desk.arming.acknowledged(DENIED, 2.4)
    assert desk.answers[2:] == ['denied']


def test_everybody_hears_that_nobody_answers_however_often_it_is_asked(desk):
    for k in range(20):
        desk.arming.tick(0.5 * k)
        desk.ask(False, 0.5 * k)
    assert desk.answers == ['no answer in 1 s'] * 17
