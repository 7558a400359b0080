"""The excitations that are compared: what the node can fly, within its limits.

Signals, bands and amplitudes stand here as one table; to try another is to add a row.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

from quad_sysid.separation.flight import Excitation
from quad_sysid.signals.schedule import AMPLITUDES, Part
from quad_sysid.signals.waveforms import waveform

PLAIN_DEG = 12.0
"""Amplitude of the plain PRBS, the excitation node's default."""
PLAIN = {'clock_s': 0.092, 'register_bits': 9, 'seed': 1}
"""design-excitation --band 0.1:20."""

Row = tuple[str, Mapping[str, float], tuple[float, ...]]

ATTITUDE: tuple[Row, ...] = (
    ('prbs', PLAIN, (6.0, 12.0, 18.0)),
    ('prbs', {'clock_s': 0.032, 'register_bits': 9, 'seed': 1}, (12.0, 20.0)),
    ('prbs', {'clock_s': 0.4, 'register_bits': 7, 'seed': 1}, (4.0, 12.0, 18.0)),
    ('square', {'period_s': 1.0}, (6.0, 18.0)),
    ('square', {'period_s': 3.0}, (4.0, 12.0, 18.0)),
    ('square', {'period_s': 8.0}, (4.0, 12.0, 18.0)),
    ('multisine', {'f0_hz': 0.1, 'f1_hz': 1.0, 'period_s': 20.0}, (6.0, 20.0)),
    ('multisine', {'f0_hz': 0.1, 'f1_hz': 4.0, 'period_s': 20.0}, (6.0, 20.0)),
    ('chirp', {'f0_hz': 0.05, 'f1_hz': 1.0, 'sweep_s': 20.0}, (12.0, 20.0)),
    ('chirp', {'f0_hz': 0.2, 'f1_hz': 8.0, 'sweep_s': 20.0}, (12.0, 20.0)),
    ('3211', {'unit_s': 0.3}, (12.0,)),
)
"""Degrees on the attitude set-point."""
SLOW: tuple[Row, ...] = (
    ('multisine', {'f0_hz': 0.1, 'f1_hz': 0.1, 'period_s': 10.0}, (4.0, 20.0)),
    ('multisine', {'f0_hz': 0.05, 'f1_hz': 0.05, 'period_s': 20.0}, (20.0,)),
)
"""The same; a multisine of one line is a slow sine. One line tells no model, so a plain PRBS goes
before, over BEFORE of the time."""
BEFORE = 1.0 / 3.0
CONTROL: tuple[Row, ...] = (
    ('prbs', {'clock_s': 0.02, 'register_bits': 9, 'seed': 1}, (0.02, 0.05)),
    ('prbs', {'clock_s': 0.06, 'register_bits': 9, 'seed': 1}, (0.02, 0.05)),
    ('chirp', {'f0_hz': 0.5, 'f1_hz': 15.0, 'sweep_s': 20.0}, (0.02, 0.05)),
)
"""Normalised command behind C2, where the loop does not hold fast signals back."""

THROTTLE = {'throttle', 'battery', 'motors'}
OTHERS = {'other command', 'other rate', 'product of other rates', 'motors'}


def plain(axis: str, seconds: float) -> Excitation:
    """The PRBS that is flown where nobody asks for more."""
    return Excitation(_part('attitude', 'prbs', PLAIN, PLAIN_DEG, axis, seconds))


def with_pilot(usual: Excitation, signals: set[str]) -> Iterator[Excitation]:
    """What the pilot may add where the rivals' signals ask for it, the simplest first."""
    steps, stirs = bool(signals & THROTTLE), bool(signals & OTHERS)
    for throttle, others in ((True, False), (False, True), (True, True)):
        if throttle <= steps and others <= stirs:
            yield replace(usual, throttle_steps=throttle, others_move=others)


def family(axis: str, seconds: float, pilot: Excitation) -> Iterator[Excitation]:
    """Every candidate but the plain PRBS with the same `pilot`, who does as in that flight."""
    for kind, rows in (('attitude', ATTITUDE), ('control', CONTROL), ('slow', SLOW)):
        slow = kind == 'slow'
        before = plain(axis, BEFORE * seconds).part if slow else None
        rest = (1.0 - BEFORE) * seconds if slow else seconds
        injection = 'attitude' if slow else kind
        for signal, parameters, amplitudes in rows:
            for amplitude in amplitudes:
                part = _part(injection, signal, parameters, amplitude, axis, rest)
                if part != pilot.part:
                    yield replace(pilot, part=part, before=before)


def _part(
    injection: str, signal: str, parameters: Mapping[str, float], amplitude: float, axis: str,
    seconds: float,
) -> Part:
    shape = waveform(signal, dict(parameters), 'design-excitation')
    unit = AMPLITUDES[injection][1]
    return Part(
        'train', seconds, signal, axis, injection, amplitude=unit * amplitude,
        parameters=dict(parameters), waveform=shape,
    )
