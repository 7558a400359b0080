"""Step response of set-point tracking by regularised deconvolution. Array maths only.

As PID-Analyzer and PIDtoolbox measure it, from whatever the pilot flew: output = response *
set-point in windows. They divide spectra of tapered windows and damp what lies above 25 Hz; here
the impulse response is a least-squares fit in the time domain, whose windows see the set-point
before them and need no taper. Regularisation: the prior of a stable, smooth impulse response
(the TC kernel of Chen, Ohlsson and Ljung, Automatica 48, 2012: covariance size · decay^max(i, j)),
whose size and decay have the highest evidence on all windows together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.fft import next_fast_len
from scipy.signal import fftconvolve

from quad_sysid.contract import FloatArray
from quad_sysid.loop.figures import StepFigures, step_figures
from quad_sysid.record import finite_runs

MOST_WINDOWS = 240
"""Windows that suffice: in a longer flight they lie further apart."""
LAGS = 250
"""Most samples of a response: finer ones are averaged before."""
DECAYS = (0.02, 0.04, 0.08, 0.16, 0.32, 0.64)
"""Time constants that are tried for the prior, as shares of the response."""
SIZES = (0.01, 0.1, 1.0, 10.0, 100.0)
"""Sizes that are tried for the prior, in units of a response that ends at 1."""
LEAST_RUN = 3.0
"""Length of a stretch without gaps in which windows lie, in lengths of the response."""
RIDGE = 1e-6
"""Share of the mean power added where the noise is estimated without a prior."""
COARSE = 50
"""Samples of the response with which the prior is sought, and the spread between windows."""
MIN_WINDOWS = 10
"""Windows from which a response is stated."""
LEAST_FIT, LEAST_END = 0.5, 0.3
"""Share of the output's variance that a response must explain, and of the step at which it must
end, to be stated: else something other than the set-point moves the output."""
LEAST_SURE = 0.03
"""Largest standard deviation, as a share of the step, with which a class is stated: windows of one
class may hold high frequencies alone, as a chirp's whose size falls, and no end of the step."""


@dataclass(frozen=True)
class Loop:
    """Settings for the step response of one loop, rate or angle."""

    quantity: str
    seconds: float
    """Length of the response."""
    classes: tuple[tuple[str, float, float], ...]
    """Name, and the range of a window's largest set-point, rad/s or rad."""


_D = np.pi / 180.0
RATE = Loop('rate', 0.5, (('small', 20 * _D, 100 * _D), ('medium', 100 * _D, 500 * _D),
                          ('large', 500 * _D, np.inf)))
ANGLE = Loop('angle', 2.0, (('small', 1 * _D, 10 * _D), ('medium', 10 * _D, 30 * _D),
                            ('large', 30 * _D, np.inf)))


@dataclass(frozen=True)
class Response:
    """The step response of one class of windows."""

    quantity: str
    """`rate` or `angle`."""
    amplitude: str
    """`all`, `small`, `medium`, `large`."""
    time_s: FloatArray
    """(m,) s after the step."""
    mean: FloatArray
    """(m,) share of the step."""
    low: FloatArray
    high: FloatArray
    """(m,) each: the spread between windows. Where a window says nothing it stays at the mean."""
    windows: int
    fit: float
    """Share of the output's variance in these windows that the response explains."""
    figures: StepFigures
    latency_s: float
    """Time until half of the step."""
    largest: float
    """Largest set-point in the windows, rad/s or rad."""


@dataclass(frozen=True)
class _Windows:
    """What each window says, about its means. Lag j of row t is the set-point at t - j."""

    past: FloatArray
    """(k, m - 1 + rows) the set-point, from m - 1 samples before the window on."""
    output: FloatArray
    """(k, rows), less its mean."""
    first: FloatArray
    """(k, m) sum over the rows of the set-point and itself at each lag, means included."""
    cross: FloatArray
    """(k, m) the same with the output."""
    sums: FloatArray
    """(k, m) sum over the rows of each lag."""
    coarse: FloatArray
    """(k, rows, c) sums of neighbouring lags, less their means."""
    gram: FloatArray
    """(k, c, c) their products."""
    largest: FloatArray
    """(k,) largest set-point."""

    @property
    def rows(self) -> int:
        """Samples of a window."""
        return int(self.output.shape[1])

    def full(self, inside: npt.NDArray[np.bool_]) -> FloatArray:
        """(m, m) products of the lags, summed over windows.

        One lag further both factors move back by a sample: one product enters, one leaves.
        """
        m = self.first.shape[1]
        enter, leave = self.past[inside, m - 2::-1], self.past[inside, :-m - 1:-1]
        enter = np.column_stack([enter, np.zeros(len(enter))])  # the last lag goes no further
        change = enter.T @ enter - leave.T @ leave
        out = np.empty((m, m))
        out[0] = self.first[inside].sum(axis=0)
        for i in range(m - 1):
            out[i + 1, i + 1:] = out[i, i:-1] + change[i, i:-1]
        below = np.tril_indices(m, -1)
        out[below] = out.T[below]
        sums = self.sums[inside]
        return np.asarray(out - sums.T @ sums / self.rows)


