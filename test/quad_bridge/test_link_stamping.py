"""Stamps through all that a line and a clock do, told as stories; the guards one by one.

Whatever happens, no stamp is off by a millisecond or more, and none runs backwards.
"""

import pytest
from flight_controller import CYCLE_NS, HOST0_NS, FlightController, Line, sticks

from quad_bridge.link.guards import TIMEOUT_NS
from quad_bridge.wire import frames as f


def talks(controller):
    """Sticks, and once a second the heartbeat of who flies."""
    yield from sticks(controller)
    if controller.number % 250 == 0:
        yield f.Heartbeat()


class Story(Line):
    """A line whose flight controller talks beside its cycles, and has flown for two seconds."""

    def __init__(self, bits=64, clock_us=0, seconds=2.0, also=talks):
        super().__init__(FlightController(also=also, bits=bits))
        self.controller.clock_us = clock_us
        self.fly(seconds)
        self.begun, self.since_restart = self.link.stamping.withheld, 0
        self.cycles_before = self.link.cycles
        self.out = []

    def set(self, **script):
        vars(self.controller).update(script)

    def restart(self, seconds):
        self.controller.restart()
        self.since_restart = len(self.out)
        self.fly(seconds)

    def delayed(self, cycles):
        self.delay = cycles

    def say_sticks(self):
        self.say(*self.own_sticks())

    def own_sticks(self):
        yield f.RcChannels(self.controller.device_us // 1000 % (1 << 32), (1500,) * 9)

    def deaf_and_sticks_first(self):
        """TIMESYNC is not answered at first, and the sticks come before the cycle."""
        for k in range(350):
            self.controller.unanswered = (f.TimeSync,) if k <= 100 else ()
            self.skip()
            self.hear(self.controller.encode(*self.own_sticks(), self.controller.frame()))
            self.attend()

    def stand_still(self):
        """The host stands still, and then finds all waiting: pieces of 16 ms, time goes on."""
        kept = b''
        for _ in range(250):
            self.skip()
            kept += self.controller.encode(self.controller.frame(), *sticks(self.controller))
        for begin in range(0, len(kept), 4095):
            self.skip(4)
            self.hear(kept[begin : begin + 4095])
            self.attend()

    def uneven(self):
        for k in range(5000):
            self.controller.late_us = 3000 if k % 50 == 0 else 0
            self.run()

    def sticks_off_ms(self):
        """Stamps of the sticks minus the host time by their device time."""
        zero_ms = 4.0 * self.controller.boot - 1e-3 * self.controller.clock_us
        wrap_ms = 2.0**32 / (1000.0 if self.controller.bits == 32 else 1.0)
        return [
            (1e-6 * (item.stamp_ns - HOST0_NS) - item.frame.time_ms - zero_ms + wrap_ms / 2)
            % wrap_ms - wrap_ms / 2
            for item in self.out[self.since_restart :] if isinstance(item.frame, f.RcChannels)
        ]  # fmt: skip


DEAF = {'unanswered': (f.TimeSync,)}
NEW_CLOCK = (1, 250)
"""Cycles held back: told by the first round trip, then eight for the new clock, a tick each."""


def unheard(uptime_s, silence_s):
    """A restart that nobody hears, whose counter is higher afterwards."""
    steps = ('lose', silence_s, {'restart_after': 0.3}), ('say_sticks',), ('fly', 2.0)
    return steps, {'seconds': uptime_s, 'restarts': 1, 'held': NEW_CLOCK, 'clock restarts': None}


def clock_set(by_ms):
    steps = ('set', {'clock_us': round(1000 * by_ms)}), ('run', 1500)
    begin = {'seconds': 3.2, 'also': lambda _: ()}  # each cycle is published or held back
    return steps, {**begin, 'held': NEW_CLOCK, 'clock restarts': 1, 'alarms': (1, 1)}


def reopened(away_s, restart_after, restarts):
    steps = ('lose', away_s, {'restart_after': restart_after}), ('opened',), ('fly', 2.0)
    more = {'restarts': restarts, 'held': NEW_CLOCK, 'clock restarts': None}
    return steps, {'seconds': 3.0, **more}


STORIES = {
    **{f'restarted unheard after {up} s': unheard(up, silence)
       for up, silence in ((2.0, 3.0), (1.0, 2.0), (2.0, 4.9), (0.6, 2.0))},
    **{f'clock set by {ms} ms': clock_set(ms) for ms in (40.0, -40.0, 3.0, -3.0, 2500.0, -2500.0)},
    'opened anew': reopened(8.0, None, 0),
    'opened anew after a restart': reopened(8.0, 1.0, 1),
    'opened anew soon after a restart': reopened(0.5, 0.1, 1),
    'sticks before the cycle tell nothing of the past': (
        (('lose', 3.0, {'restart_after': 0.3}), ('deaf_and_sticks_first',)),
        {'restarts': 1, 'held': (1, 300), 'clock restarts': 1},
    ),
    'the host stands still': ((('stand_still',), ('fly', 1.0)), {}),
    'a silence alone': ((('lose', 3.0), ('fly', 1.0)), {}),
    'a silence, then no answers': ((('lose', 3.0), ('set', DEAF), ('fly', 1.0)), {}),
    'late for good': ((('delayed', 50), ('fly', 2.0)), {}),
    'a counter and a time that go on, then begin anew': (
        (('skip', 2**32 // 4000 - 1000), ('run', 1400), ('restart', 2.4)),
        {'seconds': 0.0, 'restarts': 1, 'held': (1, 400), 'clock restarts': 1},
    ),
    'a time of 32 bits': (
        (('run', 1500),), {'bits': 32, 'clock_us': 2**32 - 4_000_000, 'wraps': 1},
    ),
    'a time of 32 bits that wraps in a silence': (
        (('run', 400), ('lose', 1.0), ('run', 400)),
        {'bits': 32, 'clock_us': 2**32 - 4_000_000, 'wraps': 1},
    ),
    'a time of 32 bits that wraps while the cable is out': (
        (('lose', 4.0), ('opened',), ('fly', 1.0)),
        {'bits': 32, 'clock_us': 2**32 - 4_000_000, 'held': NEW_CLOCK, 'clock restarts': 1},
    ),
    # doubled twice, what may be off covers them
    'uneven cycles': ((('uneven',),), {'alarms': (1, 4), 'off_ms': 3.5, 'off': 100}),
    'uneven, and no answers any more': (
        (('set', DEAF), ('run', 10), ('set', {'late_us': 3000}), ('run', 1),
         ('set', {'late_us': 0}), ('run', 100)),
        {'alarms': (1, 1), 'off_ms': 3.5, 'off': 1},
    ),
}  # fmt: skip
"""What happens, and what it costs; where nothing is said it costs nothing."""


@pytest.mark.parametrize(('steps', 'said'), STORIES.values(), ids=STORIES)
def test_every_stamp_is_true_whatever_happens(steps, said):
    line = Story(**{k: said[k] for k in ('bits', 'clock_us', 'seconds', 'also') if k in said})
    for name, *given in steps:
        named = given.pop() if given and isinstance(given[-1], dict) else {}
        getattr(line, name)(*given, **named)
    link, stamping = line.link, line.link.stamping
    assert line.rising()
    off = [e for e in line.errors_ms() if abs(e) > 1.0]
    assert len(off) == said.get('off', 0)
    assert max(map(abs, [*line.errors_ms(), *line.sticks_off_ms()])) < said.get('off_ms', 1.0)
    (low, high), held = said.get('held', (0, 0)), stamping.withheld - line.begun
    assert low <= held <= high
    assert 'also' not in said or len(line.out) + held == link.cycles - line.cycles_before
    assert link.decoder.counts.restarts == said.get('restarts', 0)
    low, high = said.get('alarms', (0, 0))
    assert low <= stamping.guard.alarms <= high
    assert stamping.device_time.wraps == said.get('wraps', 0)
    assert said.get('clock restarts', 0) in {None, link.clock.restarts}
    assert not line.controller.told(f.Command)  # it is no autopilot that must be asked


def test_what_comes_late_beside_no_cycle_waits_no_longer_than_patience():
    """The control task hangs, the radio's frames go on 250 ms late, TIMESYNC is silent."""
    line, waiting = Story(seconds=3.0), []
    line.set(**DEAF)
    for k in range(500):
        line.skip(5)
        us = line.controller.device_us - 250_000
        line.hear(line.controller.encode(f.RcChannels(us // 1000, (1500,) * 9)))
        line.attend()
        waiting.append(k + 1 - len(line.out))
    assert max(waiting) <= 2 * TIMEOUT_NS / (5 * CYCLE_NS) + 2
    assert len(line.out) > 465
