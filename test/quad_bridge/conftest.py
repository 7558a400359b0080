"""The bridge's gains and the virtual STM32 on one line in memory; the C firmware, built."""

import fcntl
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from flight_controller import Updated
from hypothesis import settings
from node_process import ended
from virtual_aircraft import Endpoint

from quad_bridge.aircraft import Quad
from quad_bridge.gains.polarity import PULSE_VALID_MS
from quad_bridge.gains.update import GainSettings
from quad_bridge.link.stamping import Restarted, Stamped
from quad_bridge.virtual.aircraft import Aircraft
from quad_bridge.virtual.profile import load_profile
from quad_bridge.virtual.receiver import Receiver
from quad_bridge.wire.frames import Cycle, GainsState, ParamValue, RcChannels

ROOT = Path(__file__).resolve().parents[2]
# the same examples on every machine and in every run
settings.register_profile(
    'fixed', derandomize=True, deadline=None, database=None, max_examples=200
)
settings.load_profile('fixed')


class Bench(Updated):
    """`cut` loses what goes either way; `cycle` is the last one that has come.

    `endpoint` makes what is flown: the firmware in memory, or one on another board.
    """

    def __init__(
        self, folder, *, profile='plain', mount='rig', events=(), effect=None, endpoint=Endpoint,
        **settings,
    ):
        profile = replace(load_profile(profile), mount=mount)
        self.aircraft = Aircraft(profile, seed=1, effect=effect)
        self.endpoint = endpoint(self.aircraft, Receiver(events=tuple(events)))
        self.settings = GainSettings(folder=folder, **settings)
        self.cycle, self.peak_rad = None, 0.0
        super().__init__(self.endpoint)

    @property
    def now_s(self):
        return 1e-9 * self.now_ns

    @property
    def cut(self):
        return self.up.cut

    @cut.setter
    def cut(self, cut):
        self.up.cut = self.down.cut = cut

    def handle(self, event):
        frame = getattr(event, 'frame', None)
        if isinstance(event, Restarted):
            self.updates.restarted()
        elif isinstance(event, Stamped):
            pass
        elif isinstance(frame, RcChannels):
            self.updates.sticks((frame.channels[3] - 1500) / 500.0, self.now_s)
        elif isinstance(frame, (ParamValue, GainsState)):
            self.updates.take(frame, self.now_s)
        elif isinstance(frame, Cycle):
            self.cycle = frame
            self.peak_rad = max(self.peak_rad, *(abs(a) for a in frame.attitude[:2]))
            pulse = self.updates.cycle(frame, self.now_s)
            if pulse is not None:
                self.link.send(Quad().excite(*pulse, PULSE_VALID_MS))

    def fly_until(self, said, seconds=40.0):
        """Fly until a line of news holds `said`; the line."""
        begin = len(self.notes)
        for _ in range(round(seconds * 20)):
            self.fly(0.05)
            found = [text for text in self.notes[begin:] if said in text]
            if found:
                return found[0]
        raise AssertionError(f'nothing said of {said!r}: {self.notes[begin:]}')

    def ask(self, **parameters):
        """An update; `roll_rate_kp` stands for `roll.rate.kp`."""
        parameters.setdefault('source', 'test')
        return self.updates.ask(
            {name.replace('_', '.'): value for name, value in parameters.items()}, self.now_s
        )

    def gain(self, name):
        return self.endpoint.gain(name)

    @property
    def told(self):
        return self.updates.active


@pytest.fixture
def bench(tmp_path):
    """A function that makes a connected bench: all read back, figures of before collected."""

    def make(**options):
        options.setdefault('polarity', 'off')
        made = Bench(tmp_path / 'state', **options)
        made.fly(3.0)
        assert made.updates.active
        return made

    return make


@pytest.fixture(scope='session')
def firmware():
    """A function that builds a target of firmware/Makefile and gives its path.

    It stays for the next run, as what `make` makes does.
    """
    missing = [tool for tool in ('gcc', 'make') if shutil.which(tool) is None]
    if missing:
        pytest.skip(f'no {missing[0]} here')
    folder = ROOT / 'build/firmware_test'
    folder.mkdir(parents=True, exist_ok=True)

    def build(target):
        with (folder / 'lock').open('w') as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # one of pytest's workers builds for all
            made = ended('make', '-s', '-C', ROOT / 'firmware', f'BUILD={folder}',
                         f'PYTHON={sys.executable}', 'CFLAGS=-O1 -g', folder / target)
        assert (made.returncode, made.stderr) == (0, ''), made.stdout + made.stderr
        return folder / target

    return build
