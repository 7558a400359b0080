"""Known plants behind the paper's cascade, as records for studies and tests of the estimators.

Not part of any analysis: nothing that identifies imports this file.
"""

from dataclasses import dataclass, field

import numba
import numpy as np
from scipy.signal import max_len_seq

from quad_sysid.blackbox.model import Model, polynomial_model
from quad_sysid.contract import FloatArray
from quad_sysid.record import IOData


@dataclass(frozen=True)
class Cascade:
    """C1 and C2 of the contract without limits: gains in the plant's own units."""

    angle_kp: float = 3.0
    rate_kp: float = 1.3
    rate_ki: float = 0.01
    rate_kd: float = 0.023
    d_filter_hz: float = 30.0


@dataclass(frozen=True)
class Study:
    """A true model, the loop around it and the reference that excites it."""

    truth: Model
    cascade: Cascade = field(default_factory=Cascade)
    amplitude: float = 20.0
    bits: int = 9
    clock_s: float = 0.03
    samples: int = 15_000

    def record(self, rng: np.random.Generator, *, closed: bool = True) -> IOData:
        """One record (u, y, r): new innovations and a new start of the shift register."""
        n, dt = self.samples, self.truth.dt
        bits = prbs_bits(self.bits, int(rng.integers(1, 2**self.bits)))
        clocks = np.floor(np.arange(n) * dt / self.clock_s + 1e-9).astype(int)
        r = self.amplitude * bits[clocks % bits.size]
        e = rng.standard_normal(n) * np.sqrt(self.truth.noise_variance)
        u, y = run_loop(self.truth, self.cascade, r, e, closed=closed)
        return IOData(u=u, y=y, dt=dt, r=r)


def reference_study() -> Study:
    """Build the study 20/((s + 0.3)(0.05 s + 1)) behind 2 samples, BJ 2 2 2 2 3 at 250 Hz."""
    dt = 0.004
    slow, fast = np.exp(-0.3 * dt), np.exp(-dt / 0.05)
    # Residues of 20/(0.05 s (s + 0.3)(s + 20)), sampled behind a zero-order hold.
    dc, k1, k2 = 400.0 / 6.0, -400.0 / (0.3 * 19.7), 400.0 / (20.0 * 19.7)
    b1 = k1 * (1.0 - slow) * -1.0 + k2 * (1.0 - fast) * -1.0
    b2 = -(dc + k1 + k2) + k1 * (1.0 - slow) * fast + k2 * (1.0 - fast) * slow
    truth = polynomial_model(
        [0.0, 0.0, 0.0, b1, b2], F=[1.0, -(slow + fast), slow * fast], C=[1.0, 0.4, 0.1],
        D=[1.0, -1.5, 0.62], dt=dt, noise_variance=0.25,
    )
    return Study(truth)


def prbs_bits(bits: int, state: int) -> FloatArray:
    """One period, 2^bits - 1 entries of ±1, of the maximal shift register from `state`."""
    tap = {5: 2, 6: 1, 7: 1, 9: 4, 10: 3, 11: 2}[bits]
    begin = [state >> k & 1 for k in range(bits)]
    return 2.0 * max_len_seq(bits, begin, taps=[tap])[0] - 1.0


def run_loop(
    truth: Model, cascade: Cascade, r: FloatArray, e: FloatArray, *, closed: bool = True
) -> tuple[FloatArray, FloatArray]:
    """u, y (n,) of the loop at angle reference r (n,) and innovations e (n,); open: u = r."""
    u, y = np.zeros(r.size), np.zeros(r.size)
    dt = truth.dt
    alpha = float(1.0 - np.exp(-2.0 * np.pi * cascade.d_filter_hz * dt))
    gains = np.array([cascade.angle_kp, cascade.rate_kp, cascade.rate_ki, cascade.rate_kd, alpha])
    polys = [np.array(p) for p in (truth.A, truth.B, truth.C, truth.D, truth.F)]
    a, b, c, d, f = polys
    _run_loop(a, b, c, d, f, gains, dt, closed, np.array(r), np.array(e), u, y)
    return u, y


@numba.njit(
    'void(float64[::1],float64[::1],float64[::1],float64[::1],float64[::1],float64[::1],'
    'float64,boolean,float64[::1],float64[::1],float64[::1],float64[::1])',
    cache=True,
)
def _run_loop(a, b, c, d, f, gains, dt, closed, r, e, u, y):  # type: ignore[no-untyped-def]
    """Sample the plant, then the controller of the same cycle; b[0] must be 0 when closed."""
    n = r.size
    w, v = np.zeros(n), np.zeros(n)
    angle, integral, derivative, last = 0.0, 0.0, 0.0, 0.0
    for t in range(n):
        if not closed:
            u[t] = r[t]
        for i in range(min(b.size, t + 1)):
            w[t] += b[i] * u[t - i]
        for i in range(1, min(f.size, t + 1)):
            w[t] -= f[i] * w[t - i]
        for i in range(min(c.size, t + 1)):
            v[t] += c[i] * e[t - i]
        for i in range(1, min(d.size, t + 1)):
            v[t] -= d[i] * v[t - i]
        y[t] = w[t] + v[t]
        for i in range(1, min(a.size, t + 1)):
            y[t] -= a[i] * y[t - i]
        if closed:
            angle += dt * y[t]
            error = gains[0] * (r[t] - angle) - y[t]
            integral += gains[2] * error * dt
            derivative += gains[4] * ((y[t] - last) / dt - derivative)
            last = y[t]
            u[t] = gains[1] * error + integral - gains[3] * derivative
