"""The answer of an identification for one axis: values only."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from quad_sysid.axes import units_of
from quad_sysid.blackbox import ResidualTest, StepARow
from quad_sysid.contract import FloatArray
from quad_sysid.discover.accept import Verdict
from quad_sysid.discover.search import SearchResult
from quad_sysid.estimate.fit import Fit, Problem
from quad_sysid.explain import Ladder
from quad_sysid.model import AxisModel, GainProposal, Outside
from quad_sysid.model.data import AxisData
from quad_sysid.record import IOData, Segment
from quad_sysid.units import Units


@dataclass(frozen=True)
class LoopRun:
    """A model in the simulated cascade of one flight, against the recorded rate (step B)."""

    bag: str
    gains_changed: bool
    """Whether it was flown with other gains than the training."""
    signals: tuple[str, ...]
    fit_pct: float | None
    rmse: float | None
    """rad/s."""
    mae: float | None
    """rad/s."""
    diverged: bool = False
    because: str = ''
    """Why there are no figures."""


@dataclass(frozen=True)
class ModelRow:
    """A black-box model with both steps of the paper's selection."""

    step_a: StepARow
    closed_loop_fit_pct: float | None = None
    """Fit of the simulated closed loop to the recorded rate on the validation segments."""
    passed_second_step: bool = False
    loop_runs: tuple[LoopRun, ...] = ()
    """All flights and sets of gains; the first is that of `closed_loop_fit_pct`."""
    second_step_because: str = ''
    """Why step B eliminated it."""


@dataclass(frozen=True)
class Use:
    """A use of a flight, or an approach of the paper's Table 1: `direct`, `indirect`, `joint`."""

    name: str
    possible: bool
    because: str = ''
    """Why it is not possible; if it is, on what condition."""


@dataclass(frozen=True)
class Selection:
    """Fit and selection of the black-box models of one axis."""

    approaches: tuple[Use, ...] = ()
    feedback: bool | None = None
    """Whether the data show feedback from the rate to the command."""
    advice: tuple[str, ...] = ()


@dataclass(frozen=True)
class HeldOut:
    """Errors of a fitted structure on the held-out segments."""

    fit: Fit
    errors: FloatArray
    """(windows, length) of the free run over windows of 0.5 s, rad/s."""
    interval: tuple[float, float]
    """95 % interval of the RMS of `errors`, rad/s."""
    innovations: FloatArray
    """(n,) one-step errors, measured less predicted, rad/s; NaN outside of the segments."""
    disturbance: FloatArray
    """(n,) torque disturbance by the filter, rad/s²; NaN outside of the segments."""


@dataclass(frozen=True)
class Findings:
    """Results of the search and of the held-out segments for one axis."""

    data: AxisData
    """The whole flight."""
    problem: Problem
    """The training segments, cut out, on which `search` was fitted."""
    search: SearchResult
    ladder: Ladder
    verdict: Verdict
    before: HeldOut
    after: HeldOut
    """Errors of the completed model; `before` itself where no effect was accepted."""

    @property
    def added(self) -> bool:
        """Whether effects were accepted."""
        return self.after is not self.before


@dataclass(frozen=True)
class MissingTorque:
    """The torque (over inertia) that the filter's disturbance state replaces."""

    time_s: FloatArray
    """(m,) of the held-out samples, from the first sample of the record."""
    acceleration: FloatArray
    """(m,) rad/s²."""
    expected_rms: float
    """RMS that the model's own noise predicts, rad/s²."""

    @property
    def rms(self) -> float:
        """rad/s²."""
        return float(np.sqrt(np.mean(self.acceleration**2)))

    @property
    def largest(self) -> tuple[float, float]:
        """Time, s, and value, rad/s², of the largest."""
        i = int(np.argmax(np.abs(self.acceleration)))
        return float(self.time_s[i]), float(self.acceleration[i])


@dataclass(frozen=True)
class Residual:
    """One model's one-step errors on the held-out segments."""

    test: ResidualTest
    rms: float
    """rad/s."""
    frequency_hz: FloatArray
    """(m,) of `density`; empty where the segments are too short for a spectrum."""
    density: FloatArray
    """(m,) (rad/s)² per Hz."""
    peaks: tuple[tuple[float, float], ...] = ()
    """Frequency, Hz, and power over the surroundings, strongest first."""
    missing: MissingTorque | None = None
    """Missing torque; None for a black-box model, which has no torque."""


@dataclass(frozen=True)
class ClosedLoop:
    """The completed model in the simulated cascade against the recording, validation only."""

    time_s: FloatArray
    measured: FloatArray
    before: FloatArray
    after: FloatArray
    rms_before: float
    rms_after: float


@dataclass(frozen=True)
class AxisAnswer:
    """The whole answer for one axis; parts are None where the data did not allow them."""

    axis: str
    sample_rate_hz: float
    segments: tuple[Segment, ...]
    verdict: str
    reason: str
    rows: tuple[ModelRow, ...] = ()
    selected: int | None = None
    findings: Findings | None = None
    model: AxisModel | None = None
    blackbox_error: float | None = None
    blackbox_horizons: Mapping[float, float] = field(default_factory=dict)
    """Seconds after the start of a free run to the selected black box's RMS error, rad/s."""
    closed_loop: ClosedLoop | None = None
    train: IOData | None = None
    """Command and rate of the training segments about their means, with the reference."""
    validation: IOData | None = None
    """All validation segments, about the same means."""
    proposal: GainProposal | None = None
    warnings: tuple[str, ...] = field(default=())
    attitude_reference: FloatArray | None = None
    """(n,) rad, on the grid of findings.data; None where the bags do not hold it."""
    rate_reference: FloatArray | None = None
    """(n,) rad/s, alike."""
    selection: Selection = field(default_factory=Selection)
    outside: tuple[Outside, ...] = ()
    """Signals of the held-out segments that leave the range of the training."""
    residuals: Mapping[str, Residual] = field(default_factory=dict)
    """One-step errors on the held-out segments of `before`, `after`, `blackbox`."""

    @property
    def units(self) -> Units | None:
        """Units of an axis that moves, or of the arrays that it came from; None: of a rotation."""
        return units_of(self.axis) if self.model is None else self.model.units

    @property
    def answered(self) -> bool:
        """False where the data were too poor to say anything."""
        return self.verdict != 'cannot_tell'
