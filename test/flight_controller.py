"""One scripted flight controller and the faults of its line, for every test of the bridge.

`FlightController` speaks the wire and has no physics: its cycles are numbered, and it answers
TIMESYNC, parameters, the gains' transactions and arming as the script wants. Its sets of gains are
the firmware's own code (`Store`). Whatever has `cycle() -> bytes` and
`receive(data, now_ns) -> bytes` can take its place: the virtual STM32's `Endpoint`, another
autopilot.

`Line` joins it to a Link in memory, with a clock of its own; `Port` has it behind a
pseudo-terminal, in a thread, for a bridge in a process of its own; `Relay` joins two of them.

A `Port` says nothing before it has heard the bridge, and afterwards waits for a bridge without
CPU instead of losing cycles: every number from the first to the last arrives, or the bridge has
lost it.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import os
import select
import threading
import time
import tty
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from quad_bridge.gains.history import History
from quad_bridge.gains.protocol import GainProtocol
from quad_bridge.gains.table import WIRE_NAMES
from quad_bridge.gains.update import GainSettings, GainUpdates
from quad_bridge.link.machine import Link
from quad_bridge.link.stamping import Described, Restarted, Stamped
from quad_bridge.virtual.native import library
from quad_bridge.wire import frames as f
from quad_bridge.wire.codec import Decoder, Encoder

CYCLE_US, CYCLE_NS, CYCLE_S = 4000, 4_000_000, 0.004
NUMBERS = 10_000
"""A cycle's gyro has its number modulo this on x, 1e-3 rad/s each."""
HOST0_NS = 7_000_000_000
"""Host time in a `Line` when the flight controller's first time is 0."""
TICK = 12
"""Cycles between two ticks of the bridge."""
ZERO = (0.0, 0.0, 0.0)
ARM_DISARM, ACCEPTED = 400, 0
STILL = f.Cycle(
    0, 0, ZERO, (0.0, 0.0, -9.81), ZERO, ZERO, ZERO, (0.5, 0.0, 0.0, 0.0), ZERO, (0.5,) * 4,
    int(f.Flag.ARMED),
)  # fmt: skip
"""A cycle at rest; `replace` says what differs from it."""


