"""What identification answers for one axis. Values only; made in identify.py, told in report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from quad_sysid.blackbox import Model, ResidualTest, StepARow, Table2Entry
from quad_sysid.contract import FloatArray
from quad_sysid.effects.discover import Discovery
from quad_sysid.effects.judge import Judgement
from quad_sysid.model import AxisModel, GainProposal
from quad_sysid.record import IOData, Segment


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
class Approach:
    """One of the paper's Table 1: whether the signals allow it, and why not."""

    name: str
    """`direct`, `indirect` or `joint`."""
    possible: bool
    because: str


@dataclass(frozen=True)
class Check:
    """One rule of section 2.6 on the data's preparation, held against the record."""

    name: str
    kept: bool | None
    """None where the record does not allow the check."""
    words: str


@dataclass(frozen=True)
class SharedModel:
    """One model for roll and pitch, where their confidence bands agree (the paper's choice)."""

    agree: bool
    because: str
    model: Model | None = None
    """Fitted on both axes' training together; None where they do not agree."""
    fit_validation_pct: Mapping[str, float | None] = field(default_factory=dict)
    """Free-run fit of the shared model by axis."""


@dataclass(frozen=True)
class Selection:
    """How the black-box models of one axis were found and chosen between, in words and values."""

    approaches: tuple[Approach, ...] = ()
    feedback: bool | None = None
    """Whether the data show feedback from the rate to the command."""
    checks: tuple[Check, ...] = ()
    advice: tuple[str, ...] = ()
    table2: tuple[Table2Entry, ...] = ()
    """The paper's rows, where they were asked for."""
    shared: SharedModel | None = None


@dataclass(frozen=True)
class MissingTorque:
    """The torque (over inertia) by which a Kalman filter keeps pushing the model's rate."""

    time_s: FloatArray
    """(m,) of the samples that have one, from the first sample of the record."""
    acceleration: FloatArray
    """(m,) rad/s², mean over `smooth_s`."""
    smooth_s: float
    expected_rms: float
    """rad/s², RMS that white one-step errors of this size would show."""

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
    """None for a black-box model, which has no torque."""


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
    discovery: Discovery | None = None
    judgement: Judgement | None = None
    model: AxisModel | None = None
    blackbox_error: float | None = None
    closed_loop: ClosedLoop | None = None
    train: IOData | None = None
    """Command and rate of the training segments about their means, with the reference."""
    validation: IOData | None = None
    """All validation segments, about the same means."""
    proposal: GainProposal | None = None
    warnings: tuple[str, ...] = field(default=())
    attitude_reference: FloatArray | None = None
    """(n,) rad, on the grid of discovery.data; None where the bags do not hold it."""
    rate_reference: FloatArray | None = None
    """(n,) rad/s, alike."""
    selection: Selection = field(default_factory=Selection)
    residuals: Mapping[str, Residual] = field(default_factory=dict)
    """What is left on the held-out segments by `before`, `after`, `blackbox`."""

    @property
    def answered(self) -> bool:
        """False where the data were too poor to say anything."""
        return self.verdict != 'cannot_tell'
