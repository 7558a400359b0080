"""Notches where the frame shakes at a frequency that the controller passes on to the motors. Pure.

A peak of the gyro's spectrum gets a notch where the command that the controller makes of it is
more than LEAST_COMMAND, and where the notch takes little of the phase margin. What D alone passes
on gets the notch before D, which costs the least; the rest gets one on the gyro.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from quad_sysid.contract import AXES
from quad_sysid.logview.response import notch
from quad_sysid.logview.spectrum import Peak
from quad_sysid.loop.cascade import HIGHEST, CascadeGains

LEAST_COMMAND = 0.003
"""RMS of the command that a peak makes, of the whole range, from which it gets a notch."""
MOST_PHASE_DEG = 4.0
"""That one notch may take at the crossover."""
WIDTH_SHARE, LEAST_WIDTH_HZ, NARROWEST_HZ = 0.25, 10.0, 5.0
"""Width over frequency; at least; and below which none is proposed, since rotors change speed."""
BY_D = 0.6
"""Share of the command that must go by D for a notch there alone."""
SAME_HZ = 6.0
"""Peaks of two axes this near are one."""
D_HIGHEST_HZ, GYRO_NOTCHES = 110.0, 2
"""What the bridge's firmware can take: the highest notch before D at 250 Hz, and how many before
all."""


@dataclass(frozen=True)
class NotchProposal:
    """One notch, why, and its price."""

    place: str
    """`rate.d_notch`, `sensor.notch_1` or `sensor.notch_2`."""
    axis: str
    """Axis on which the peak is largest."""
    frequency_hz: float
    width_hz: float
    gyro_rms: float
    """RMS of the peak in the gyro, rad/s."""
    command_rms: float
    """RMS of the peak in the command, as a share of its range."""
    command_rms_after: float
    """RMS in the command behind the notch, as a share of its range."""
    phase_deg: float
    """Phase lag of the notch at the highest crossover of the axes, degrees."""

    @property
    def gains(self) -> dict[str, float]:
        """Frequency and width, Hz, by the contract's names."""
        return {f'{self.place}_hz': self.frequency_hz,
                f'{self.place}_bandwidth_hz': self.width_hz}


def propose_notches(peaks: Mapping[str, tuple[Peak, ...]], gains: Mapping[str, float],
                    crossover_rad_s: Mapping[str, float], dt: float) -> tuple[NotchProposal, ...]:
    """The notches for a flight's peaks by axis, the worst first.

    `gains` are those that are to fly, by the contract's names; `crossover_rad_s` by axis.
    """
    cascades = {axis: CascadeGains.from_mapping(gains, axis) for axis in AXES}
    notches: list[NotchProposal] = []
    free = [f'sensor.notch_{k}' for k in range(1, GYRO_NOTCHES + 1)
            if not gains.get(f'sensor.notch_{k}_hz')]
    crossing_hz = max(crossover_rad_s.values(), default=0.0) / (2.0 * np.pi)
    shakes = [(_command(cascades[axis], peak, dt), axis, peak)
              for axis, several in peaks.items() for peak in several]
    for command, axis, peak in sorted(shakes, key=lambda one: -one[0]):
        near = any(abs(one.frequency_hz - peak.frequency_hz) < SAME_HZ for one in notches)
        if command < LEAST_COMMAND or near:
            continue
        without_d = _command(replace(cascades[axis], rate_kd=0.0), peak, dt)
        occupied = gains.get('rate.d_notch_hz') or any(
            one.place == 'rate.d_notch' for one in notches)
        by_d = without_d < (1.0 - BY_D) * command and not occupied
        if by_d and peak.frequency_hz <= D_HIGHEST_HZ:
            place = 'rate.d_notch'
        elif free:
            place = free[0]
        else:
            continue
        notch = _notch(place, axis, peak, command, cascades[axis], crossing_hz, dt)
        if notch is not None:
            notches.append(notch)
            free = [one for one in free if one != place]
    return tuple(notches)


def _command(gains: CascadeGains, peak: Peak, dt: float) -> float:
    """RMS of the command that a peak of the rate makes."""
    omega = np.array([2.0 * np.pi * peak.frequency_hz])
    return float(abs(gains.response(omega, dt)[0, 0])) * peak.rms


def _notch(place: str, axis: str, peak: Peak, command: float, gains: CascadeGains,
           crossing_hz: float, dt: float) -> NotchProposal | None:
    """The notch as wide as its price allows; None where it would be too narrow."""
    hz = peak.frequency_hz
    width = max(LEAST_WIDTH_HZ, WIDTH_SHARE * hz)
    for _ in range(12):
        cost, after = _price(place, hz, width, command, peak, gains, crossing_hz, dt)
        highest = HIGHEST / dt if place == 'rate.d_notch' else np.inf
        if cost <= MOST_PHASE_DEG and hz + 0.5 * width < highest:
            return NotchProposal(place, axis, round(hz, 1), round(width, 1), peak.rms, command,
                                 after, cost)  # fmt: skip
        width *= 0.85
        if width < NARROWEST_HZ:
            return None
    return None


def _price(place: str, hz: float, width: float, command: float, peak: Peak, gains: CascadeGains,
           crossing_hz: float, dt: float) -> tuple[float, float]:
    """Degrees at the crossover, and the command that is left."""
    if place == 'rate.d_notch':
        behind = replace(gains, d_notch_hz=hz, d_notch_bandwidth_hz=width)
        at = np.array([2.0 * np.pi * max(crossing_hz, 1e-3)])
        ratio = behind.response(at, dt)[0, 0] / gains.response(at, dt)[0, 0]
        return max(0.0, -float(np.degrees(np.angle(ratio)))), _command(behind, peak, dt)
    at_hz = np.array([max(crossing_hz, 1e-3)])
    # half of a peak's power lies within an eighth of the notch's width about its centre
    passed = float(abs(notch(hz, width, np.array([hz + width / 8.0]))[0]))
    return -float(np.degrees(np.angle(notch(hz, width, at_hz)[0]))), command * passed