def responses(setpoint: FloatArray, output: FloatArray, usable: npt.NDArray[np.bool_], dt: float,
              loop: Loop = RATE) -> tuple[Response, ...]:
    """The responses of all windows and of each class that has enough of them.

    `setpoint`, `output`, `usable` (n,): where windows may lie. Empty where nothing moves.
    """
    every = max(1, round(loop.seconds / LAGS / dt))
    is_finite = usable & np.isfinite(setpoint) & np.isfinite(output)
    step, m = every * dt, round(loop.seconds / (every * dt))
    if m < 10:
        return ()
    runs = [(_thinned(setpoint[a:b], every), _thinned(output[a:b], every))
            for a, b in finite_runs(is_finite, (0, len(is_finite)))
            if (b - a) * dt > LEAST_RUN * loop.seconds]
    windows = _windows(runs, m, round(2.0 * loop.seconds / step))
    least = loop.classes[0][1]
    used = windows.largest >= least if windows is not None else np.zeros(0, bool)
    if windows is None or used.sum() < MIN_WINDOWS:
        return ()
    out = []
    for name, low, high in (('all', least, np.inf), *loop.classes):
        inside = (windows.largest >= low) & (windows.largest < high)
        if inside.sum() < MIN_WINDOWS or (name != 'all' and inside.sum() == used.sum()):
            continue
        response = _response(windows, inside, step, loop.quantity, name)
        out += [response] if response is not None else []
    return tuple(out)


def _thinned(x: FloatArray, every: int) -> FloatArray:
    """Means over `every` samples: the same average of input and output leaves the response."""
    length = len(x) // every * every
    return np.asarray(x[:length].reshape(-1, every).mean(axis=1))


