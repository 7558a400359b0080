"""The wizard's line to the firmware: what it shows now, a set that is written, a motor. No I/O.

`wait` moves the bytes: `take` what has come, `to_send` what goes out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np

from quad_bridge.aircraft import ACCEPTED, outcome_of
from quad_bridge.errors import RefusedError
from quad_bridge.gains.protocol import GainProtocol, What
from quad_bridge.gains.table import SET_UP, WIRE_NAMES
from quad_bridge.motor_test import COMMAND, VALID_S, frame
from quad_bridge.si import FloatArray
from quad_bridge.wire import Decoder, Encoder
from quad_bridge.wire import frames as f
from quad_bridge.wire.signing import Signing

CHANNELS = 9  # of a receiver; the raw ones follow the corrected ones
READ_S, WRITE_S, STEP_S = 10.0, 10.0, 0.05  # longest for all values, and between looks
REST_S = 1.5  # over it the specific force of a position is averaged
MIN_CYCLES = 10  # of them
STILL_RAD_S = 0.15  # range of the rates over REST_S: a hand that holds it still stays below
STEADY_M_S2 = 1.0  # between the halves of REST_S: a steady turn of 0.14 rad/s has no such range


class Talk:
    """One conversation. Times in s; `wait(seconds)` lets so much pass on the line."""

    def __init__(
        self, wait: Callable[[Talk, float], None], now_s: Callable[[], float],
        signing: Signing | None = None,
    ) -> None:  # fmt: skip
        self._wait, self._now_s = wait, now_s
        self._decoder, self._encoder = Decoder(signing, own=(1, 191)), Encoder(1, 191, signing)
        self._protocol = GainProtocol()
        self._queue: list[f.Frame] = []
        self._acks: list[int] = []
        self.texts: list[str] = []
        self.stored: Mapping[str, float] = {}
        """All parameters as they were last read back, also where a later write failed."""
        self.cycle: f.Cycle | None = None
        self.channels: tuple[int, ...] = ()
        self.failsafe = True
        self.volts = math.nan
        self._forces: list[f.Vector3] = []
        self._rates: list[f.Vector3] = []
        self._fields: list[f.Vector3] = []

    # The line.

    def take(self, data: bytes) -> None:
        """Take what has come."""
        for frame_ in self._decoder.feed(data):
            self._take(frame_)

    def _take(self, came: f.Frame) -> None:
        if isinstance(came, f.Cycle):
            self.cycle = came
            self._forces.append(came.accel)
            self._rates.append(came.gyro)
        elif isinstance(came, f.RcChannels):
            self.channels, self.failsafe = came.channels, came.rssi == 0
        elif isinstance(came, f.SlowSensors):
            if came.mag_gauss is not None:
                self._fields.append(came.mag_gauss)
        elif isinstance(came, f.Battery):
            self.volts = came.voltage_v
        elif isinstance(came, f.ParamValue | f.GainsState):
            self._protocol.take(came, self._now_s())
        elif isinstance(came, f.CommandAck):
            if came.command == COMMAND:
                self._acks.append(came.result)
        elif isinstance(came, f.StatusText):
            self.texts.append(came.text)

    def to_send(self) -> bytes:
        """The bytes to send now."""
        request = self._protocol.poll(self._now_s())
        frames, self._queue = [*self._queue, *([request] if request is not None else [])], []
        return b''.join(self._encoder.encode(frame) for frame in frames)

    def wait(self, seconds: float) -> None:
        """Let so much time pass on the line."""
        self._wait(self, seconds)

    # Requests of the wizard.

    @property
    def aircraft(self) -> str:
        """The firmware's unique number; '' before it is heard."""
        return self._protocol.aircraft

    @property
    def values(self) -> Mapping[str, float]:
        """All parameters in force by the contract's names; {} before they are read."""
        return self._protocol.active

    def read(self) -> None:
        """Wait for the firmware and its parameters. Raises RefusedError."""
        self._until(lambda: bool(self.values) and self.cycle is not None, READ_S,
                    lambda: f'no firmware with QUAD_GAINS answers: {self._remedy()}')
        missing = [row.name for row in SET_UP if row.name not in self.values]
        if missing:
            raise RefusedError(f'{missing[0]}: this firmware does not know it; flash a newer one')
        self.stored = self.values

    @property
    def armed(self) -> bool:
        """Whether its last control cycle was armed."""
        return self.cycle is not None and bool(self.cycle.flags & f.Flag.ARMED)

    def write(self, values: Mapping[str, float]) -> None:
        """Write a set, read it back, keep it. Raises RefusedError where that fails."""
        self._protocol.events.clear()
        self._protocol.write({WIRE_NAMES[name]: value for name, value in values.items()}, 0)
        for expected in (What.COMMITTED, What.CONFIRMED):
            self._until(lambda: bool(self._protocol.events), WRITE_S,
                        lambda: 'no answer to the set')
            event = self._protocol.events.pop(0)
            if event.what is not expected:
                remedy = '; it is armed: disarm it first' if self.armed else ''
                raise RefusedError(f'not written: {event.reason or event.what.value}{remedy}')
            if expected is What.COMMITTED:
                self._protocol.confirm()
        self.stored = self.values

    def pulses(self) -> tuple[float, ...]:
        """The receiver's pulses as they come, µs, by its own channels."""
        self.wait(0.3)
        if self.failsafe:
            raise RefusedError('the receiver hears no transmitter: switch it on')
        raw = self.channels[CHANNELS : 2 * CHANNELS]
        if len(raw) < CHANNELS:
            raise RefusedError('this firmware does not send its raw channels: flash a newer one')
        return tuple(float(pulse) for pulse in raw)

    def force(self) -> FloatArray:
        """(3,) mean specific force, body. Raises RefusedError where it moves."""
        self.wait(0.5)
        self._forces, self._rates = [], []
        self.wait(REST_S)
        if len(self._forces) < MIN_CYCLES:
            raise RefusedError('no control cycles are received')
        forces, half = np.array(self._forces), len(self._forces) // 2
        change = np.linalg.norm(forces[:half].mean(axis=0) - forces[half:].mean(axis=0))
        if np.ptp(np.array(self._rates), axis=0).max() > STILL_RAD_S or change > STEADY_M_S2:
            raise RefusedError('it moved: hold it still')
        mean: FloatArray = forces.mean(axis=0)
        return mean

    def fields(self, seconds: float) -> FloatArray:
        """(n, 3) of the compass, gauss, body."""
        self._fields = []
        self.wait(seconds)
        return np.array(self._fields).reshape(-1, 3)

    def spin(self, motor: int, throttle: float, seconds: float) -> None:
        """Spin a motor for so long. Raises RefusedError where the firmware will not."""
        self._acks = []
        for _ in range(max(1, round(seconds / (0.5 * VALID_S)))):
            self._queue.append(frame(motor, throttle))
            self.wait(0.5 * VALID_S)
            words = [outcome_of(result) for result in self._acks]
            if any(word != ACCEPTED for word in words):
                raise RefusedError(f'the firmware says {words[-1]}: disarmed, at rest for 2 s, '
                                   'transmitter on, throttle down, kill switch off, the set-up '
                                   'without a fault')  # fmt: skip
        self._queue.append(frame(motor, 0.0))
        self.wait(STEP_S)
        if not self._acks:
            raise RefusedError('no answer to MAV_CMD_DO_MOTOR_TEST')

    def _until(self, done: Callable[[], bool], seconds: float, words: Callable[[], str]) -> None:
        remaining = round(seconds / STEP_S)
        while not done() and remaining > 0:
            self.wait(STEP_S)
            remaining -= 1
        if not done():
            raise RefusedError(words())

    def _remedy(self) -> str:
        counts = self._decoder.counts
        if counts.unverified or counts.forged:
            return 'it signs its frames, and answers only who has its key: give that by --key'
        if counts.unsigned:
            return 'it does not sign: give it the key, or leave --key out'
        return 'check port, baud and power'
