"""Step A of the paper: models side by side on training and validation data, with residual tests.

The second step, in the simulated closed loop, is in `pipeline`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from quad_sysid.blackbox.innovations import one_step_errors
from quad_sysid.blackbox.model import Model
from quad_sysid.blackbox.residuals import ResidualTest, residual_test
from quad_sysid.blackbox.simulate import compare
from quad_sysid.errors import BadInputError
from quad_sysid.record import UNNAMED, IOData

WITH_NOISE_MODEL = ('ARX', 'ARMAX', 'BJ')
"""Structures that claim a white residual; OE, IV4 and CLRIV leave the noise to itself."""

DIVERGED_PCT = -1e4
"""Fit below which the run counts as diverged, %."""


@dataclass(frozen=True)
class StepARow:
    """One model's figures; fits in percent, None where the free run diverges."""

    model: Model
    fit_train_pct: float | None
    """One-step fit on the training data, as in the paper's Table 2."""
    fit_train_free_run_pct: float | None
    fit_validation_pct: Mapping[str, float | None]
    """Free-run fit on each validation."""
    aic: float | None
    """N ln V + 2k over the training rows that all compared models share; bic alike."""
    bic: float | None
    test: ResidualTest
    eliminated_because: str
    """Empty where the model passes."""

    @property
    def passed_first_step(self) -> bool:
        """Whether the model was not rejected."""
        return not self.eliminated_because

    @property
    def holds(self) -> bool:
        """Whether it passed and its noise model holds, which not every structure claims."""
        return self.passed_first_step and self.test.residual_white

    def as_report(self) -> dict[str, object]:
        """Build the entry of report.json's `models`."""
        return {
            'structure': self.model.structure,
            'orders': dict(self.model.orders),
            'approach': self.model.approach,
            'fit_train_pct': self.fit_train_pct,
            'fit_train_free_run_pct': self.fit_train_free_run_pct,
            'fit_validation_pct': dict(self.fit_validation_pct),
            'aic': self.aic,
            'bic': self.bic,
            'residual_white': self.test.residual_white,
            'residual_uncorrelated_with_input': self.test.residual_uncorrelated_with_input,
            'causal': self.test.causal,
            'converged': self.model.converged,
            'passed_first_step': self.passed_first_step,
            'eliminated_because': self.eliminated_because,
        }


def step_a(models: Sequence[Model], train: IOData, validations: Mapping[str, IOData],
           lags: int = 25, confidence: float = 0.99) -> tuple[StepARow, ...]:
    """Judge every model: one row each, in the order of `models`.

    `validations` by signal, such as {'prbs': …, 'square': …}; residual tests run on `train`, to
    which the models were fitted.
    Without an external reference in `train` a residual that predicts u speaks against no model,
    since feedback alone does that.
    """
    if not models:
        raise BadInputError('step_a', 'models must not be empty', 0)
    losses, n = shared_losses(models, train)
    rows = []
    for model, loss in zip(models, losses, strict=True):
        # instruments, and stages that replace u, do not make these errors the smallest
        least = model.approach == 'direct' and model.structure != 'IV4'
        test = residual_test(train, model, lags, confidence, fitted=least)
        fits = {name: _finite(compare(z, model)[0]) for name, z in validations.items()}
        k = model.parameters.size
        fit = n * math.log(loss) if loss > 0.0 else None
        rows.append(
            StepARow(model=model, fit_train_pct=_finite(compare(train, model, horizon=1)[0]),
                     fit_train_free_run_pct=_finite(compare(train, model)[0]),
                     fit_validation_pct=fits, aic=None if fit is None else fit + 2.0 * k,
                     bic=None if fit is None else fit + k * math.log(n), test=test,
                     eliminated_because='; '.join(_objections(model, test, fits)))
        )
    return tuple(rows)


def shared_losses(models: Sequence[Model], z: IOData) -> tuple[list[float], int]:
    """Return V = SSE/N of each model over the N rows of z that all of them predict."""
    is_finite = np.ones(z.y.size, dtype=bool)
    errors = []
    for model in models:
        e = np.full(z.y.size, np.nan)
        for part in one_step_errors(model, z):
            e[part.start : part.start + part.errors.size] = part.errors
        errors.append(e)
        is_finite &= ~np.isnan(e)
    n = int(is_finite.sum())
    if n == 0:
        raise BadInputError('step_a', 'no row of train is predicted by all models', 0,
                            'take lower orders or longer segments')
    return [float(np.mean(e[is_finite] ** 2)) for e in errors], n


def _objections(model: Model, test: ResidualTest, fits: Mapping[str, float | None]) -> list[str]:
    """Reasons against the model."""
    reasons = []
    if not model.converged:
        reasons.append('the fit did not converge')
    if not model.stable:
        reasons.append('the plant is unstable, its free run diverges')
    if not 0 < model.nk < 9:  # the paper's range: a command acts after its cycle, and soon
        reasons.append(f'nk = {model.nk} breaks 0 < nk < 9')
    for name, fit in fits.items():
        if fit is None or fit <= 0.0:
            part = 'held-out data' if name in UNNAMED else name
            reasons.append(f'free run on {part} is no better than its mean')
    if model.structure in WITH_NOISE_MODEL and not test.residual_white:
        reasons.append(f'residual is not white (p = {test.p_white:.2g})')
    if not test.residual_uncorrelated_with_input:
        reasons.append(f'residual depends on past inputs (p = {test.p_input:.2g})')
    if not test.causal and test.causality_signal == 'r':
        reasons.append(f'residual predicts the reference (p = {test.p_causal:.2g})')
    return reasons


def _finite(value: float) -> float | None:
    """Return the fit, or None where the run has diverged."""
    return value if value > DIVERGED_PCT else None
