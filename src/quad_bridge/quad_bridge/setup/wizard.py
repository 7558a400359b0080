"""`ros2 run quad_bridge setup`: asks for one thing after another, shows what it measures.

It talks to the port itself, so no bridge may run. Each step is written once it is agreed to, since
the next ones need it: no motor spins before the throttle's channel is known.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import signal
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path

import numpy as np
import yaml

from quad_bridge.arguments import OneLineParser, ended_in_one_line, say
from quad_bridge.errors import BadInputError, RefusedError
from quad_bridge.gains.history import default_folder
from quad_bridge.gains.table import ROWS, SET_UP
from quad_bridge.key_file import signing_from
from quad_bridge.link.port import SerialPort, over_network
from quad_bridge.motor_test import MAX_THROTTLE, USUAL_THROTTLE
from quad_bridge.setup import measure
from quad_bridge.setup.talk import Talk

FILE = 'setup.yaml'
NAMES = tuple(row.name for row in SET_UP)
COMPASS_S, SPIN_S = 30.0, 1.0
PLACES = '1 rear left, 2 rear right, 3 front right, 4 front left'
CLOCKWISE = (1, 3)
MIN_RANGE_US = 200.0  # of the motors' pulses: a fifth of the usual 1000
_STICKS = (
    ('throttle', 'all the way down', 'all the way up'),
    ('roll', 'all the way left', 'all the way right'),
    ('pitch', 'all the way back, towards you', 'all the way forward'),
    ('yaw', 'all the way right', 'all the way left'),
)
"""Words for the lower and the upper end of a stick, as in /rc/in."""

Ask = Callable[[str], str]


class Wizard:
    """The steps; `ask` puts a question and returns the answer, `tell` shows a line."""

    def __init__(self, talk: Talk, ask: Ask, tell: Callable[[str], object]) -> None:
        self._talk, self._ask, self._tell = talk, ask, tell
        self.written: dict[str, float] = {}
        """The changed values, by name."""

    def run(self, only: Sequence[str] = ()) -> dict[str, float]:
        """Ask for each step, or only for these; what has been changed."""
        self._talk.read()
        if self._talk.armed:
            raise RefusedError('it is armed: disarm it first')
        self._tell(f'aircraft {self._talk.aircraft}')
        for name, words, step in self._steps():
            if only and name not in only:
                continue
            if not only and not self._yes(f'\n{words}'):
                continue
            self._take(step)
        return self.written

    def _steps(self) -> tuple[tuple[str, str, Callable[[], dict[str, float]]], ...]:
        return (
            ('receiver', "Receiver: its channels and sticks' ends", self._receiver),
            ('motors', "Speed controllers: their pulses", self._pulses),
            ('board', "Board and accelerometer: six positions", self._positions),
            ('compass', 'Compass: turned through all directions', self._compass),
            ('battery', 'Battery: its voltage by a voltmeter', self._battery),
            ('outputs', 'Motors: which is where, propellers OFF', self._outputs),
        )

    def _take(self, step: Callable[[], dict[str, float]]) -> None:
        """Do a step until it is good, or is left out."""
        while True:
            try:
                values = step()
                _refuse_beyond_limits(values)
            except RefusedError as error:
                self._tell(f'  {error}')
                if self._yes('  again'):
                    continue
                return
            for name, value in values.items():
                self._tell(f'  {name:28s} {self._now(name):10.4g} -> {value:10.4g} '
                           f'{ROWS[name].unit}')  # fmt: skip
            if self._yes('  write these'):
                self.written |= written(self._talk, values)
                self._tell('  written, read back and kept')
            return

    def _now(self, name: str) -> float:
        return self._talk.values[name]

    def _yes(self, words: str) -> bool:
        return self._ask(f'{words}? [Y/n] ').strip().lower() in {'', 'y', 'yes'}

    def _ready(self, words: str) -> None:
        self._ask(f'  {words}, then Enter ')

    def _number(self, words: str, now: float, low: float, high: float) -> float:
        text = self._ask(f'  {words} [{now:g}] ').strip()
        try:
            value = float(text) if text else now
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            raise RefusedError(f'must be a number of {low:g} to {high:g}: found {text!r}')
        return value

    # The steps.

    def _receiver(self) -> dict[str, float]:
        self._ready('sticks in the middle, throttle down, all switches off')
        rest = self._talk.pulses()
        values: dict[str, float] = {}
        for name, less, more in _STICKS:
            pulses = []
            for where in (less, more):
                self._ready(f'hold {name} {where}')
                pulses.append(self._talk.pulses())
            values |= measure.stick(name, rest, *pulses)
        self._ready('let the sticks go, throttle down')
        off = self._talk.pulses()
        self._ready('kill switch on, and leave it on')
        killed = self._talk.pulses()  # else the arming switch arms an aircraft that is set up
        values |= measure.switch('kill', off, killed)
        for name, words in (('arm', 'arming switch'), ('hold', 'switch of the height mode')):
            if not self._yes(f'  is there a {words}'):
                values[f'receiver.{name}_channel'] = 0.0
                continue
            self._ready(f'{words} on')
            values |= measure.switch(name, killed, self._talk.pulses())
            self._ready(f'{words} off again')
        self._ready('kill switch off again')
        if len({value for name, value in values.items() if name.endswith('_channel') and value}
               ) < sum(bool(value) for name, value in values.items() if name.endswith('_channel')):
            raise RefusedError('two of them are on one channel')
        dead = self._now('receiver.deadband_us')
        values['receiver.deadband_us'] = self._number('deadband, µs', dead, 0.0, 100.0)
        return values

    def _pulses(self) -> dict[str, float]:
        values = {}
        for end, words in (('min', 'a motor that stands'), ('max', 'full throttle')):
            name = f'motors.pulse_{end}_us'
            values[name] = self._number(f'pulse of {words}, µs', self._now(name), 800.0, 2200.0)
        if not values['motors.pulse_max_us'] >= values['motors.pulse_min_us'] + MIN_RANGE_US:
            raise RefusedError(
                f'full throttle must be at least {MIN_RANGE_US:g} µs above standing'
            )
        return values

    def _positions(self) -> dict[str, float]:
        raw = {}
        for name in measure.FORCES:
            self._ready(f'hold it {name}')
            raw[name] = measure.raw_accel(self._talk.force(), self._talk.values)
            self._tell(f'    {np.round(raw[name], 2)} m/s² in the axes of the board')
        return measure.six_positions(raw)

    def _compass(self) -> dict[str, float]:
        self._ready(f'turn it slowly through all directions for {COMPASS_S:.0f} s, far from iron')
        fields = self._talk.fields(COMPASS_S)
        return measure.compass(measure.raw_compass(fields, self._talk.values))

    def _battery(self) -> dict[str, float]:
        self._talk.wait(1.0)
        board_v = self._talk.volts
        true = self._number(f'the board shows {board_v:.2f} V, the voltmeter', board_v, 0.0, 65.0)
        return measure.divider(board_v, true, self._talk.values['battery.divider'])

    def _outputs(self) -> dict[str, float]:
        if self._ask('  type OFF once all propellers are off: ').strip().upper() != 'OFF':
            raise RefusedError('no motor is spun with a propeller on')
        throttle = self._number('throttle, 0 to 1', USUAL_THROTTLE, 0.01, MAX_THROTTLE)
        places, wrong = {}, []
        for motor in range(1, 5):
            self._ready(f'motor {motor} spins for {SPIN_S:g} s')
            self._talk.spin(motor, throttle, SPIN_S)
            place = int(self._number(f'which one was it ({PLACES})', motor, 1.0, 4.0))
            clockwise = place in CLOCKWISE
            direction = 'clockwise' if clockwise else 'counter-clockwise'
            places[motor] = place
            if not self._yes(f'  did it turn {direction}, seen from above'):
                wrong.append(place)
        for place in wrong:
            self._tell(f'  motor {place}: swap two of its three wires, so that it turns round')
        return measure.outputs(places, self._talk.values)


def written(talk: Talk, target: Mapping[str, float]) -> dict[str, float]:
    """Write what differs, as the wire carries it; what that was.

    Where nothing differs all is written: a firmware that could not read what it had kept has begun
    with the table's values, and flies none, equal ones neither, before a set is confirmed.
    """
    carried = {name: float(np.float32(value)) for name, value in target.items()}
    changed = {name: value for name, value in carried.items() if value != talk.values.get(name)}
    if carried:
        talk.write(changed or carried)
    return changed


def _refuse_beyond_limits(values: Mapping[str, float]) -> None:
    for name, value in values.items():
        low, high = ROWS[name].limits or (-math.inf, math.inf)
        if not low <= value <= high:
            raise RefusedError(f'{name}: {value:.4g} {ROWS[name].unit} lies outside {low:g} to '
                               f'{high:g}: measure it again')  # fmt: skip


def save(path: Path, aircraft: str, values: Mapping[str, float]) -> None:
    """Write the aircraft's file whole; one with other values stays beside it.

    A firmware that could not read what it had kept has the table's values: the earlier file is
    the only place that still has the aircraft's own. Raises BadInputError.
    """
    set_up = {name: float(values[name]) for name in NAMES}
    entry = {'aircraft': aircraft, 'written': f'{datetime.now(timezone.utc):%Y-%m-%dT%H:%M:%SZ}',
             'set_up': set_up}  # fmt: skip
    temporary = path.with_name(f'.{path.name}.new')
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_text(yaml.safe_dump(entry, sort_keys=False), encoding='utf-8')
        if path.is_file() and not _holds(path, set_up):
            date = datetime.fromtimestamp(path.stat().st_mtime, timezone.utc)
            path.replace(path.with_name(f'{path.stem}_{date:%Y%m%dT%H%M%S%fZ}{path.suffix}'))
        temporary.replace(path)
    except OSError as error:
        raise BadInputError(str(path), f'cannot be written: {error.strerror}') from error


def _holds(path: Path, set_up: Mapping[str, float]) -> bool:
    try:
        return load(path) == set_up
    except BadInputError:  # changed by hand, or of another version
        return False


def load(path: Path) -> dict[str, float]:
    """The values of such a file. Raises BadInputError with file, name and value."""
    try:
        entry = yaml.safe_load(path.read_text(encoding='utf-8'))
        stored = dict(entry['set_up'])
    except (OSError, ValueError, TypeError, KeyError, yaml.YAMLError) as error:
        raise BadInputError(str(path), f'is no file of setup ({type(error).__name__})') from error
    for name, value in stored.items():
        low, high = (ROWS[name].limits or (1.0, 0.0)) if name in NAMES else (1.0, 0.0)
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not number or not low <= value <= high:
            raise BadInputError(f'{path}: {name}', 'is no value of a set-up', repr(value))
    return {name: float(np.float32(value)) for name, value in stored.items()}


def _ask(words: str) -> str:
    try:
        return input(words)
    except EOFError as error:
        raise BadInputError('the terminal', 'has ended before the last question') from error


class _Line:
    """The port's bytes, for `Talk.wait`."""

    def __init__(self, port: str, baud: int) -> None:
        self._came, self._lock = bytearray(), threading.Lock()
        self._name, self._port = port, SerialPort(port, baud, self._hear)
        self._port.start()

    def _hear(self, data: bytes) -> None:
        with self._lock:
            self._came += data

    def wait(self, talk: Talk, seconds: float) -> None:
        """Move bytes for so long. Raises BadInputError where the port cannot be opened."""
        until_s = time.monotonic() + seconds
        while True:
            with self._lock:
                data, self._came = bytes(self._came), bytearray()
            talk.take(data)
            out = talk.to_send()
            if out:
                self._port.write(out)
            if self._port.status.refused:
                raise BadInputError(f'--port {self._name}', self._port.status.refused)
            remaining_s = until_s - time.monotonic()
            if remaining_s <= 0.0:
                return
            time.sleep(min(0.01, remaining_s))

    def close(self) -> None:
        """End the port's thread."""
        self._port.stop()


