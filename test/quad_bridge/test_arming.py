"""Requests to arm and disarm: who gets which answer, what is sent again and what never."""

import pytest

from quad_bridge.arming import ARM_DISARM, Arming, OperatorEnable, SecondCall
from quad_bridge.errors import RefusedError
from quad_bridge.wire.frames import CommandAck

ACKS = {'other': CommandAck(511, 0), 'good': CommandAck(ARM_DISARM, 0),
        'bad': CommandAck(ARM_DISARM, 2)}  # fmt: skip
SENT = {1.0: 'sent 1', 0.0: 'sent 0'}
SILENT = 'no answer in 1 s'
WAITS = 'an earlier request is not answered yet; try again in a moment'


class Desk:
    """Whoever asks, the STM32 that answers, and the node that ticks."""

    def __init__(self):
        self.arming, self.answers = Arming(), []

    def hears(self, now_s, event):
        """What an event leads to: the command that is sent, then the answers."""
        self.answers.clear()
        command = None
        if event in ACKS:
            self.arming.acknowledged(ACKS[event], now_s)
        elif event in {'tick', 'armed'}:
            command = self.arming.tick(now_s, armed=event == 'armed')
        elif event == 'end':
            self.arming.end('the node was deactivated')
        else:
            try:
                command = self.arming.ask(event == 'arm', self.answers.append, now_s)
            except RefusedError as error:
                return [str(error)]
        return [*([] if command is None else [SENT[command.parameters[0]]]), *self.answers]


STORIES = {
    'the answer goes to who asked, once': [
        (0.0, 'arm', 'sent 1'), (0.1, 'other'), (0.1, 'good', 'accepted'), (0.2, 'good'),
        (0.3, 'tick'),
    ],
    'arming is sent once, a second one waits its turn and until no answer can come': [
        (0.0, 'arm', 'sent 1'), (0.5, 'tick'), (0.6, 'arm', WAITS), (1.1, 'tick', SILENT),
        (2.0, 'arm', WAITS), (2.2, 'arm', 'sent 1'), (2.3, 'bad', 'denied'),
    ],
    'an aircraft that has armed has answered': [
        (0.0, 'arm', 'sent 1'), (1.1, 'armed', 'accepted'),
    ],
    'disarming passes while arming waits and takes no answer of its': [
        (0.0, 'arm', 'sent 1'), (0.1, 'disarm', 'sent 0', 'given up for a request to disarm'),
        (0.2, 'good'), (0.25, 'tick'), (0.35, 'tick', 'sent 0'), (0.4, 'good', 'accepted'),
    ],
    'disarming is sent until it is given up after a second': [
        (0.0, 'disarm', 'sent 0'), (0.1, 'tick'), (0.25, 'tick', 'sent 0'), (0.3, 'tick'),
        (0.5, 'tick', 'sent 0'), (0.75, 'tick', 'sent 0'), (1.0, 'tick', 'sent 0'),
        (1.1, 'tick', SILENT), (1.3, 'tick'),
    ],
    'all who ask to disarm are told': [
        (0.0, 'disarm', 'sent 0'), (0.5, 'disarm', 'sent 0'), (0.6, 'good', *['accepted'] * 2),
    ],
    'each is told after a second, however often it is asked': [
        (0.0, 'disarm', 'sent 0'), (0.5, 'disarm', 'sent 0'), (1.1, 'tick', 'sent 0', SILENT),
        (1.6, 'tick', SILENT),
    ],
    'who waits is told when the node ends': [
        (0.0, 'arm', 'sent 1'), (0.1, 'end', 'the node was deactivated'), (0.2, 'end'),
    ],
    'on a slow line the answers to a repeated disarm are none to the next arm': [
        (0.0, 'disarm', 'sent 0'), (0.25, 'tick', 'sent 0'), (0.5, 'tick', 'sent 0'),
        (0.55, 'good', 'accepted'), (0.6, 'arm', WAITS), (0.7, 'good'), (0.9, 'good'),
        (0.95, 'arm', 'sent 1'), (1.4, 'bad', 'denied'),
    ],
    'an answer to the disarm of before is as good for the next one': [
        (0.0, 'disarm', 'sent 0'), (0.25, 'tick', 'sent 0'), (0.5, 'tick', 'sent 0'),
        (1.1, 'tick', SILENT), (1.2, 'disarm', 'sent 0'), (1.25, 'good', 'accepted'),
        (1.3, 'arm', WAITS), (2.3, 'arm', 'sent 1'), (2.4, 'bad', 'denied'),
    ],
}  # fmt: skip
"""When, what happens, and what it leads to."""


@pytest.mark.parametrize('story', STORIES.values(), ids=STORIES)
def test_requests_and_answers(story):
    desk = Desk()
    for now_s, event, *outcome in story:
        assert desk.hears(now_s, event) == outcome, (now_s, event)


def test_one_that_arms_after_it_was_given_up_is_told_once_and_disarmed_by_nobody():
    """It may lie in a buffer until a pilot has armed by radio and flies."""
    desk = Desk()
    desk.hears(0.0, 'arm')
    heard = [desk.hears(k / 16, 'tick') for k in range(60)]
    assert [one for one in heard if one] == [[SILENT]]
    assert desk.arming.late(3.0, armed=False) == ''
    assert 'armed 9 s after a request' in desk.arming.late(10.1, armed=True)
    assert desk.arming.late(10.2, armed=True) == ''


def test_disarming_in_flight_takes_a_second_call_within_two_seconds():
    second = SecondCall()
    assert second.fault(1.0, flies=False) == ''
    assert 'call again within 2 s' in second.fault(1.0, flies=True)
    assert second.fault(2.9, flies=True) == ''
    assert 'call again' in second.fault(3.0, flies=True)  # it has armed again
    assert 'call again' in second.fault(5.1, flies=True)  # too late
    assert second.fault(5.2, flies=False) == ''  # it has landed
    assert 'call again' in second.fault(5.3, flies=True)


def test_a_late_last_message_does_not_stand_for_the_silence_behind_it():
    enable = OperatorEnable(required=True)
    enable.take(0.1, 10.0)
    assert not enable.fault(10.2)
    enable.take(0.6, 10.5)
    assert 'its stamp is 0.6' in enable.fault(10.8)
    assert 'is silent' in enable.fault(11.2)
