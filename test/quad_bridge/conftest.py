"""The bridge's gain keeper and the virtual STM32 on one line in memory; the C firmware, built."""

from __future__ import annotations

import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import settings

from quad_bridge.gain_keeper import GainKeeper
from quad_bridge.gain_state import KeeperSettings
from quad_bridge.link import Link
from quad_bridge.virtual.aircraft import Aircraft
from quad_bridge.virtual.endpoint import Endpoint
from quad_bridge.virtual.profile import load_profile
from quad_bridge.virtual.receiver import Receiver
from quad_bridge.wire.codec import Decoder, Encoder
from quad_bridge.wire.frames import RcChannels

# the same examples on every machine and in every run
settings.register_profile(
    'fixed', derandomize=True, deadline=None, database=None, max_examples=200
)
settings.load_profile('fixed')

CYCLE_NS = 4_000_000
TICK = 12
"""Cycles between two ticks of the bridge: 48 ms."""


def same(frame):
    """A wire without faults."""
    return [frame]


class Bench:
    """`up` and `down` say what becomes of a frame on the wire; `cut` takes both away."""

    def __init__(
        self, folder, *, profile='plain', mount='rig', events=(), effect=None, **settings
    ):
        profile = replace(load_profile(profile), mount=mount)
        self.aircraft = Aircraft(profile, seed=1, effect=effect)
        self.endpoint = Endpoint(self.aircraft, Receiver(events=tuple(events)))
        self.settings = KeeperSettings(folder=folder, **settings)
        self.up = self.down = same
        self.cut = False
        self.news, self.cycle = [], None
        self.peak_rad = 0.0
        self._up, self._down = Decoder(), Decoder()
        self._from_stm32, self._from_bridge = Encoder(1, 1), Encoder(1, 191)
        self.new_bridge()

    def new_bridge(self):
        """Kill the bridge, start another."""
        self.link = Link()
        self.keeper = GainKeeper(self.settings, self.link.gains)
        self.link.on_cycle = self._cycle
        self.link.opened()

    @property
    def now_s(self):
        return 1e-9 * self._now_ns

    @property
    def _now_ns(self):
        return 1_000_000_000 + self.aircraft.cycle * CYCLE_NS

    def fly(self, seconds):
        for _ in range(round(seconds * 250)):
            self._receive(self.endpoint.cycle())
            if self.aircraft.cycle % TICK == 0:
                self.link.tick(self._now_ns)
                self.keeper.tick(self.now_s)
                self.link.poll_gains(self._now_ns)
                self.news += [item.text for item in self.keeper.news]
                self.keeper.news.clear()
            self._exchange()

    def fly_until(self, said, seconds=40.0):
        """Fly until a line of news holds `said`; the line."""
        begin = len(self.news)
        for _ in range(round(seconds * 20)):
            self.fly(0.05)
            found = [text for text in self.news[begin:] if said in text]
            if found:
                return found[0]
        raise AssertionError(f'nothing said of {said!r}: {self.news[begin:]}')

    def ask(self, **parameters):
        """An update; `roll_rate_kp` stands for `roll.rate.kp`."""
        parameters.setdefault('source', 'test')
        return self.keeper.ask(
            {name.replace('_', '.'): value for name, value in parameters.items()}, self.now_s
        )

    def gain(self, name):
        """What the STM32 flies."""
        return self.endpoint.firmware.parameter(name)

    @property
    def told(self):
        """What the bridge says is active."""
        return self.link.gains.active

    def _receive(self, data):
        if self.cut:
            return
        for frame in self._down.feed(data):
            for arrived in self.down(frame):
                self.link.receive(self._from_stm32.encode(arrived), self._now_ns)
                if isinstance(arrived, RcChannels):
                    self.keeper.sticks((arrived.channels[3] - 1500) / 500.0, self.now_s)
        self.link.poll_gains(self._now_ns)

    def _cycle(self, frame, now_ns):
        self.cycle = frame
        self.peak_rad = max(self.peak_rad, *(abs(a) for a in frame.attitude[:2]))
        pulse = self.keeper.cycle(frame, 1e-9 * now_ns)
        if pulse is not None:
            self.link.send(pulse)

    def _exchange(self):
        for _ in range(20):
            data = self.link.drain()
            if not data:
                return
            for frame in self._up.feed(data):
                for arrived in [] if self.cut else self.up(frame):
                    sent = self._from_bridge.encode(arrived)
                    answers = self.endpoint.receive(sent, self.aircraft.cycle * CYCLE_NS)
                    self._receive(answers)


@pytest.fixture
def bench(tmp_path):
    """A function that makes a connected bench: all read back, figures of before collected."""

    def make(**options):
        options.setdefault('polarity', 'off')
        made = Bench(tmp_path / 'state', **options)
        made.fly(3.0)
        assert made.link.gains.reader.complete
        return made

    return make


@pytest.fixture(scope='session')
def firmware(tmp_path_factory):
    """A function that builds a target of firmware/Makefile and gives its path."""
    missing = [tool for tool in ('gcc', 'make') if shutil.which(tool) is None]
    if missing:
        pytest.skip(f'no {missing[0]} here')
    folder = tmp_path_factory.mktemp('firmware')

    def build(target):
        source = Path(__file__).resolve().parents[2] / 'firmware'
        made = subprocess.run(
            ['make', '-s', '-C', source, f'BUILD={folder}', f'PYTHON={sys.executable}',
             str(folder / target)],
            capture_output=True, text=True, timeout=300, check=False,
        )  # fmt: skip
        assert made.returncode == 0, made.stdout + made.stderr
        assert made.stderr == ''
        return folder / target

    return build
