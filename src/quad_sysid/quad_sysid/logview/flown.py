"""A log as it is looked at: every signal that it holds on one grid, and the sets of gains. Pure.

Unlike a Record it may lack commands, motors and set-points; read.py makes it of a bag, a foreign
log or a table.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from quad_sysid.contract import FloatArray
from quad_sysid.record import GainChange, finite_runs

SHORTEST_STRETCH_S = 5.0
"""Gains that were active for less are no stretch of their own."""
SAME = 1e-6
"""Relative difference up to which two values of a gain are one."""


@dataclass(frozen=True)
class Flown:
    """Signals (n, …) on a grid of dt s; a sample that was not logged is NaN."""

    source: str
    kind: str
    """`a bag`, `a blackbox log`, …"""
    dt: float
    rates: FloatArray
    """(n, 3) rad/s, as the controller sees them."""
    flying: npt.NDArray[np.bool_]
    """(n,) whether it flies free of the ground, by its throttle; True where that is not logged."""
    axes: tuple[str, ...]
    """Axes that were measured."""
    rate_setpoint: FloatArray | None = None
    """(n, 3) rad/s."""
    angles: FloatArray | None = None
    """(n, 3) rad."""
    attitude_setpoint: FloatArray | None = None
    """(n, 3) rad."""
    control: FloatArray | None = None
    """(n, 4) U1..U4, normalised."""
    motors: FloatArray | None = None
    """(n, k) commands 0..1."""
    speeds: FloatArray | None = None
    """(n, k) rotor speeds, rad/s."""
    battery_v: FloatArray | None = None
    """(n,) V."""
    rates_before: FloatArray | None = None
    """(m, 3) rad/s before the flight controller's filters, on a grid of before_dt."""
    before_dt: float = 0.0
    """Sample interval of rates_before, s; equal to dt where they share the grid."""
    d_term: FloatArray | None = None
    """(n, 3) normalised command of the D part; NaN where an axis has none."""
    injected: FloatArray | None = None
    """(n, 3) what an experiment added to the command of an axis, normalised; NaN without one."""
    gains: tuple[GainChange, ...] = ()
    lacks: tuple[str, ...] = ()
    """Signals that the log lacks, each with the measurement that needs it."""
    loop_s: float | None = None
    """Cycle of the controller, s; None: that of the grid."""
    warnings: tuple[str, ...] = ()
    proposed: tuple[tuple[str, float, float], ...] = ()
    """Role (`train`, `validation`), start and end, s, of stretches for an identification."""
    gaps: tuple[tuple[float, float], ...] = field(init=False)
    """(start, end) of the stretches without rates, s from the first sample."""

    def __post_init__(self) -> None:
        is_lost = np.asarray(np.isnan(self.rates).all(axis=1))
        object.__setattr__(self, 'gaps', tuple(
            (a * self.dt, b * self.dt) for a, b in finite_runs(is_lost, (0, self.n))))

    @property
    def n(self) -> int:
        """Number of samples."""
        return len(self.rates)

    @property
    def cycle_s(self) -> float:
        """Time in which the controller computes once, s."""
        return self.dt if self.loop_s is None else min(self.loop_s, self.dt)

    @property
    def length_s(self) -> float:
        """Length, s."""
        return self.n * self.dt

    @property
    def throttle(self) -> FloatArray | None:
        """(n,) mean motor command, or U1."""
        if self.motors is not None:
            return np.asarray(self.motors.mean(axis=1))
        return None if self.control is None else np.asarray(self.control[:, 0])


@dataclass(frozen=True)
class Stretch:
    """A stretch of the flight with one set of gains."""

    start_s: float
    end_s: float
    gains: Mapping[str, float]
    changed: tuple[str, ...] = ()
    """Names of the gains that differ from the stretch before."""


def stretches(flown: Flown) -> tuple[Stretch, ...]:
    """The stretches of a flight by its sets of gains; one where they never change."""
    out: list[Stretch] = []
    latest: dict[str, float] = {}
    for change in sorted(flown.gains, key=lambda c: c.time_s):
        values = {**latest, **change.values}
        changed = tuple(name for name, value in values.items()
                        if not np.isclose(value, latest.get(name, np.nan), rtol=SAME, atol=0.0))
        if out and changed:
            start = max(0.0, change.time_s)
            if start - out[-1].start_s < SHORTEST_STRETCH_S:
                previous = out.pop()
                changed = tuple(dict.fromkeys((*previous.changed, *changed))) if out else ()
                start = previous.start_s
            elif out:
                out[-1] = Stretch(out[-1].start_s, start, out[-1].gains, out[-1].changed)
            out.append(Stretch(start, flown.length_s, values, changed))
        elif not out:
            out.append(Stretch(0.0, flown.length_s, values))
        latest = values
    if len(out) > 1 and flown.length_s - out[-1].start_s < SHORTEST_STRETCH_S:
        out.pop()
        out[-1] = Stretch(out[-1].start_s, flown.length_s, out[-1].gains, out[-1].changed)
    return tuple(out) or (Stretch(0.0, flown.length_s, {}),)
