"""Gains and filters of a blackbox header → the contract's gains of each axis. No files.

Scales as in the firmwares' sources: Betaflight (3.1 to 2026.12) src/main/flight/pid.h PTERM_SCALE,
ITERM_SCALE, DTERM_SCALE, FEEDFORWARD_SCALE, pid_init.c (yaw's I times 2.5, level P over 10),
mixer.h PID_MIXER_SCALING; INAV (2 to 8) src/main/flight/pid.h FP_PID_RATE_*_MULTIPLIER. Numbers of
the adjustments in flight: src/main/fc/rc_adjustments.h of both.

What has no counterpart is left out: RPM and dynamic notches, I-term relax, anti-gravity, throttle
boost, thrust linearisation, and of D_max the part that grows with the stick.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from quad_sysid.contract import AXES
from quad_sysid.record import GainChange

DEGREES = math.degrees(1.0)
BETAFLIGHT, INAV = (0.032029, 0.244381, 0.000529), (1 / 31.0, 1 / 4.0, 1 / 1905.0)
"""Weights of the CLI's P, I and D: part of the sum per deg/s, deg and deg/s² (pid.h, pid.c)."""
FEEDFORWARD = 0.013754
"""Weight of Betaflight's feedforward: part of the sum per deg/s² of the set-point."""
BETAFLIGHT_LEVEL, INAV_LEVEL = 0.1, 1 / 6.56
"""Angle gain, 1/s, per unit of P of the level mode."""
YAW_I, FIRST_STEEPER = 2.5, 4
"""Factor of Betaflight's I on the yaw axis, and the first version that has it."""
YAW_FACTOR = 'yaw.rate.ki_factor'
"""That factor in a log, beside the gains."""
VERSION = re.compile(r'betaflight (\d+)\.', re.IGNORECASE)
PIDSUM = 1000.0
"""Sum of P, I and D that is the whole range of the motors; of INAV it is that range in µs."""
RANGE_US = 'motors.range_us'
"""That range of INAV's motors, beside the gains."""
DELAYS = {0: 1.0, 1: math.sqrt(2.0), 2: 2 / 1.553773974, 3: 3 / 1.961459177}
"""By the type of a filter (PT1, biquad, PT2, PT3), its delay times 2 pi times its cut-off."""
ADJUSTED = {'betaflight': {6: 'roll pitch', 9: 'yaw', 15: 'pitch', 18: 'roll'},
            'inav': {6: 'roll pitch', 10: 'pitch', 14: 'roll', 18: 'yaw'}}
"""Number of an adjustment of P → axes; I and D follow it."""


@dataclass(frozen=True)
class Adjustment:
    """A gain that was changed in flight."""

    time_s: float
    function: int
    value: float


@dataclass(frozen=True)
class Tuning:
    """A header's gains by the contract's names, and how they were converted."""

    gains: dict[str, float]
    how: str


def firmware_of(header: Mapping[str, str]) -> str:
    """`betaflight` or `inav`; '' for firmware whose scales are not known."""
    text = ' '.join(str(header.get(name, '')) for name in (
        'Firmware revision', 'Firmware type', 'firmwareType', 'firmware')).lower()
    if 'inav' in text:
        return 'inav'
    others = ('indiflight', 'rotorflight', 'emuflight', 'quicksilver')
    return '' if any(name in text for name in others) else (
        'betaflight' if 'betaflight' in text or 'cleanflight' in text else '')


def tuning(header: Mapping[str, str], throttle: float | None, motor_us: float = PIDSUM) -> Tuning:
    """The gains at the flight's usual throttle (0..1), at which TPA acts.

    `motor_us`: the motors' range, µs, of which INAV's sum is a part.
    """
    firmware = firmware_of(header)
    if not firmware or not all(len(numbers(header, f'{axis}PID')) > 2 for axis in AXES):
        return Tuning({}, '')
    inav = firmware == 'inav'
    scale = DEGREES / (motor_us if inav else PIDSUM)
    on_p, on_d = _attenuation(header, throttle, inav=inav)
    cutoff = _cutoff(header, ('dterm_lpf1', 'dterm_lowpass', 'dterm_lpf', 'dterm_filter'),
                     ('dterm_lpf2', 'dterm_lowpass2', 'dterm_filter2'), throttle)
    gains: dict[str, float] = {}
    for axis in AXES:
        row = _of_axis(header, axis, scale, inav=inav)
        tpa = 1.0 if inav and axis == 'yaw' else on_p
        row |= {'kp': row['kp'] * tpa, 'kd': row['kd'] * on_d, 'tpa_kp': tpa, 'tpa_kd': on_d}
        if cutoff:
            row['d_filter_hz'] = cutoff
        gains |= {f'{axis}.rate.{name}': value for name, value in row.items()}
    if number(header, 'yaw_lowpass_hz') > 0.0:
        gains['yaw.rate.error_filter_hz'] = number(header, 'yaw_lowpass_hz')
    level = numbers(header, 'levelPID')
    if level:
        for axis in AXES[:2]:
            gains[f'{axis}.angle.kp'] = level[0] * (INAV_LEVEL if inav else BETAFLIGHT_LEVEL)
    delay = _delay(header, ('gyro_lpf1', 'gyro_lowpass', 'gyro_lpf'),
                   ('gyro_lpf2', 'gyro_lowpass2'), throttle)
    if delay > 0.0:
        gains['sensor.gyro_lowpass_delay_s'] = delay
    if inav:
        gains[RANGE_US] = motor_us
    condition = '' if throttle is None else f' at the usual throttle of {throttle:.2f}'
    how = f"{firmware}'s scales; TPA{condition}: P x {on_p:.3g}, D x {on_d:.3g}"
    how += f'; D filters as one of first order with their delay, {cutoff:.3g} Hz' if cutoff else ''
    return Tuning(gains, how)