def sticks(controller):
    """RC_CHANNELS 50 times a second, for `FlightController(also=sticks)`."""
    if controller.number % 5 == 0:
        yield f.RcChannels(controller.device_us // 1000 % (1 << 32), (1500,) * 9)


class FlightController:
    """The flight controller's script; all attributes may be changed while it runs."""

    def __init__(
        self, *, gyro=(None, 0.25, 0.5), number=0, bits=64,
        also: Callable[[FlightController], Iterable[f.Frame]] = lambda _: ()) -> None:
        self.unanswered = ()
        """Kinds of frames that it does not answer."""
        self.gyro, self.flags = gyro, int(f.Flag.ARMED)
        self.also = also
        """Frames that it sends behind each cycle."""
        self.number, self.boot = number, 0
        """Cycles since the test began, and that of the last start."""
        self.clock_us, self.late_us, self.bits = 0, 0, bits
        """By how much its clock was set, and its cycles begin too late; the width of its time."""
        self.heard: list[f.Frame] = []
        self.store = Store.begun({})
        self.encoder, self.decoder = Encoder(1, 1), Decoder()

    def restart(self):
        """The next cycle is the first one."""
        self.boot = self.number

    def told(self, kind):
        return [frame for frame in self.heard if isinstance(frame, kind)]

    @property
    def device_us(self):
        """Its time at the present cycle."""
        now_us = (self.number - self.boot) * CYCLE_US + self.clock_us + self.late_us
        return now_us % (1 << self.bits)

    def frame(self):
        gyro = (1e-3 * (self.number % NUMBERS), *self.gyro[1:])
        gyro = gyro if self.gyro[0] is None else self.gyro
        number, flags = self.number - self.boot, self.flags
        return replace(STILL, time_us=self.device_us, cycle=number, gyro=gyro, flags=flags)

    def cycle(self):
        self.number += 1
        return self.encode(self.frame(), *self.also(self))

    def encode(self, *frames):
        return b''.join(self.encoder.encode(frame) for frame in frames)

    def receive(self, data, now_ns):
        """The bytes with which it answers, `now_ns` after the test began."""
        frames = self.decoder.feed(data)
        return self.encode(*(reply for frame in frames for reply in self.answer(frame, now_ns)))

    def answer(self, frame, now_ns=0):
        self.heard.append(frame)
        return [] if isinstance(frame, self.unanswered) else list(self._answer(frame, now_ns))

    def _answer(self, frame, now_ns):
        if isinstance(frame, f.TimeSync):
            since_us = now_ns // 1000 - CYCLE_US * self.boot + self.clock_us + self.late_us
            yield f.TimeSync(1000 * (since_us % (1 << self.bits)), frame.ts1_ns)
        elif isinstance(frame, ASKING):
            yield from self.store.answers(frame, now_ns // 1000)
        elif isinstance(frame, f.Command) and frame.command == ARM_DISARM:
            self.flags = self.flags & ~f.Flag.ARMED | int(frame.parameters[0])
            yield f.CommandAck(ARM_DISARM, ACCEPTED)


NAMES = tuple(WIRE_NAMES.values())
INDEX = {name: index for index, name in enumerate(NAMES)}
ASKING = (f.GainsCommand, f.ParamSet, f.ParamRequestRead, f.ParamRequestList)
BYTE, WORD, HERE = ctypes.c_uint8, ctypes.c_uint64, ctypes.c_void_p
Set = ctypes.c_float * len(NAMES)


class Request(ctypes.Structure):
    """`quad_gains_request` of firmware/quad_gains.h."""

    _fields_ = (
        ('action', BYTE), ('transaction', BYTE), ('watch_ms', ctypes.c_uint16),
        ('checksum', ctypes.c_uint32),
    )  # fmt: skip


@functools.cache
def quad_gains(name):
    """A function of firmware/quad_gains.h, with its types."""
    function = getattr(library(), f'quad_gains_{name}')
    function.restype, function.argtypes = {
        'init': (None, (HERE, HERE)), 'heard': (None, (HERE, WORD)),
        'write': (None, (HERE, ctypes.c_size_t, ctypes.c_float)),
        'shown': (ctypes.c_float, (HERE, ctypes.c_size_t)), 'phase': (BYTE, (HERE,)),
        'act': (BYTE, (HERE, HERE, WORD, HERE)),
        'tick': (ctypes.c_bool, (HERE, WORD, ctypes.c_bool, HERE)),
        'checksum': (ctypes.c_uint32, (HERE,)),
    }[name]  # fmt: skip
    return function


class Store(ctypes.Structure):
    """The firmware's sets of gains, `quad_gains` of firmware/quad_gains.h: its code and memory."""

    _fields_ = (
        ('active', Set), ('good', Set), ('copy', Set), ('staging', ctypes.c_bool),
        ('watching', ctypes.c_bool), ('transaction', BYTE), ('confirmations', ctypes.c_uint32),
        ('watch_us', WORD), ('flown_us', WORD), ('ticked_us', WORD), ('heard_us', WORD),
    )  # fmt: skip

    @classmethod
    def begun(cls, stored):
        """As it starts with these values, by wire names; the others are the firmware's own."""
        made = cls()
        quad_gains('init')(made.here, None)
        kept = dict(zip(NAMES, made.good, strict=True)) | stored
        quad_gains('init')(made.here, Set(*(kept[name] for name in NAMES)))
        return made

    @property
    def here(self):
        return ctypes.byref(self)

    def restarted(self):
        """As it starts with the set in its flash."""
        return self.begun(dict(zip(NAMES, self.good, strict=True)))

    def of(self, names, which='active'):
        values = getattr(self, which)
        return tuple([values[INDEX[name]] for name in names])

    def write(self, name, value):
        quad_gains('write')(self.here, INDEX[name], value)

    def hears(self, now_us):
        quad_gains('heard')(self.here, now_us)

    def answers(self, frame, now_us):
        """What the STM32 answers to a frame about parameters or sets."""
        self.hears(now_us)
        if isinstance(frame, f.GainsCommand):
            asked = Request(frame.action, frame.transaction, frame.watch_ms, frame.checksum)
            action = BYTE()
            given, answered = ctypes.byref(asked), ctypes.byref(action)
            result = quad_gains('act')(self.here, given, now_us, answered)
            return [self.state(action.value, result)]
        if isinstance(frame, f.ParamSet):
            self.write(frame.name, frame.value)
        wanted = range(len(NAMES))
        if not isinstance(frame, f.ParamRequestList):
            wanted = [INDEX[frame.name] if frame.name else frame.index]
        shown, here = quad_gains('shown'), self.here
        return [f.ParamValue(NAMES[k], shown(here, k), len(NAMES), k) for k in wanted]

    def pass_by(self, seconds, now_us):
        """Time goes by where it stands still at `now_us`: what lies in it moves."""
        for name in ('ticked_us', 'heard_us'):
            moved = getattr(self, name) - round(1e6 * seconds)
            setattr(self, name, max(moved, now_us - 2_500_000))

    def tick(self, now_us, *, flying=True):
        """Once a cycle: the state to send where the firmware has reverted by itself."""
        result = BYTE()
        back = quad_gains('tick')(self.here, now_us, flying, ctypes.byref(result))
        return self.state(result=result.value) if back else None

    def state(self, action=0, result=0):
        """What is sent once a second."""
        checksum, phase = quad_gains('checksum')(self.active), quad_gains('phase')(self.here)
        return f.GainsState(7, checksum, self.transaction, action, result, phase)


# Walks through all states of both ends.


def clone(part):
    """A copy whose containers are its own."""
    if isinstance(part, Store):
        return Store.from_buffer_copy(part)
    new = object.__new__(type(part))  # as copy.copy does, at a tenth of its cost
    new.__dict__ = held = vars(part).copy()
    for name, value in held.items():
        if type(value) is dict or type(value) is list:
            held[name] = value.copy()
    return new


def explore(begin, most, rest_every):
    """Every state within reach, breadth first: the (state, move) met, how many, how many left.

    A state has `state`, `key()`, `copy()`, `moves()` (functions of a copy by name) and `check()`;
    every so many-th one must come to rest by itself.
    """
    seen, left, met = {begin.key()}, deque([begin]), set()
    while left and len(seen) < most:
        here = left.popleft()
        if len(seen) % rest_every == 0:
            here.copy().comes_to_rest()
        for name, move in here.moves().items():
            new = here.copy()
            move(new)
            new.check()
            met.add((here.state, name))
            key = new.key()
            if key not in seen:
                seen.add(key)
                left.append(new)
    return met, len(seen), len(left)


class Direction:
    """One way of a line: `fault` acts on frames, `noise` flips a share of the bytes."""

    def __init__(self, sender):
        self.fault: Callable[[f.Frame], list[f.Frame]] | None = None
        self.cut = False
        self.noise = 0.0
        self._random = np.random.default_rng(1)
        self._decoder, self._encoder = Decoder(), Encoder(*sender)

    def carry(self, data):
        """What arrives of `data`; a fault that cuts lets pass what it still returns."""
        if self.cut:
            return b''
        if self.fault is not None:  # which cannot keep a signature
            frames = [out for frame in self._decoder.feed(data) for out in self.fault(frame)]
            data = b''.join(self._encoder.encode(frame) for frame in frames)
        if self.noise:
            flips = self._random.random(len(data)) < self.noise
            data = bytes(np.frombuffer(data, np.uint8) ^ np.uint8(0x55) * flips)
        return data


class Line:
    """The bridge's link and a flight controller, joined in memory; time goes by in cycles.

    What the node does with events is done by `handle`: here the gains' protocol takes its part.
    """

    def __init__(self, controller=None):
        self.controller = FlightController() if controller is None else controller
        self.up, self.down = Direction((1, 191)), Direction((1, 1))
        self.out = []
        """What the link has stamped."""
        self.described: Described | None = None
        self.steps = 0
        self.delay, self._way = 0, deque()
        """Cycles that each cycle is on its way; answers are not."""
        self.connect(Link())

    def connect(self, link):
        """Another bridge takes the place of the first."""
        self.link = link
        self.gains = GainProtocol()
        self.opened()

    def opened(self):
        self.link.opened()
        self.gains.restart()

    @property
    def since_ns(self):
        return self.steps * CYCLE_NS

    @property
    def now_ns(self):
        return HOST0_NS + self.since_ns

    def fly(self, seconds):
        self.run(round(seconds / CYCLE_S))

    def run(self, cycles=1):
        for _ in range(cycles):
            self.steps += 1
            self._way.append(self.controller.cycle())
            if len(self._way) > self.delay:
                self.hear(self._way.popleft())
            self.attend()

    def attend(self):
        """What the bridge does between two cycles."""
        if self.steps % TICK == 0:
            self.tick()
        self.exchange()

    def tick(self):
        self.link.tick(self.now_ns)
        self.poll()

    def poll(self):
        if not self.link.standard_only(self.now_ns):
            request = self.gains.poll(1e-9 * self.now_ns)
            if request is not None:
                self.link.send(request)

    def handle(self, event):
        """What the node does with one event."""
        if isinstance(event, Stamped):
            self.out.append(event)
        elif isinstance(event, Described):
            self.described = event
        elif isinstance(event, Restarted):
            self.gains.restart()
        elif isinstance(event.frame, (f.ParamValue, f.GainsState)):
            self.gains.take(event.frame, 1e-9 * self.now_ns)

    def say(self, *frames):
        """The flight controller sends these, and the bridge answers."""
        self.hear(self.controller.encode(*frames))
        self.exchange()

    def hear(self, data, late_ns=0):
        """Bytes of the flight controller reach the bridge, where they are not lost."""
        for event in self.link.receive(self.down.carry(data), self.now_ns + late_ns):
            self.handle(event)
        self.poll()

    def exchange(self):
        """All that the bridge wants to say, and the answers, 0.2 ms later."""
        for _ in range(20):
            data = self.link.to_send()
            if not data:
                return
            arrived = self.up.carry(data)
            self.hear(self.controller.receive(arrived, self.since_ns + 100_000), 200_000)

    def skip(self, cycles=1):
        """Cycles of which the flight controller sends nothing."""
        self.steps += cycles
        self.controller.number += cycles

    def lose(self, seconds, *, restart_after=None):
        """Nothing arrives on either side; the flight controller may restart meanwhile."""
        self.up.cut = self.down.cut = True
        if restart_after is not None:
            self.fly(restart_after)
            self.controller.restart()
            seconds -= restart_after
        self.fly(seconds)
        self.up.cut = self.down.cut = False

    def rising(self):
        stamps = [item.stamp_ns for item in self.out if isinstance(item.frame, f.Cycle)]
        return len(stamps) > 1 and min(b - a for a, b in pairwise(stamps)) > 0

    def errors_ms(self):
        """Of the cycles that number themselves: stamp minus the time at which each began."""
        off_ms = [
            1e-6 * (item.stamp_ns - HOST0_NS) - 4.0 * round(1e3 * item.frame.gyro[0])
            for item in self.out
            if isinstance(item.frame, f.Cycle)
        ]
        turn_ms = 4.0 * NUMBERS
        return [(one + turn_ms / 2) % turn_ms - turn_ms / 2 for one in off_ms]


class Updated(Line):
    """The same with the machine of the gains' updates, as the node joins them, and a history."""

    settings = GainSettings()

    def connect(self, link):
        self.link, self.notes = link, []
        self.history = History(self.settings.folder, lambda job: job())
        self.gains = self.updates = GainUpdates(self.settings, self.history)
        self.opened()

    def opened(self):
        self.link.opened()
        self.updates.restarted()

    def tick(self):
        record = self.history.open(self.updates.aircraft)
        if record is not None:
            self.updates.know(record)
        self.updates.tick(1e-9 * self.now_ns)
        super().tick()
        self.notes += [item.text for item in self.updates.notes]
        self.updates.notes.clear()


# Real ends: each has fileno(), read() and write(data), which says how many bytes it took.


class Pty:
    """A pseudo-terminal behind a link with a fixed name, as an adapter that can be unplugged."""

    def __init__(self, link: Path):
        self.link, self.plugged = link, False
        self.plug()

    def plug(self):
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        os.set_blocking(self.master, False)
        self.link.symlink_to(os.ttyname(self.slave))
        self.plugged = True

    def unplug(self):
        if self.plugged:
            self.plugged = False
            self.link.unlink()
            os.close(self.slave)
            os.close(self.master)

    close = unplug

    def fileno(self):
        return self.master

    def read(self):
        return os.read(self.master, 65536)

    def write(self, data):
        with contextlib.suppress(BlockingIOError):
            return os.write(self.master, data)
        return 0


class Device(Pty):
    """A terminal that somebody else has made."""

    def __init__(self, path):
        self.master = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)

    def close(self):
        os.close(self.master)


class _Runner(threading.Thread):
    """A thread that ends with its `with` block."""

    def __init__(self, *ends):
        super().__init__(daemon=True)
        self.ends, self.stopping = ends, threading.Event()

    def __enter__(self):
        self.start()
        return self

    def __exit__(self, *_exception):
        self.close()

    def halt(self):
        """Fall silent; what is plugged stays so."""
        self.stopping.set()
        if self.is_alive():
            self.join()

    def close(self):
        self.halt()
        for end in self.ends:
            end.close()


class Port(_Runner):
    """A flight controller behind a pseudo-terminal, in a thread, 250 cycles a second."""

    def __init__(self, controller, end, *, start_s=None):
        super().__init__(end)
        self.controller, self.end = controller, end
        self.start_s = time.monotonic() if start_s is None else start_s
        """When its time was 0: another one's, where it goes on with that one's flight."""
        self.unsent = bytearray()
        self.heard = False
        """Whether the bridge has said anything."""

    def run(self):
        due_s = self.start_s + CYCLE_S * (getattr(self.controller, 'number', 0) + 1)
        while not self.stopping.is_set():
            pause = max(min(due_s - time.monotonic(), 0.1), 0.0)
            full = [self.end] if self.unsent else []
            readable, writable, _ = select.select([self.end], full, [], pause)
            if readable:
                now_ns = round(1e9 * (time.monotonic() - self.start_s))
                data = self.end.read()
                if data and not self.heard:  # a cycle first: who answers is known by it
                    self.heard, due_s = True, due_s + CYCLE_S
                    self.unsent += self.controller.cycle()
                self.unsent += self.controller.receive(data, now_ns)
            if time.monotonic() >= due_s:
                due_s += CYCLE_S
                sent = self.controller.cycle()
                self.unsent += sent if self.heard else b''
                writable = True
            if writable and self.unsent:
                del self.unsent[: self.end.write(self.unsent)]


class Relay(_Runner):
    """Joins two ends; the second is the bridge's."""

    def __init__(self, far, near):
        super().__init__(far, near)
        self.heard = bytearray()
        """All bytes of the bridge."""

    def run(self):
        far, near = self.ends
        while not self.stopping.is_set():
            for end in select.select([far, near], [], [], 0.05)[0]:
                with contextlib.suppress(OSError):
                    data = end.read()
                    if end is near:
                        self.heard += data
                    to = far if end is near else near
                    while (data := data[to.write(data) :]) and not self.stopping.wait(0.001):
                        pass  # a cut frame would look like one with another signature
