"""The check by small pulses of each axis' sign, and of each motor's signs. Pure.

A pulse is a doublet added to U2..U4, once each way round; the rates' answers are compared with
what the craft's mixer and axes promise. A wrong sign refuses every update; an axis that never
answered refuses its own gains. The record is plain data, kept by history.py.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from quad_bridge.craft import AXES, Craft, X
from quad_bridge.errors import RefusedError
from quad_bridge.si import FloatArray
from quad_bridge.wire.axes import flip_body
from quad_bridge.wire.frames import Cycle, Flag, Injection, Vector3

Signs = dict[str, dict[str, int]]  # motor channel to axis to the sign of its answer

QUIET_S, HALF_S, REST_S = 0.16, 0.12, 0.36
LISTEN_S = (0.04, 0.18)  # the answer after the doublet's start, before its second half acts
MIN_RAD_S, MIN_SIGMAS = 0.015, 5.0  # an answer is larger than both
PULSE_VALID_MS = 60
GRACE_S = 0.24  # in which the STM32 may still report a refusal of something older
MODES = ('auto', 'manual', 'off')
"""Pulses before the first update of an axis by itself; only when asked for; never."""
MEND = "correct the motors' order and spin or the gyro's axes, then call"
NONE: Vector3 = (0.0, 0.0, 0.0)


class Pulse(NamedTuple):
    """A direction in (U2, U3, U4) and the half-amplitudes to try, normalised command."""

    direction: Vector3
    levels: tuple[float, ...]
    watched: tuple[int, ...]  # axes whose answer ends the tries


FLOWN = 4  # motors of the firmware
MOTOR_CHANNELS = tuple(f'motor_{k}' for k in range(1, FLOWN + 1))


def pulses_of(craft: Craft) -> dict[str, Pulse]:
    """A pulse for each axis, and one that pushes each motor of this craft alone."""
    pushes = craft.inverse[1:] / np.abs(craft.inverse[1:]).max()
    return {
        'roll': Pulse((1.0, 0.0, 0.0), (0.012, 0.04), (0,)),
        'pitch': Pulse((0.0, 1.0, 0.0), (0.012, 0.04), (1,)),
        'yaw': Pulse((0.0, 0.0, 1.0), (0.03, 0.08), (2,)),
        **{name: Pulse((float(x), float(y), float(z)), (0.012, 0.03), (0, 1, 2))
           for name, (x, y, z) in zip(MOTOR_CHANNELS, pushes.T, strict=True)},
    }  # fmt: skip


class PulseRun:
    """Plays pulses cycle by cycle and collects the responses, (3,) rad/s of rate per pulse."""

    def __init__(self, names: Sequence[str], rate_hz: float, craft: Craft = X) -> None:
        self._remaining, self._level = list(names), 0
        self.craft, self._pulses = craft, pulses_of(craft)
        self._rate_hz = rate_hz
        self._samples: list[Vector3] = []
        self._length = round((QUIET_S + 2 * HALF_S + REST_S) * rate_hz)
        self.answers: dict[str, FloatArray] = {}  # 0 where an axis did not answer

    @property
    def finished(self) -> bool:
        """Whether all pulses are done."""
        return not self._remaining

    def step(self, rates: Vector3) -> Vector3:
        """Take the rates of one cycle; returns the addition to U2..U4 in the next."""
        if self.finished:
            return NONE
        self._samples.append(rates)
        pulse = self._pulses[self._remaining[0]]
        size = pulse.levels[self._level] * self._shape(len(self._samples))
        if len(self._samples) == 2 * self._length:
            self._judge(pulse)
        x, y, z = pulse.direction
        return (size * x, size * y, size * z)

    def _shape(self, sample: int) -> float:
        """+ -, then after a rest - +."""
        second, k = divmod(sample, self._length)
        sign = 1.0 if second == 0 else -1.0
        t = k / self._rate_hz - QUIET_S
        if 0.0 <= t < HALF_S:
            return sign
        return -sign if HALF_S <= t < 2 * HALF_S else 0.0

    def _judge(self, pulse: Pulse) -> None:
        rates = np.array(self._samples).reshape(2, self._length, 3)
        self._samples = []
        quiet = rates[:, : round(QUIET_S * self._rate_hz)]
        first, last = (round((QUIET_S + t) * self._rate_hz) for t in LISTEN_S)
        change = rates[:, first:last].mean(axis=1) - quiet.mean(axis=1)
        change[1] *= -1.0
        spread = quiet.std(axis=1).mean(axis=0)
        least = np.maximum(MIN_RAD_S, MIN_SIGMAS * spread / math.sqrt(last - first))
        agree = np.sign(change[0]) == np.sign(change[1])
        responds = agree & (np.abs(change) > least).all(axis=0)
        self.answers[self._remaining[0]] = np.where(responds, change.mean(axis=0), 0.0)
        self._level += 1
        if self._level == len(pulse.levels) or responds[list(pulse.watched)].any():
            self._remaining.pop(0)
            self._level = 0


def judge_axes(answers: Mapping[str, FloatArray]) -> dict[str, str]:
    """Axis → `right`, `wrong`, `crossed` (another axis responds more) or `silent`."""
    verdicts = {}
    for i, axis in enumerate(AXES):
        if axis not in answers:
            continue
        answer = float(answers[axis][i])
        foreign = float(np.abs(np.delete(answers[axis], i)).max())
        verdicts[axis] = 'right' if answer > 0.0 else 'wrong'
        if foreign > abs(answer):
            verdicts[axis] = 'crossed'
        elif answer == 0.0:
            verdicts[axis] = 'silent'
    return verdicts


def merge_motors(
    known: Mapping[str, Mapping[str, int]], answers: Mapping[str, FloatArray]
) -> Signs:
    """Signs per motor channel and axis: those of this run over those of earlier mounts.

    In a run of four channels an axis counts only where at least three of them moved it.
    """
    rows = {name: answers[name] for name in answers if name in MOTOR_CHANNELS}
    counted = [i for i in range(3) if sum(row[i] != 0.0 for row in rows.values()) >= 3]
    merged = {name: dict(signs) for name, signs in known.items()}
    for name, row in rows.items():
        for i in counted:
            if row[i] != 0.0:
                merged.setdefault(name, {})[AXES[i]] = int(np.sign(row[i]))
    return merged


class Push(NamedTuple):
    """Excitation to add now."""

    value: Vector3  # FLU
    injection: Injection


class PolarityCheck:
    """The check of motors and signs before a flight: its record, its rule and its run."""

    def __init__(self, mode: str, rate_hz: float = 250.0) -> None:
        """`rate_hz`: control cycles per second, of the next run."""
        self._mode, self.rate_hz = mode, rate_hz
        self.craft = X
        """Where the motors have to be; one of FLOWN motors."""
        self._run: PulseRun | None = None
        self._axes: dict[str, str] = {}
        self._motors: Signs = {}
        self._cycles = 0
        self.trouble = ''  # why the last run ended without a result

    @property
    def running(self) -> bool:
        """Whether pulses are being flown."""
        return self._run is not None

    @property
    def record(self) -> dict[str, Any]:
        """The record for the disk."""
        return {'axes': dict(self._axes), 'motors': {k: dict(v) for k, v in self._motors.items()}}

    def load(self, record: Mapping[str, Any]) -> None:
        """Use the stored record of this aircraft; invalid parts are ignored."""
        if self.running:
            self.abort('stopped: the record of this aircraft was read only now')
        axes, motors = record.get('axes'), record.get('motors')
        axes = axes if isinstance(axes, dict) else {}
        rows = motors.items() if isinstance(motors, dict) else ()
        self._axes = {a: str(v) for a, v in axes.items() if a in AXES}
        self._motors = {
            str(m): {a: int(s) for a, s in row.items() if a in AXES and s in (-1, 1)}
            for m, row in rows
            if isinstance(row, dict)
        }

    def faults(self) -> list[str]:
        """The aircraft's faults in words."""
        words = {
            'wrong': '{} responds with the wrong sign',
            'crossed': 'a pulse on {} moves another axis more',
        }
        faults = [words[v].format(a) for a, v in self._axes.items() if v in words]
        return faults + self.craft.where_motors_are(self._motors)[1]

    def refuse_faults(self) -> None:
        """Raise RefusedError where something is wrong, with the check that clears it."""
        faults, motors = self.faults(), self.craft.where_motors_are(self._motors)[1]
        if faults and self._mode != 'off':
            due = {'~/check_polarity': len(faults) > len(motors), '~/find_motors': bool(motors)}
            calls = ' and '.join(call for call in due if due[call])
            raise RefusedError(f'{"; ".join(faults)}: {MEND} {calls}')

    def unchecked(self, names: Iterable[str]) -> list[str]:
        """Axes whose pulses must be flown before these gains."""
        touched = {name.partition('.')[0] for name in names} if self._mode != 'off' else set()
        return [a for a in AXES if a in touched and self._axes.get(a) != 'right']

    def start(self, axes: Sequence[str]) -> None:
        """Begin with pulses about these axes; with none, of one motor channel after the other."""
        self._run = PulseRun(axes or MOTOR_CHANNELS, self.rate_hz, self.craft)
        self._cycles, self.trouble = 0, ''

    def abort(self, trouble: str) -> None:
        """Stop the pulses without a result."""
        self._run, self.trouble = None, trouble

    def step(self, frame: Cycle) -> Push:
        """Take one cycle of the check; what to send. Afterwards `running` says whether it goes on.

        `trouble` is why it ended without a result, empty where it has one.
        """
        self._cycles += 1
        refused = frame.flags & Flag.EXCITATION_REFUSED and self._cycles > GRACE_S * self.rate_hz
        if not frame.flags & Flag.ARMED or refused or frame.flags & Flag.RC_FAILSAFE:
            self.abort('stopped: disarmed, in failsafe, or the STM32 refuses the pulses')
        if self._run is not None and self._run.craft != self.craft:
            self.abort('stopped: another craft has been described')
        added, injection = NONE, Injection.NONE
        if self._run is not None:
            added, injection = self._run.step(flip_body(frame.gyro)), Injection.CONTROL
            if self._cycles == 1:  # which ends what was refused before
                injection = Injection.NONE
            if self._run.finished:
                self._axes.update(judge_axes(self._run.answers))
                self._motors = merge_motors(self._motors, self._run.answers)
                self._run, added, injection = None, NONE, Injection.NONE
        return Push(added, injection)

    def words(self) -> str:
        """The results in one line."""
        said = {'right': 'correct', 'silent': 'does not respond'}  # right is also a direction
        parts = [f'{axis} {said.get(verdict, verdict)}' for axis, verdict in self._axes.items()]
        if self._motors:
            places, _ = self.craft.where_motors_are(self._motors)
            parts += [f'{motor} {place}' for motor, place in places.items()]
        return '; '.join([*parts, *self.faults()]) or 'nothing has been checked'
