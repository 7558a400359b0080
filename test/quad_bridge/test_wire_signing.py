"""Signing: both ends refuse the same. That they write the same stands in golden_frames.json."""

import pytest

from quad_bridge.virtual.aircraft import boot
from quad_bridge.virtual.native import NativeFirmware
from quad_bridge.virtual.profile import Profile
from quad_bridge.wire import frames as f
from quad_bridge.wire.codec import Decoder, Encoder
from quad_bridge.wire.signing import LAST, Signing, signing_time

KEY, OTHER = bytes(range(32)), bytes(32)
FRAME = f.ParamSet('ROLL_RATE_KP', 0.5, 1, 1)
ASK = f.ParamRequestRead('YAW_ANG_KP', -1, 1, 1)
NOW = 10_000_000
TODAY = signing_time(1_780_000_000_000_000_000)
YEAR = 365 * 86_400 * 100_000


def signing(key=KEY, now=NOW, **more):
    return Signing(key, lambda: now, **more)


def encoder(**more):
    return Encoder(1, 191, signing(**more))


class Bridge:
    def __init__(self, now=NOW):
        self.decoder = Decoder(signing(now=now))

    def hears(self, data):
        """How many of the frames it takes."""
        return len(self.decoder.feed(data))

    def counts(self):
        """Unsigned, forged, replayed."""
        counts = self.decoder.counts
        return (counts.unsigned, counts.forged, counts.replayed + counts.ahead)


class Board:
    """The firmware, which answers each of the frames."""

    def __init__(self, now=NOW):
        self.firmware = NativeFirmware(boot(Profile()).frame(), KEY, now)

    def hears(self, data):
        return len(Decoder().feed(self.firmware.receive(data, 0)))

    def counts(self):
        return self.firmware.counts()[2:5]


each_end = pytest.mark.parametrize('end', [Bridge, Board])


@each_end
def test_nobody_else_is_heard_and_each_is_counted_apart(end):
    made, sender = end(), encoder()
    good, later = sender.encode(ASK), sender.encode(ASK)
    for data, heard in (
        (Encoder(1, 191).encode(ASK), 0), (encoder(key=OTHER).encode(ASK), 0),
        (encoder(key=OTHER, now=2**40).encode(ASK), 0),  # the time of a forgery does not count
        (encoder(now=NOW - 1_000_000).encode(ASK), 0), (good, 1), (good, 0), (later, 1),
        (good + later, 0), (Encoder(1, 190, signing()).encode(ASK), 1),  # has its own time
    ):  # fmt: skip
        assert made.hears(data) == heard
    assert made.counts() == (1, 2, 4)
    # restarted a second later: the recording is from before its start, though of this minute
    assert end(NOW + 100_000).hears(good + later) == 0


@each_end
def test_any_changed_byte_of_a_signed_frame_is_refused(end):
    data = encoder().encode(ASK)
    for place in range(len(data)):
        damaged = bytearray(data)
        damaged[place] ^= 0x10
        assert end().hears(bytes(damaged)) == 0, place


@each_end
def test_one_frame_of_a_broken_clock_locks_nobody_out(end):
    broken = signing()
    broken.stamp = lambda: 2**48 - 1
    data = Encoder(1, 191, broken).encode(ASK)
    made, sender = end(), encoder()
    first, last = (sender.encode(ASK) for _ in range(2))
    assert made.hears(data) == 0
    assert made.hears(first + data + last) == 2
    assert made.hears(first + last) == 0  # nor lets it anybody in twice
    assert made.counts() == (0, 0, 4)


@each_end
@pytest.mark.parametrize('stored', [0, 2**64 - 1, 2**48 - 1, 2**47 + 1])
def test_a_clock_that_was_never_set_follows(end, stored):
    assert end(stored).hears(encoder(now=TODAY).encode(ASK)) == 1


def test_ends_whose_clocks_differ_meet():
    ahead, behind = signing(now=2 * NOW), signing(now=NOW // 2)
    to_ahead = Encoder(1, 191, behind)
    assert Decoder(ahead).feed(to_ahead.encode(FRAME)) == []
    assert Decoder(behind).feed(Encoder(1, 1, ahead).encode(FRAME)) == [FRAME]
    assert Decoder(ahead).feed(to_ahead.encode(FRAME)) == [FRAME]
    # one that falls by years goes on, too
    now = [TODAY]
    ours, far = Signing(KEY, lambda: now[0]), signing(now=TODAY)
    decoder, from_far = Decoder(ours), Encoder(1, 1, far)
    assert decoder.feed(from_far.encode(FRAME)) == [FRAME]
    now[0] -= 2 * YEAR
    assert decoder.feed(from_far.encode(FRAME)) == [FRAME]
    assert Decoder(far).feed(Encoder(1, 191, ours).encode(FRAME)) == [FRAME]


@pytest.mark.parametrize(
    ('own', 'theirs', 'heard'),
    [
        (TODAY, 2**48 - 2, False), (TODAY, LAST + 1, False), (0, 2**48 - 2, False),
        (TODAY, TODAY + 2 * YEAR, False), (TODAY, TODAY + YEAR // 2, True),
        (5 * YEAR, TODAY, True),
    ],
)  # fmt: skip
def test_a_clock_far_ahead_of_one_that_was_set_is_not_followed(own, theirs, heard):
    ours, far = signing(now=own), signing(now=10)
    decoder = Decoder(ours)
    far.stamp = lambda: theirs
    assert decoder.feed(Encoder(1, 1, far).encode(FRAME)) == ([FRAME] if heard else [])
    assert decoder.counts.ahead == (not heard)
    assert ours.stamp() < LAST
    # restarted with the right time it is heard, by either end
    again = signing(now=max(theirs if heard else 0, TODAY) + 100)
    assert decoder.feed(Encoder(1, 1, again).encode(FRAME)) == [FRAME]
    assert Decoder(again).feed(Encoder(1, 191, ours).encode(FRAME)) == [FRAME]
