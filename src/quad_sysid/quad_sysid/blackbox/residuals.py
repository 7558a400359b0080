"""Statistics of a model's one-step residual: whether white, unrelated to past inputs, causal.

Tests only; the choice that follows from them is made in step_a.py.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import special

from quad_sysid.blackbox.filters import filter_columns
from quad_sysid.blackbox.frequency import autocovariance, cross_covariance
from quad_sysid.blackbox.innovations import SegmentErrors, one_step_errors
from quad_sysid.blackbox.polynomial import Polynomials
from quad_sysid.blackbox.regression import BLOCK_ROWS, check_order, lagged, triangular
from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.qr import upper
from quad_sysid.record import IOData, finite_runs

AR_ORDER_MAX = 30
"""Highest order of a whitener: an eighth of a second at 250 Hz, a resonance's memory."""

FREE_LAGS = 10
"""Lags that the test of whiteness keeps beyond the coefficients that were fitted to the errors."""


@dataclass(frozen=True)
class ResidualTest:
    """Results of the residual tests, with their figures."""

    residual_white: bool
    """Whether the Ljung-Box test over lags 1..M, at `confidence`, finds no correlation."""
    residual_uncorrelated_with_input: bool
    """No past input (lags 1..M; from 0 where nk is 0) explains the residual."""
    causal: bool
    """Future values of the causality signal do not explain the residual beyond past ones."""
    causality_signal: str
    """`r`, the external reference, where the data hold it; else `u`, in which feedback of the
    noise through a controller looks the same as a non-causal plant."""
    confidence: float
    samples: int
    p_white: float
    p_input: float
    p_causal: float
    lags: npt.NDArray[np.int64]
    """(M + 1,) 0..M of `autocorrelation`."""
    autocorrelation: FloatArray
    autocorrelation_bound: float
    """Two-sided bound of one lag, z/√N."""
    cross_lags: npt.NDArray[np.int64]
    """(2 M + 1,) -M..M; a positive lag is the input before the residual."""
    cross_correlation: FloatArray
    """Correlation of e(t) and u(t - lag), normalised."""
    cross_bound: float
    """Two-sided bound of one lag, z √(Σ ρ_e(k) ρ_u(k) / N) (Ljung 1999, eq. 16.67)."""

    def __repr__(self) -> str:
        tests = ((self.residual_white, 'white', self.p_white),
                 (self.residual_uncorrelated_with_input, 'free of past inputs', self.p_input),
                 (self.causal, f'causal (by {self.causality_signal})', self.p_causal))
        lines = (f'  {name}: {"yes" if ok else "no"}, p = {p:.2g}' for ok, name, p in tests)
        head = f'residual of {self.samples} samples, tests at {self.confidence:.0%}'
        return '\n'.join([head, *lines])


def residual_test(
    z: IOData, model: Polynomials, lags: int = 25, confidence: float = 0.99, *,
    fitted: bool = False,
) -> ResidualTest:
    """Test the one-step residual of `model` on z (MATLAB: resid).

    Each boolean is one joint test at `confidence` over all its lags; the bounds of single lags
    are for pictures. For the tests against inputs residual and input are first whitened by one
    autoregression of the residual, so that a coloured residual (OE, IV) is judged fairly.

    `fitted`: the model is the one that makes these errors of z smallest. The test of whiteness
    then has one degree of freedom less for each coefficient of A, C and D (Box, Pierce 1970);
    those of B and F hardly change the errors' correlation (Pierce 1972). With A, whose poles are
    the plant's too, that is somewhat strict where the input is much stronger than the noise.
    Raises BadInputError where z is too short for the lags.
    """
    if isinstance(z, Polynomials):
        raise BadInputError('residual_test', 'the data come first', 'a model',
                            'residual_test(z, model)')
    _check(lags, confidence)
    spent = model.A.size + model.C.size + model.D.size - 3 if fitted else 0
    return _tested(one_step_errors(model, z), z, lags, confidence, at_once=model.nk == 0,
                   spent=spent)