def _windows(runs: Sequence[tuple[FloatArray, FloatArray]], m: int, rows: int) -> _Windows | None:
    """Cut the runs of set-point and output into windows that overlap."""
    hop = max(1, round(0.5 * rows), sum(len(r) for r, _ in runs) // MOST_WINDOWS)
    cuts = [(r, y, np.arange(m, len(r) - rows + 1, hop)[:, None]) for r, y in runs]
    cuts = [cut for cut in cuts if len(cut[2])]
    if not cuts:
        return None
    earlier = np.concatenate([r[index + np.arange(1 - m, rows)] for r, _, index in cuts])
    output = np.concatenate([y[index + np.arange(rows)] for _, y, index in cuts])
    output -= output.mean(axis=1, keepdims=True)
    here = earlier[:, m - 1:]
    total = np.cumsum(np.pad(earlier, ((0, 0), (1, 0))), axis=1)
    width = max(1, m // COARSE)
    edges = np.minimum(np.arange(0, m + width, width), m)
    edges = edges[:np.searchsorted(edges, m) + 1]
    index = m + np.arange(rows)[:, None]
    coarse = total[:, index - edges[:-1]] - total[:, index - edges[1:]]
    coarse -= coarse.mean(axis=1, keepdims=True)
    return _Windows(
        earlier, output, _correlation(here, earlier, m), _correlation(output, earlier, m),
        total[:, m - 1 + rows - np.arange(m)] - total[:, m - 1 - np.arange(m)],
        coarse, coarse.transpose(0, 2, 1) @ coarse, np.abs(here).max(axis=1))


def _correlation(signal: FloatArray, past: FloatArray, m: int) -> FloatArray:
    """(k, m) sums over the rows of a signal (k, rows) and the set-point at each lag."""
    size = next_fast_len(past.shape[1], real=True)
    product = np.conj(np.fft.rfft(signal, size)) * np.fft.rfft(past, size)
    return np.asarray(np.fft.irfft(product, size)[:, m - 1::-1])


def _response(windows: _Windows, inside: npt.NDArray[np.bool_], step: float, quantity: str,
              name: str) -> Response | None:
    gram, cross = windows.full(inside), windows.cross[inside].sum(axis=0)
    output = windows.output[inside]
    power, rows = float(np.sum(output**2)), output.size
    if power <= 0.0:
        return None
    m = len(cross)
    group = np.eye(-(-m // max(1, m // COARSE))).repeat(max(1, m // COARSE), axis=0)[:m]
    grouped = group.T @ gram @ group
    sizes = np.linalg.eigvalsh(grouped)
    if sizes[0] <= -RIDGE * sizes[-1]:  # the set-point stands still: this is rounding
        return None
    share, size, noise = _prior(grouped, group.T @ cross, power, rows, m)
    precision = gram / noise + _precision(m, m, share, size)[0]
    impulse = np.linalg.solve(precision, cross / noise)
    fit = 1.0 - (power - 2.0 * impulse @ cross + impulse @ gram @ impulse) / power
    mean = np.cumsum(impulse)
    figures = _figures(mean, step)
    if not (fit >= LEAST_FIT and figures.final_error_pct <= 100.0 * (1.0 - LEAST_END)):
        return None
    sums = np.tri(m)
    if name != 'all' and np.sum(sums * np.linalg.solve(precision, sums.T).T, axis=1).max() > (
            LEAST_SURE**2):
        return None
    residual = output - fftconvolve(windows.past[inside], impulse[None], mode='valid', axes=1)
    residual = (residual[:, None, :] @ windows.coarse[inside])[:, 0]
    prior = noise * _precision(group.shape[1], m, share, size)[0]
    solved = np.linalg.solve(windows.gram[inside] + prior, residual[:, :, None])
    by_window = solved[:, :, 0] @ group.T
    low, high = np.percentile(mean + np.cumsum(by_window, axis=1), (16.0, 84.0), axis=0)  # a sigma
    half = int(np.argmax(mean >= 0.5))
    reached = bool(mean[half] >= 0.5)
    offset = mean[half - 1] if half else 0.0
    latency = step * (half - 1 + (0.5 - offset) / (mean[half] - offset)) if reached else np.nan
    times = np.asarray(step * np.arange(len(mean)), float)
    return Response(quantity, name, times, mean, low, high,
                    int(inside.sum()), float(fit), figures,
                    float(max(latency, 0.0) if reached else np.nan),
                    float(windows.largest[inside].max()))


def _figures(mean: FloatArray, step: float) -> StepFigures:
    """The figures of a response; of one that still rises at its end only how far it came.

    Where it would stand is not seen there, so that neither has it gone beyond nor risen to it.
    """
    figures, last = step_figures(mean, step), max(2, mean.size // 5)
    if np.isfinite(figures.settling_time_s) or int(np.argmax(mean)) < mean.size - last:
        return figures
    return replace(figures, rise_time_s=np.nan, overshoot_pct=np.nan)


def _prior(gram: FloatArray, cross: FloatArray, power: float, rows: int,
           lags: int) -> tuple[float, float, float]:
    """Decay and size of the prior with the highest evidence, and the variance of the noise."""
    m = len(cross)
    plain = np.linalg.solve(gram + RIDGE * np.trace(gram) / m * np.eye(m), cross)
    noise = max((power - float(plain @ cross)) / rows, 1e-9 * power / rows)
    best, chosen = np.inf, (DECAYS[0], 1.0)
    for share in DECAYS:
        for size in SIZES:
            prior, log_determinant = _precision(m, lags, share, size)
            factor = np.linalg.cholesky(gram / noise + prior)
            whitened = np.linalg.solve(factor, cross / noise)
            cost = (2.0 * float(np.sum(np.log(np.diag(factor)))) - log_determinant
                    - float(whitened @ whitened))
            if cost < best:
                best, chosen = cost, (share, size)
    return *chosen, noise


def _precision(m: int, lags: int, share: float, size: float) -> tuple[FloatArray, float]:
    """The inverse (m, m) of size / (lags share) · decay^max(i, j), and its log determinant.

    The steps between neighbours are independent, of variance decay^i - decay^(i + 1).
    """
    i = np.arange(1, m + 1)
    decay = np.exp(-1.0 / (share * m))
    weight = lags * share / size / np.append(decay**i[:-1] * (1.0 - decay), decay**m)
    difference = np.eye(m) - np.eye(m, k=1)
    return difference.T @ (weight[:, None] * difference), float(np.sum(np.log(weight)))
