"""What is known of an aircraft's polarity and motor order, and the check under way. Pure.

A wrong sign refuses every update; an axis that never answered refuses its own gains. The record is
plain data, kept per aircraft by aircraft_store.py; the pulses are polarity.py's.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from quad_bridge.errors import RefusedError
from quad_bridge.polarity import (
    AXES,
    PulseRun,
    axis_pulses,
    judge_axes,
    merge_motors,
    motor_pulses,
    where_motors_are,
)
from quad_bridge.wire.axes import flip_body
from quad_bridge.wire.frames import Cycle, Excitation, Flag, Injection, Vector3

PULSE_VALID_MS = 60
GRACE_CYCLES = 60
"""In which the STM32 may still report a refusal of something older."""
MODES = ('auto', 'manual', 'off')
"""Pulses before the first update of an axis by itself; only when asked for; never."""
MEND = "mend the motors' order and spin or the gyro's axes, then call ~/check_polarity"


class PolarityCheck:
    """The record, the rule, and the run."""

    def __init__(self, mode: str, rate_hz: float = 250.0) -> None:
        self._mode, self._rate_hz = mode, rate_hz
        self._run: PulseRun | None = None
        self._axes: dict[str, str] = {}
        self._motors: dict[str, dict[str, int]] = {}
        self._cycles = 0
        self.trouble = ''
        """Why the last run ended without a result."""

    @property
    def running(self) -> bool:
        """Whether pulses are being flown."""
        return self._run is not None

    @property
    def record(self) -> dict[str, Any]:
        """What is to be kept on disk."""
        return {'axes': dict(self._axes), 'motors': {k: dict(v) for k, v in self._motors.items()}}

    def load(self, record: Mapping[str, Any]) -> None:
        """Take over what was kept of this aircraft; what does not fit counts as not there."""
        self._run = None
        axes, motors = record.get('axes'), record.get('motors')
        self._axes = {}
        if isinstance(axes, dict):
            self._axes = {a: str(v) for a, v in axes.items() if a in AXES}
        self._motors = {}
        if isinstance(motors, dict):
            self._motors = {
                str(m): {a: int(s) for a, s in row.items() if a in AXES and s in (-1, 1)}
                for m, row in motors.items()
                if isinstance(row, dict)
            }

    def faults(self) -> list[str]:
        """What is wrong with the aircraft, each in words."""
        found = [f'{a} answers with the wrong sign' for a, v in self._axes.items() if v == 'wrong']
        found += [f'a pulse on {a} moves another axis more' for a in self._crossed()]
        return found + where_motors_are(self._motors)[1]

    def missing(self, names: Iterable[str]) -> list[str]:
        """Axes whose pulses must be flown before these gains; raises RefusedError."""
        if self._mode == 'off':
            return []
        faults = self.faults()
        if faults:
            raise RefusedError(f'{"; ".join(faults)}: {MEND}')
        touched = {name.partition('.')[0] for name in names}
        open_axes = [a for a in AXES if a in touched and self._axes.get(a) != 'right']
        if open_axes and self._mode == 'manual':
            raise RefusedError(
                f'the polarity of {", ".join(open_axes)} has not been checked on this aircraft: '
                'mount it free about that axis, arm it and call ~/check_polarity'
            )
        return open_axes

    def start(self, axes: Sequence[str]) -> None:
        """Begin with pulses about these axes; with none, of one motor channel after the other."""
        self._run = PulseRun(axis_pulses(axes) if axes else motor_pulses(), self._rate_hz)
        self._cycles, self.trouble = 0, ''

    def abort(self, trouble: str) -> None:
        """Stop the pulses; nothing is learned."""
        self._run, self.trouble = None, trouble

    def step(self, frame: Cycle) -> Excitation:
        """Take one cycle of the check; what to send. Afterwards `running` says whether it goes on.

        `trouble` is why it ended without a result, empty where it has one.
        """
        self._cycles += 1
        refused = frame.flags & Flag.EXCITATION_REFUSED and self._cycles > GRACE_CYCLES
        if not frame.flags & Flag.ARMED or refused or frame.flags & Flag.RC_FAILSAFE:
            self.abort('stopped: disarmed, in failsafe, or the STM32 refuses the pulses')
        if self._run is None:
            return self._pulse((0.0, 0.0, 0.0), Injection.NONE)
        added = self._run.step(flip_body(frame.gyro))
        if not self._run.finished:
            return self._pulse(added, Injection.CONTROL)
        self._axes.update(judge_axes(self._run.answers))
        self._motors = merge_motors(self._motors, self._run.answers)
        self._run = None
        return self._pulse((0.0, 0.0, 0.0), Injection.NONE)

    def _pulse(self, flu: Vector3, injection: Injection) -> Excitation:
        return Excitation(flip_body(flu), int(injection), self._cycles % 256, PULSE_VALID_MS)

    def words(self) -> str:
        """What is known, in one line."""
        parts = [f'{axis} {verdict}' for axis, verdict in self._axes.items()]
        if self._motors:
            places, _ = where_motors_are(self._motors)
            parts += [f'{motor} {place}' for motor, place in places.items()]
        faults = self.faults()
        return '; '.join([*parts, *faults]) or 'nothing has been checked'

    def silent(self, axes: Iterable[str]) -> list[str]:
        """Those of the axes that did not answer."""
        return [axis for axis in axes if self._axes.get(axis) == 'silent']

    def _crossed(self) -> list[str]:
        return [axis for axis, verdict in self._axes.items() if verdict == 'crossed']