def innovation_test(innovations: FloatArray, z: IOData, lags: int = 25,
                    confidence: float = 0.99) -> ResidualTest:
    """Test one-step errors (n,) of another predictor (a Kalman filter) over z's segments.

    A NaN ends a stretch. The input may not act at lag 0. Raises BadInputError as residual_test.
    """
    _check(lags, confidence)
    if innovations.shape != z.y.shape:
        raise BadInputError('innovation_test', 'innovations must have the length of z.y',
                            innovations.shape)
    is_finite = np.isfinite(innovations)
    parts = [SegmentErrors(a, innovations[a:b])
             for segment in z.segments
             for a, b in finite_runs(is_finite, (segment[0], segment[1]))]
    return _tested(parts, z, lags, confidence, at_once=False)


def _tested(parts: list[SegmentErrors], z: IOData, lags: int, confidence: float, *,
            at_once: bool, spent: int = 0) -> ResidualTest:
    """All tests of one-step errors; `at_once`: the input may act in its own sample.

    `spent` degrees of freedom of whiteness went into a fit.
    """
    n, most = sum(part.errors.size for part in parts), max(lags, spent + FREE_LAGS * (spent > 0))
    if n < 10 * most:
        raise BadInputError('residual_test',
                            f'too few residuals for {most} lags, needs {10 * most}', n,
                            'take fewer lags or a longer record')
    mean = float(np.concatenate([part.errors for part in parts]).mean())
    errors = [part.errors - mean for part in parts]
    cov = autocovariance(errors, max(most, min(1000, n // 5)))
    if cov[0] <= 0.0:
        raise BadInputError('residual_test', 'the residual is zero throughout', 0.0,
                            'give measured data; without noise there is nothing to test')
    rho = cov / cov[0]
    box = n * (n + 2.0) * np.sum(rho[1 : most + 1] ** 2 / (n - np.arange(1, most + 1)))
    p_white = float(special.chdtrc(most - spent, box))
    ar = whitener(cov[: AR_ORDER_MAX + 1], n)
    p_input = _explained(parts, z.u, ar, range(0 if at_once else 1, lags + 1), range(0))
    signal = z.u if z.r is None else z.r
    earlier, future = (
        (range(1, lags + 1), range(-lags, 0 if at_once else 1)) if z.r is None
        else (range(lags + 1), range(-lags, 0))
    )
    p_causal = _explained(parts, signal, ar, earlier, future)
    cross, cross_bound = _cross(parts, errors, z, rho, lags)
    sigma = float(special.ndtri(0.5 + 0.5 * confidence))
    level = 1.0 - confidence
    return ResidualTest(
        residual_white=p_white >= level, residual_uncorrelated_with_input=p_input >= level,
        causal=p_causal >= level, causality_signal='u' if z.r is None else 'r',
        confidence=confidence, samples=n, p_white=p_white, p_input=p_input, p_causal=p_causal,
        lags=np.arange(lags + 1), autocorrelation=rho[: lags + 1],
        autocorrelation_bound=sigma / math.sqrt(n), cross_lags=np.arange(-lags, lags + 1),
        cross_correlation=cross, cross_bound=sigma * cross_bound,
    )


def _check(lags: int, confidence: float) -> None:
    check_order('residual_test', 'lags', lags, 1)
    if not 0.5 <= confidence < 1.0:
        raise BadInputError('residual_test', 'confidence must be in 0.5..1', confidence)


def whitener(cov: FloatArray, n: int) -> FloatArray:
    """Monic AR polynomial that whitens a signal of autocovariances cov (Levinson, AIC)."""
    poly, power = np.ones(1), float(cov[0])
    best, best_value = poly, n * math.log(power)
    for order in range(1, cov.size):
        reflection = -float(poly @ cov[order:0:-1][: poly.size]) / power
        extended = np.concatenate((poly, [0.0]))
        poly = extended + reflection * extended[::-1]
        power *= 1.0 - reflection**2
        if power <= 0.0:
            break
        value = n * math.log(power) + 2.0 * order
        if value < best_value:
            best, best_value = poly, value
    return best


def spread_of(weights: list[FloatArray], errors: list[FloatArray]) -> FloatArray:
    """(p, p) covariance of Σ weights(t) e(t) over all segments, for e of any colour.

    The weights (m, p) do not depend on e (m,); the filter that makes e of white noise shapes them
    (Ljung 1999, section 9.5). p degrees of freedom of e are spent on p parameters.
    """
    ar, power = noise_filter(errors, AR_ORDER_MAX, weights[0].shape[1])
    filtered = np.concatenate([filter_columns(np.ones(1), ar, w) for w in weights])
    return np.asarray(power * (filtered.T @ filtered))


def noise_filter(errors: list[FloatArray], order: int, spent: int) -> tuple[FloatArray, float]:
    """Whitener of errors (m,), of at most this order, and the variance of what it leaves.

    `spent`: degrees of freedom of the errors that a fit took.
    """
    n = sum(e.size for e in errors)
    cov = autocovariance(errors, min(order, n // 10))
    ar = whitener(cov, n)
    return ar, float(ar @ cov[: ar.size]) * n / (n - spent)


def _explained(parts: list[SegmentErrors], x: FloatArray, ar: FloatArray, past: range,
               future: range) -> float:
    """p-value of the null that x at the lags `future` explains nothing beyond `past` does.

    With an empty `future` it is the null that `past` explains nothing. Lagrange multiplier test
    of the whitened residual: N R² against chi-square; dependent columns leave the count.
    """
    lags = [*past, *future]
    n, blocks = 0, []
    for block in _test_rows(parts, x, ar, lags):
        n += block.shape[0]
        blocks.append(upper(block))
    if n <= len(lags) + 2:
        return 1.0
    r = triangular(blocks)
    r = r / np.maximum(np.linalg.norm(r, axis=0), np.finfo(float).tiny)
    tested = slice(1 + (len(past) if len(future) else 0), 1 + len(lags))
    counted = np.abs(np.diag(r))[tested] > 1e-8
    dof = int(counted.sum())
    unexplained = float(r[-1, -1] ** 2) / (n - len(lags) - 1)
    if dof == 0 or unexplained == 0.0:
        return 1.0
    return float(special.chdtrc(dof, float(np.sum(r[tested, -1][counted] ** 2)) / unexplained))


def _test_rows(parts: list[SegmentErrors], x: FloatArray, ar: FloatArray,
               lags: list[int]) -> Iterator[FloatArray]:
    """Blocks of rows [1, x(t - lag) …, e(t)], x and e whitened by `ar`."""
    leads, delays = max(0, -min(lags)), max(0, *lags) + ar.size - 1
    for part in parts:
        begin, end = part.start, part.start + part.errors.size - leads
        smooth = np.convolve(x[begin : end + leads], ar)
        e = np.convolve(part.errors, ar)
        for start in range(delays, end - begin, BLOCK_ROWS):
            stop = min(end - begin, start + BLOCK_ROWS)
            columns = lagged(smooth, lags, start, stop)
            yield np.column_stack((np.ones(stop - start), columns, e[start:stop]))


def _cross(parts: list[SegmentErrors], e: list[FloatArray], z: IOData, rho_e: FloatArray,
           lags: int) -> tuple[FloatArray, float]:
    """Normalised cross-correlation at -lags..lags, and its standard error under independence."""
    u = [z.u[part.start : part.start + part.errors.size] for part in parts]
    mean, n = float(np.concatenate(u).mean()), sum(x.size for x in e)
    u = [x - mean for x in u]
    cov_u = autocovariance(u, rho_e.size - 1)
    var_e = sum(float(np.sum(x**2)) for x in e)
    spread = math.sqrt(var_e * n * cov_u[0]) if cov_u[0] > 0.0 else 1.0
    rho_u = cov_u / cov_u[0] if cov_u[0] > 0.0 else np.eye(1, rho_e.size)[0]
    inflation = max(float(1.0 + 2.0 * rho_e[1:] @ rho_u[1:]), 0.1)
    return n * cross_covariance(e, u, lags) / spread, math.sqrt(inflation / n)
