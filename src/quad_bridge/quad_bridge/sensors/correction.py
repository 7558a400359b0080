"""Offsets that are subtracted from readings before publishing, and how to undo that. Pure.

The bridge says in `/diagnostics`, and so in every bag, what it subtracts and from which stamp on:
readings as the STM32 sent them can be had back. Which figures are trusted is decided elsewhere.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from quad_bridge.sensors.rest import FloatArray

Triple = tuple[float, float, float]
NOTHING: Triple = (0.0, 0.0, 0.0)
STATUS = 'sensors'  # name of the entry in /diagnostics, behind the node's
GYRO, MAG, SINCE = 'gyro bias removed (rad/s)', 'hard iron removed (T)', 'removed since (ns)'


@dataclass(frozen=True)
class Correction:
    """Offsets in body axes FLU: published = sent by the STM32 - offset."""

    gyro_bias: Triple = NOTHING  # rad/s
    hard_iron: Triple = NOTHING  # tesla
    since_ns: int = 0  # stamp (ROS time) of the first message with it; 0: none yet

    def told(self) -> dict[str, str]:
        """Values of a status; floats come back bit for bit."""
        return {
            GYRO: _words(self.gyro_bias),
            MAG: _words(self.hard_iron),
            SINCE: str(self.since_ns),
        }


def from_values(values: Mapping[str, str]) -> Correction | None:
    """Offsets in a status entry; None where it is another entry."""
    try:
        return Correction(_triple(values[GYRO]), _triple(values[MAG]), int(values[SINCE]))
    except (KeyError, ValueError):
        return None


def as_sent(
    stamps_ns: npt.NDArray[np.int64], corrected: FloatArray, told: Sequence[Correction], name: str
) -> FloatArray:
    """Undo what was subtracted from readings (n, 3) with these stamps (n,).

    `told` are all corrections of the bag in any order, `name` is `gyro_bias` or `hard_iron`.
    Before the first of them nothing was subtracted.
    """
    sent = np.array(corrected, dtype=float)
    by_begin = {one.since_ns: one for one in told if one.since_ns > 0}
    begins = sorted(by_begin)
    which = np.searchsorted(begins, stamps_ns, side='right') - 1
    for k, begin in enumerate(begins):
        sent[which == k] += getattr(by_begin[begin], name)
    return sent


def _words(values: Triple) -> str:
    return ' '.join(repr(v) for v in values)


def _triple(text: str) -> Triple:
    x, y, z = (float(v) for v in text.split())
    return x, y, z