def _of_axis(header: Mapping[str, str], axis: str, scale: float, *,
             inav: bool) -> dict[str, float]:
    """An axis' gains by their last names, without TPA."""
    i = AXES.index(axis)
    p, integral, d = numbers(header, f'{axis}PID')[:3]
    least = numbers(header, 'd_min')
    if len(least) > i and 0.0 < least[i] < d:
        d = least[i]  # D of a stick that rests; from 2025.12 on that is D itself
    of_p, of_i, of_d = INAV if inav else BETAFLIGHT
    out = {'kp': of_p * p * scale, 'kd': of_d * d * scale, 'ki': of_i * integral * scale}
    if axis == 'yaw' and not inav:
        out['ki_factor'] = YAW_I if _steeper_yaw(header) else 1.0
        out['ki'] *= out['ki_factor']
    forward = numbers(header, 'ff_weight') or numbers(header, 'feedforward_weight')
    if len(forward) > i:
        out['kff_slope'] = FEEDFORWARD * 0.01 * forward[i] * scale
    limit = number(header, 'pidsum_limit_yaw' if axis == 'yaw' else 'pidsum_limit')
    if limit > 0.0:
        out['output_limit'] = limit / PIDSUM
    return out


def _steeper_yaw(header: Mapping[str, str]) -> bool:
    """Whether yaw's I is multiplied: Betaflight from 4.0 on, but for its integrated yaw."""
    version = VERSION.search(str(header.get('Firmware revision', '')))
    return (firmware_of(header) == 'betaflight' and not number(header, 'use_integrated_yaw')
            and version is not None and int(version[1]) >= FIRST_STEEPER)


def changes(header: Mapping[str, str], adjustments: Iterable[Adjustment],
            throttle: float | None, motor_us: float = PIDSUM) -> tuple[GainChange, ...]:
    """The gains after each adjustment in flight, at the times of the adjustments."""
    texts = {name: str(value) for name, value in header.items()}
    out = []
    table = ADJUSTED.get(firmware_of(header), {})
    for change in adjustments:
        first = max((n for n in table if n <= change.function < n + 3), default=0)
        axes, place = table.get(first, '').split(), change.function - first
        for axis in axes:
            values = numbers(texts, f'{axis}PID')
            if len(values) > place:
                values[place] = change.value
                texts[f'{axis}PID'] = ','.join(map(str, values))
        if axes:
            gains = tuning(texts, throttle, motor_us).gains
            if gains:
                out.append(GainChange(change.time_s, gains))
    return tuple(out)


def _attenuation(header: Mapping[str, str], throttle: float | None, *,
                 inav: bool) -> tuple[float, float]:
    """By what TPA multiplies P and D above its breakpoint; Betaflight's mode D leaves P alone."""
    rate, breakpoint_us = number(header, 'tpa_rate'), number(header, 'tpa_breakpoint')
    if throttle is None or not rate > 0.0 or not 1000.0 <= breakpoint_us < 2000.0:
        return 1.0, 1.0
    over = (1000.0 * (1.0 + throttle) - breakpoint_us) / (2000.0 - breakpoint_us)
    factor = 1.0 - 0.01 * min(rate, 100.0) * min(max(over, 0.0), 1.0)
    only_d = not inav and number(header, 'tpa_mode') == 1.0
    return 1.0 if only_d else factor, factor


def _cutoff(header: Mapping[str, str], first: tuple[str, ...], second: tuple[str, ...],
            throttle: float | None) -> float:
    """Cut-off, Hz, of the first-order filter with the delay of both; 0 without any."""
    delay = _delay(header, first, second, throttle)
    return 1.0 / (2.0 * math.pi * delay) if delay > 0.0 else 0.0


def _delay(header: Mapping[str, str], first: tuple[str, ...], second: tuple[str, ...],
           throttle: float | None) -> float:
    """Delay, s, of two low-passes at low frequencies; the first may follow the throttle."""
    total = 0.0
    for names in (first, second):
        hertz = 0.0
        for name in names:
            span = numbers(header, f'{name}_dyn_hz')
            if not hertz and len(span) > 1 and span[0] > 0.0:
                hertz = _dynamic(span[0], span[1], throttle, number(header, f'{name}_dyn_expo'))
            for field in (f'{name}_static_hz', f'{name}_hz'):
                values = numbers(header, field)
                hertz = hertz or (values[0] if values else 0.0)
            if hertz > 0.0:
                kind = next((number(header, f'{n}_type') for n in names if f'{n}_type' in header),
                            0.0)
                total += DELAYS.get(int(kind), 1.0) / (2.0 * math.pi * hertz)
                break
    return total


def _dynamic(low: float, high: float, throttle: float | None, expo: float) -> float:
    """Cut-off that follows the throttle, Hz (dynLpfCutoffFreq of Betaflight's pid.c)."""
    x = 0.0 if throttle is None else throttle
    return low + (high - low) * (x * (1.0 - x) * 0.1 * expo + x)


def numbers(header: Mapping[str, str], name: str) -> list[float]:
    """The numbers of a header's field, with commas between; none where one is no number."""
    try:
        return [float(part) for part in str(header[name]).strip('[] "').split(',')]
    except (KeyError, ValueError):
        return []


def number(header: Mapping[str, str], name: str) -> float:
    """The first number of a header's field; 0 without any."""
    values = numbers(header, name)
    return values[0] if values else 0.0
