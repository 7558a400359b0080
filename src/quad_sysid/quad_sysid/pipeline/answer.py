"""What identification answers for one axis. Values only; made in identify.py, told in report."""

from __future__ import annotations

from dataclasses import dataclass, field

from quad_sysid.blackbox import StepARow
from quad_sysid.contract import FloatArray
from quad_sysid.effects.discover import Discovery
from quad_sysid.effects.judge import Judgement
from quad_sysid.model import AxisModel, GainProposal
from quad_sysid.record import IOData, Segment


@dataclass(frozen=True)
class ModelRow:
    """A black-box model with both steps of the paper's selection."""

    step_a: StepARow
    closed_loop_fit_pct: float | None = None
    """Fit of the simulated closed loop to the recorded rate on the validation segments."""
    passed_second_step: bool = False


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
    proposal: GainProposal | None = None
    warnings: tuple[str, ...] = field(default=())
    attitude_reference: FloatArray | None = None
    """(n,) rad, on the grid of discovery.data; None where the bags do not hold it."""
    rate_reference: FloatArray | None = None
    """(n,) rad/s, alike."""

    @property
    def answered(self) -> bool:
        """False where the data were too poor to say anything."""
        return self.verdict != 'cannot_tell'