def main(argv: Sequence[str] | None = None) -> int:
    """Run the wizard; 0 where it was written or nothing had to be, 2 on bad input."""
    parser = OneLineParser(
        prog='setup', description='Sets an aircraft up: measures, asks, writes its parameters.',
        epilog='Example: ros2 run quad_bridge setup --port /dev/ttyAMA0 receiver board',
    )  # fmt: skip
    parser.add_argument('only', nargs='*', metavar='STEP',
                        help='receiver, motors, board, compass, battery, outputs; default: each')
    parser.add_argument('--port', default='/dev/ttyACM0',
                        help="as the bridge's parameter port; default %(default)s")
    parser.add_argument('--baud', type=int, default=921600,
                        help='baud rate of a serial line; default %(default)s')
    parser.add_argument('--key', type=Path, metavar='FILE', help='where the firmware has one')
    parser.add_argument('--folder', type=Path, default=None,
                        help="folder of the aircraft's files; default: the bridge's state_folder")
    parser.add_argument('--restore', type=Path, metavar='FILE',
                        help='write the values of this setup.yaml instead of measuring')
    args = parser.parse_args(argv)
    steps = ('receiver', 'motors', 'board', 'compass', 'battery', 'outputs')
    for name in args.only:
        if name not in steps:
            parser.error(f'no step {name!r}: known are {", ".join(steps)}')
    # as by Ctrl-C where the terminal or its ssh is gone: what was written is saved
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) != signal.SIG_IGN:  # as under nohup
            signal.signal(number, signal.default_int_handler)
    return ended_in_one_line('setup', lambda: _set_up(args))


def _set_up(args: argparse.Namespace) -> int:
    restored = load(args.restore) if args.restore is not None else None
    if over_network(args.port) and args.key is None:
        raise BadInputError('--key', 'is required where the port leads to another computer',
                            args.port, "run setup on the aircraft's own computer, or make a key")
    line = _Line(args.port, args.baud)
    talk = Talk(line.wait, time.monotonic, signing_from(args.key))
    with contextlib.closing(line):
        talk.read()
        path, read = (args.folder or default_folder()) / talk.aircraft / FILE, talk.stored
        try:
            if restored is None:
                Wizard(talk, _ask, lambda text: say(f'{text}\n')).run(args.only)
            else:
                say(f'{len(written(talk, restored))} values written\n')
        finally:  # also of a wizard that ends half-way: its steps are in the aircraft already
            if talk.stored is not read or not path.is_file():
                save(path, talk.aircraft, talk.stored)
        say(f'{path}\n')
    return 0
