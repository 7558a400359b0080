"""The gyro bias that is subtracted from rates before publishing, and how to undo that. Pure.

The bridge says in `/diagnostics`, and so in every bag, what it subtracts and from which stamp on:
the rates as the STM32 sent them can be restored.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from quad_bridge.si import FloatArray
from quad_bridge.wire.frames import Vector3

STATUS = 'sensors'  # name of the entry in /diagnostics, behind the node's
GYRO, SINCE = 'gyro bias removed (rad/s)', 'removed since (ns)'


@dataclass(frozen=True)
class Correction:
    """An offset in body axes FLU: published = sent by the STM32 - offset."""

    gyro_bias: Vector3 = (0.0, 0.0, 0.0)  # rad/s
    since_ns: int = 0  # stamp (ROS time) of the first message with it; 0: none yet

    def entry(self) -> dict[str, str]:
        """Values of a status entry; floats come back bit for bit."""
        return {GYRO: ' '.join(map(repr, self.gyro_bias)), SINCE: str(self.since_ns)}


def from_values(values: Mapping[str, str]) -> Correction | None:
    """The offset in a status entry; None where it is another entry."""
    try:
        x, y, z = map(float, values[GYRO].split())
        return Correction((x, y, z), int(values[SINCE]))
    except (KeyError, ValueError):
        return None


def as_sent(
    stamps_ns: npt.NDArray[np.int64], rates: FloatArray, corrections: Sequence[Correction]
) -> FloatArray:
    """Undo what was subtracted from rates (n, 3), rad/s, with these stamps (n,).

    `corrections` are all corrections of the bag in any order. Before the first of them nothing was
    subtracted.
    """
    sent = np.array(rates, dtype=float)
    by_begin = {correction.since_ns: correction
                for correction in corrections if correction.since_ns > 0}
    begins = sorted(by_begin)
    index = np.searchsorted(begins, stamps_ns, side='right') - 1
    for k, begin in enumerate(begins):
        sent[index == k] += by_begin[begin].gyro_bias
    return sent
