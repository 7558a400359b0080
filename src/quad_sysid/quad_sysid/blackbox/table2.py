"""The paper's Table 2: its 13 rows by their orders, and the same fits on the user's own data.

One entry per row; to fit another structure is to add one. The figures are the paper's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from quad_sysid.blackbox.arx import arx
from quad_sysid.blackbox.instruments import clriv, iv4
from quad_sysid.blackbox.polynomial import Model
from quad_sysid.blackbox.prediction_error import armax, bj
from quad_sysid.blackbox.step_a import StepARow, step_a
from quad_sysid.errors import BadInputError
from quad_sysid.record import IOData

Fit = Callable[[IOData], Model]


@dataclass(frozen=True)
class PaperRow:
    """One row of Table 2 and how it is fitted here."""

    name: str
    fit: Fit
    prbs_pct: float
    """The paper's fit on the validation PRBS; square and training alike."""
    square_pct: float
    train_pct: float
    kept: bool = False
    """Whether the paper kept the model for its second step."""


@dataclass(frozen=True)
class Table2Entry:
    """The paper's row beside ours; `row` is None where the fit was refused, with the reason."""

    paper: PaperRow
    row: StepARow | None
    refused_because: str = ''


def _armax(na: int, nb: int, nc: int, nk: int) -> Fit:
    return lambda z: armax(z, na, nb, nc, nk)


def _arx(na: int, nb: int, nk: int) -> Fit:
    return lambda z: arx(z, na, nb, nk)


def _iv4(na: int, nb: int, nk: int) -> Fit:
    return lambda z: iv4(z, na, nb, nk)


def _refined(na: int, nb: int, nk: int) -> Fit:
    """Refined IV of the same plant orders with AR noise; driven by u where there is no r."""
    return lambda z: clriv(z, nb, 0, na, na, nk, reference=z.u if z.r is None else z.r)


def _bj(nb: int, nc: int, nd: int, nf: int, nk: int) -> Fit:
    return lambda z: bj(z, nb, nc, nd, nf, nk)


TABLE2 = (
    PaperRow('ARMAX 4 3 4 2', _armax(4, 3, 4, 2), 57.38, 79.18, 98.27),
    PaperRow('ARMAX 3 3 3 1', _armax(3, 3, 3, 1), 62.09, 73.2, 98.23, kept=True),
    PaperRow('ARMAX 3 2 3 1', _armax(3, 2, 3, 1), 59.39, 61.61, 98.15),
    PaperRow('ARMAX 3 2 2 1', _armax(3, 2, 2, 1), 63.06, 75.3, 98.17),
    PaperRow('ARMAX 3 2 1 1', _armax(3, 2, 1, 1), 57.08, 70.77, 97.92),
    PaperRow('ARX 10 10 5', _arx(10, 10, 5), 73.84, 80.15, 98.3, kept=True),
    PaperRow('ARX 2 2 1', _arx(2, 2, 1), 51.59, 43.52, 96.92),
    PaperRow('ARX 2 2 0', _arx(2, 2, 0), 45.9, 39.04, 96.94),
    PaperRow('IV 4 4 5', _iv4(4, 4, 5), 77.93, 65.85, 97.85),
    PaperRow('IV 5 5 4', _iv4(5, 5, 4), 77.34, 70.23, 98.12, kept=True),
    PaperRow('IV 4 4 5 refined', _refined(4, 4, 5), 77.62, 75.76, 96.71),
    PaperRow('BJ 2 3 2 2 1', _bj(2, 3, 2, 2, 1), 58.33, 63.25, 98.09, kept=True),
    PaperRow('BJ 1 3 3 2 1', _bj(1, 3, 3, 2, 1), 61.58, 66.91, 98.16),
)


def _attempt(paper: PaperRow, train: IOData) -> Model | str:
    """Fit one row, or say why the data cannot carry it."""
    try:
        return paper.fit(train)
    except BadInputError as error:
        return str(error)


def fit_table2(
    train: IOData, validations: Mapping[str, IOData], lags: int = 25, confidence: float = 0.99
) -> tuple[Table2Entry, ...]:
    """Fit all rows on `train` and judge them as `step_a` does, beside the paper's figures.

    A row that the data cannot carry keeps its place with the reason; only where none can be
    fitted is BadInputError raised.
    """
    models: dict[str, Model] = {}
    refused: dict[str, str] = {}
    for paper in TABLE2:
        found = _attempt(paper, train)
        if isinstance(found, Model):
            models[paper.name] = found
        else:
            refused[paper.name] = found
    if not models:
        raise BadInputError('fit_table2', 'no row can be fitted', next(iter(refused.values())))
    judged = step_a(list(models.values()), train, validations, lags, confidence)
    rows = dict(zip(models, judged, strict=True))
    return tuple(
        Table2Entry(paper, rows.get(paper.name), refused.get(paper.name, '')) for paper in TABLE2
    )
