"""From a band of interest to test signals, by eqs. (9) and (10) of the paper.

Pure: gives a frozen Design, which explains itself in text and writes itself as a schedule.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from quad_sysid.errors import BadInputError
from quad_sysid.signals.guard import Limits
from quad_sysid.signals.schedule import AMPLITUDES, MAX_DURATION_S, RAMP_S
from quad_sysid.signals.waveforms import TAPS

PERIODS = (3.0, 5.0)
"""Eq. (9): N * clock = 3 to 5 of the longest time constant."""
SAMPLES_PER_CLOCK = 2
"""Least number of samples for which a bit is held."""
LEAST_TRAIN_S, FIT_S = 10.0, 5.0
"""Shortest training that is proposed, and that of which anything can be fitted, s."""
LONGEST_SQUARE_S = 8.0
"""Longest square wave: two periods of it in its segment."""
MAX_PERIOD_S = 120.0
"""Length of the training, s, up to which a whole period is flown unless a length is asked for."""
TURN = 0.3 * 2.0 * math.pi
"""HIGH, rad/s, times the clock, s: eq. (10) of the paper, 0.3 / clock = 1 / (2 pi tau_min)."""
SPARED = 0.63
"""Share of the training that holds a period of each frequency that the monitor counts."""


@dataclass(frozen=True)
class Design:
    """An excitation for one band. Times in s, frequencies in rad/s."""

    low_rad_s: float
    high_rad_s: float
    sample_rate_hz: float
    clock_samples: int
    register_bits: int
    validation_bits: int
    square_period_s: float
    unit_s: float
    """Time unit of a 3-2-1-1."""
    train_s: float
    """Length of the training segment."""

    @property
    def clock_s(self) -> float:
        """Clock of the shift register."""
        return self.clock_samples / self.sample_rate_hz

    @property
    def length(self) -> int:
        """N = 2^n - 1 bits per period: also the order of persistent excitation."""
        return int(2**self.register_bits - 1)

    @property
    def period_s(self) -> float:
        """Duration of one period of the training PRBS."""
        return self.length * self.clock_s

    @property
    def covered_rad_s(self) -> tuple[float, float]:
        """First spectral line, and 2 pi 0.3 / clock, where eq. (10) ends the band."""
        return 2.0 * math.pi / self.period_s, TURN / self.clock_s

    @property
    def flown_low_rad_s(self) -> float:
        """Lowest frequency of which the training holds a period, as the monitor counts."""
        return max(self.covered_rad_s[0], 2.0 * math.pi / (SPARED * self.train_s))

    def order(self, duration_s: float) -> int:
        """Order of persistent excitation of a stretch of the PRBS: its number of bits."""
        return min(self.length, math.floor(duration_s / self.clock_s))

    def text(self) -> str:
        """Explain the design, line by line."""
        return '\n'.join(_lines(self))

    def to_schedule_yaml(self, axis: str = 'roll', amplitude_deg: float = 12.0) -> str:
        """YAML of a schedule: a training PRBS, then a PRBS and a square wave for validation."""
        highest = AMPLITUDES['attitude'][3]
        if not 0.0 < amplitude_deg <= highest:
            raise BadInputError('--amplitude-deg', f'must be above 0 and at most {highest:g}°',
                                amplitude_deg)
        prbs = f'signal: prbs, axis: {axis}, injection: attitude, amplitude_deg: {amplitude_deg:g}'
        square = prbs.replace('prbs', 'square')
        rows = [
            '{segment: idle, duration_s: 3.0}',
            (f'{{segment: train, {prbs}, duration_s: {self.train_s:g}, '
            f'clock_s: {self.clock_s:.6g}, register_bits: {self.register_bits}, seed: 1}}'),
            '{segment: idle, duration_s: 2.0}',
            (f'{{segment: validation, {prbs}, duration_s: 18.0, clock_s: {self.clock_s:.6g}, '
            f'register_bits: {self.validation_bits}, seed: 2}}'),
            '{segment: idle, duration_s: 2.0}',
            (f'{{segment: validation, {square}, duration_s: 16.0, '
            f'period_s: {self.square_period_s:.6g}}}'),
            '{segment: idle, duration_s: 2.0}',
        ]
        band = f'{self.low_rad_s:g} to {self.high_rad_s:g} rad/s'
        head = f'# Designed for {band} by eqs. (9), (10).\n'
        return head + f'schedule:\n{mount_line("rig")}\n  segments:\n' + ''.join(
            f'    - {row}\n' for row in rows
        )


def mount_line(mount: str) -> str:
    """The line of a schedule that says where it is flown, with what follows from that."""
    other = {'rig': 'in free flight write hover', 'hover': 'on a rig write rig'}[mount]
    return f'  mount: {mount}  # a stick beyond {Limits(mount).largest_stick:.0%} ends it; {other}'


def parse_band(text: str) -> tuple[float, float]:
    """Read `LOW:HIGH` (rad/s) of --band; BadInputError unless 0 < LOW < HIGH."""
    low, _, high = text.partition(':')
    try:
        band = (float(low), float(high))
    except ValueError:
        band = (math.nan, math.nan)
    if not 0.0 < band[0] < band[1] < math.inf:
        raise BadInputError('--band', 'needs 0 < LOW < HIGH in rad/s', repr(text),
                            'for example --band 0.1:20')
    return band


def design_excitation(low_rad_s: float, high_rad_s: float, sample_rate_hz: float = 250.0,
                      train_s: float | None = None) -> Design:
    """Design for a band in rad/s. BadInputError where the sample rate is too low for it.

    Eq. (10): 0.3 / clock = 1 / (2 pi tau_min) with tau_min = 1 / high, rounded down to whole
    samples so that the band is covered. Eq. (9): N * clock = 3 to 5 tau_max, tau_max = 1 / low, by
    the register length that comes nearest to 4. This period is the training, 10 to 120 s, and
    ends above LOW. With `train_s`, s, the training is that long, by the shortest register whose
    first line reaches LOW.
    """
    if not 0.0 < low_rad_s < high_rad_s < math.inf:
        raise BadInputError('--band', 'needs 0 < LOW < HIGH in rad/s',
                            f'{low_rad_s:g}:{high_rad_s:g}', 'for example --band 0.1:20')
    if not 0.0 < sample_rate_hz < math.inf:
        raise BadInputError('--rate', 'must be a positive number of Hz', sample_rate_hz)
    clock = TURN / high_rad_s
    samples = math.floor(clock * sample_rate_hz + 1e-9)
    if samples < SAMPLES_PER_CLOCK:
        most = TURN * sample_rate_hz / SAMPLES_PER_CLOCK
        raise BadInputError('--band', f'HIGH is too fast for {sample_rate_hz:g} Hz',
                            f'{high_rad_s:g} rad/s',
                            f'at most {most:.4g} rad/s ({SAMPLES_PER_CLOCK} samples per clock)')
    shortest = max(2.0 * RAMP_S, 2.0 * math.pi / (SPARED * high_rad_s))
    if train_s is not None and not shortest <= train_s <= MAX_DURATION_S:
        raise BadInputError('--seconds', f'must lie in {shortest:.3g} s (a period of HIGH, and '
                            f'the ramps) to {MAX_DURATION_S:g} s', train_s)
    clocks = 1.0 / (low_rad_s * samples / sample_rate_hz)
    ideal = round(math.log2(4.0 * clocks + 1.0)) if train_s is None else \
        math.ceil(math.log2(2.0 * math.pi * clocks + 1.0))
    bits = min(max(ideal, min(TAPS)), max(TAPS))
    period_s = (2**bits - 1) * samples / sample_rate_hz
    middle = math.sqrt(low_rad_s * high_rad_s)
    return Design(low_rad_s=low_rad_s, high_rad_s=high_rad_s, sample_rate_hz=sample_rate_hz,
                  clock_samples=samples, register_bits=bits,
                  validation_bits=bits - 1 if bits > min(TAPS) else bits + 1,
                  square_period_s=min(round(2.0 * math.pi / middle, 3), LONGEST_SQUARE_S),
                  unit_s=round(TURN / (high_rad_s / 3.0), 3),
                  train_s=train_s or math.ceil(min(max(period_s, LEAST_TRAIN_S), MAX_PERIOD_S)))


def _reach(d: Design) -> str:
    """What the training covers, and what would reach LOW."""
    covered = (f'training {d.train_s:g} s: covers {d.flown_low_rad_s:.3g} to '
               f'{d.covered_rad_s[1]:.4g} rad/s')
    if d.train_s < FIT_S:
        return f'{covered}; too short for a fit, which takes --seconds {FIT_S:g} at least'
    if d.flown_low_rad_s <= d.low_rad_s:
        return covered
    least_s = math.ceil(max(2.0 * math.pi / (SPARED * d.low_rad_s), LEAST_TRAIN_S))
    if least_s > MAX_DURATION_S:
        remedy = f'that takes {least_s} s; a segment lasts at most {MAX_DURATION_S:g} s: raise LOW'
    elif d.low_rad_s * (2 ** max(TAPS) - 1) * d.clock_s < 2.0 * math.pi:
        remedy = f'a register has at most {max(TAPS)} bits: fly a second schedule of lower HIGH'
    else:
        remedy = f'--seconds {least_s} does'
    return f'{covered}, which does not reach LOW ({d.low_rad_s:g} rad/s): {remedy}'


def _lines(d: Design) -> list[str]:
    """Lines of the explanation."""
    tau_min, tau_max = 1.0 / d.high_rad_s, 1.0 / d.low_rad_s
    exact = TURN * tau_min
    first, top = d.covered_rad_s
    periods = d.period_s / tau_max
    inside = PERIODS[0] <= periods <= PERIODS[1]
    return [
        (f'band {d.low_rad_s:g} to {d.high_rad_s:g} rad/s at {d.sample_rate_hz:g} Hz: '
        f'tau_min {tau_min:.4g} s, tau_max {tau_max:.4g} s'),
        (f'clock {d.clock_s:.4g} s ({d.clock_samples} samples): eq. (10), 0.3/clock = '
        f'1/(2 pi tau_min), gives {exact:.4g} s, rounded down so that HIGH is covered; '
        f'the PRBS reaches to {top:.4g} rad/s'),
        f'register {d.register_bits} bits, N = {d.length}, period {d.period_s:.4g} s = '
        f'{periods:.2g} tau_max: eq. (9) asks for 3 to 5'
        + ('' if inside else '; longer, so that a line reaches LOW' if first <= d.low_rad_s else
           '; no register of whole bits lies inside, this one is nearest to 4'),
        (f'persistently exciting of order {d.length} over one period '
        f'(the paper needs 50 for its largest model)'),
        f'first spectral line {first:.3g} rad/s',
        _reach(d),
        (f'validation: another register ({d.validation_bits} bits; the same one would only be '
        f'shifted) and a square wave of {d.square_period_s:g} s'),
        (f'3-2-1-1 unit {d.unit_s:g} s; chirp or multisine {d.low_rad_s / (2 * math.pi):.3g} to '
        f'{d.high_rad_s / (2 * math.pi):.3g} Hz'),
        ('the paper prints a clock of 0.03 s and N = 424: its own eq. (10) gives 0.094 s for '
        '20 rad/s, and 424 is not of the form 2^n - 1 (511 is, n = 9); this design follows the '
        'equations'),
    ]
