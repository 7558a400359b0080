"""The flight to fly next, from a report's tree: for rivals, what was not tested, what is open."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from quad_sysid.axes import EVERY
from quad_sysid.model.identified import UNLISTED
from quad_sysid.pipeline.constants import RIVAL
from quad_sysid.report.tables import untested


@dataclass(frozen=True)
class Next:
    """One reason to fly again."""

    why: str
    command: str = ''
    """Command that designs it; '' without one."""


def next_flight(axis: str, tree: Mapping[str, Any]) -> Sequence[Next]:
    """Each reason with the flight that answers it, the most useful first."""
    return (*_rivals(axis, tree), *_open(axis, tree), *_untested(tree))


def _rivals(axis: str, tree: Mapping[str, Any]) -> Iterator[Next]:
    for effect in tree.get('effects', ()):
        listed = (r for r in effect.get('rivals') or () if r['name'] != UNLISTED)
        rival = max(listed, key=lambda r: r['probability'], default=None)
        if rival is not None and rival['probability'] > RIVAL:
            yield Next(
                f"{effect['name']} ({effect['probability']:.2f}) or {rival['name']} "
                f"({rival['probability']:.2f}): fly the excitation that tells them apart",
                f"quad-sysid design-excitation --model model.json --axis {axis} --separate "
                f"{effect['name']} {rival['name']} --out next.yaml" if EVERY[axis].turns else '')


def _open(axis: str, tree: Mapping[str, Any]) -> Iterator[Next]:
    verdict = tree['verdict']
    if verdict == 'unexplained_residual':
        yield Next('what is left has no name yet: fly in calm air, since gusts that come and go '
                   'leave the same residual, and at other amplitudes and another throttle, so '
                   'that what it depends on moves', _prbs(axis))
    elif verdict == 'cannot_tell':
        yield Next('these data give no answer: fly an excitation of this axis', _prbs(axis))


def _prbs(axis: str) -> str:
    if not EVERY[axis].turns:
        return 'ros2 launch quad_sysid excitation.launch.py schedule:=schedule_motion'
    return f'quad-sysid design-excitation --band 1:30 --axis {axis} --out next.yaml'


def _untested(tree: Mapping[str, Any]) -> Iterator[Next]:
    for names, because in sorted(untested(tree).rows, key=lambda row: len(row[0]))[:6]:
        yield Next(f'not tested: {names}, since {because}')
