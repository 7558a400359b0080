"""The cascade C1/C2 as the contract writes it: its gains, its loop, its margins.

    rate reference = kp_angle (angle reference - angle), limited
    u = kp e + ki sum(e) dt - kd D(rate), e = rate reference - rate, limited

D is the difference of the measured rate after a first-order filter; sum and difference are formed
once per cycle, as in the firmware. Other firmware has more filters, and adds a share of the rate
reference. The loop is broken at u, the control input. Linear only: kernels.py has the controller
with its limits, simulation.py time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Protocol

import numpy as np
import numpy.typing as npt

from quad_sysid.axes import EVERY, axis_of
from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.loop import kernels
from quad_sysid.loop.linear import ComplexArray, Loops

FIRMWARE_UNIT = np.degrees(1.0) / 1000.0
"""One firmware unit of gain (µs of motor pulse per deg/s) in normalised command per rad/s."""

CONTRACT_NAMES = {
    'angle_kp': '{place}.kp',
    'rate_kp': 'rate.kp',
    'rate_ki': 'rate.ki',
    'rate_kd': 'rate.kd',
    'd_filter_hz': 'rate.d_filter_hz',
    'output_limit': 'rate.output_limit',
    'integrator_limit': 'rate.integrator_limit',
    'rate_limit': '{place}.rate_limit',
}
"""Field of CascadeGains → the contract's name after `<axis>.`; see `contract_names`."""
FOREIGN_NAMES = {
    'kff': 'rate.kff',
    'target_filter_hz': 'rate.target_filter_hz',
    'error_filter_hz': 'rate.error_filter_hz',
    'output_filter_hz': 'rate.output_filter_hz',
}
"""The same for fields that only other firmware has."""
NOTCH = {'d_notch_hz': 'rate.d_notch_hz', 'd_notch_bandwidth_hz': 'rate.d_notch_bandwidth_hz'}
"""Field of CascadeGains → the contract's name of what all axes share. Notches on the gyro lie
before the logged rate: they are in the identified lag and delay."""
HIGHEST = 0.45
"""Upper edge of a notch, in cycles per control cycle, from which the firmware leaves it out."""

Dynamics = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""Discrete (a, b, c, d) of a controller from (measured rate, angle) to u at reference 0."""

LIGHT, ABOUT = 0.1, np.tan(np.linspace(-1.45, 1.45, 13))
"""Damping ratio below which a resonance needs points of its own, and where they lie about it, in
half-widths: at equal steps of its phase."""

TUNED = ('angle_kp', 'rate_kp', 'rate_ki', 'rate_kd')
"""Gains that a designer may change; the others are constants of the firmware."""


UNFILTERED_HZ = 1e6
"""Cut-off of a filter of D that is none: the sensor's own filter is in the plant."""
SWITCHED_OFF = {'d_filter_hz': UNFILTERED_HZ, 'rate_limit': 1e6, 'integrator_limit': 1e6,
                'output_limit': 1.0}
"""What a filter or limit of 0 does: nothing; of the command, the motors' whole range is left."""
OTHER_FIRMWARE = (*FOREIGN_NAMES.values(), 'rate.tpa_kp')
"""Names after `<axis>.` of which other firmware states at least one beside its gains."""


WORDS = {field: name.format(place='angle') for field, name in CONTRACT_NAMES.items()} \
    | FOREIGN_NAMES | NOTCH
"""Field of CascadeGains → what it is called where no axis is named."""


def of_other_firmware(values: Mapping[str, float], axis: str) -> bool:
    """Whether gains by the contract's names are another firmware's than ours."""
    return any(f'{axis}.{name}' in values for name in OTHER_FIRMWARE)


def contract_names(axis: str) -> dict[str, str]:
    """Field of CascadeGains → the contract's name (`roll.angle.kp`, `climb.height.kp`, …)."""
    place = EVERY[axis].place
    return {field: f'{axis}.{name.format(place=place)}' for field, name in CONTRACT_NAMES.items()}


@dataclass(frozen=True)
class CascadeGains:
    """Gains of one axis, SI (contract, Gains and the form of the controller).

    Of an axis that moves in metres: height for angle, m/s for rad/s.
    """

    angle_kp: float
    """1/s."""
    rate_kp: float
    """Normalised command per rad/s of rate error."""
    rate_ki: float
    """Normalised command per rad."""
    rate_kd: float
    """Normalised command per rad/s²."""
    d_filter_hz: float = 30.0
    output_limit: float = 0.3
    """Limit of u, normalised command."""
    rate_limit: float = 4.0
    """Limit of the rate reference, rad/s."""
    integrator_limit: float = 0.1
    """Limit of the integral part of u, normalised command."""
    kff: float = 0.0
    """Normalised command per rad/s of the filtered rate reference."""
    target_filter_hz: float = 0.0
    """Cut-off of a first-order filter of the rate reference, Hz; of this and the next, 0: none."""
    error_filter_hz: float = 0.0
    """Cut-off of a filter of the rate's error, Hz."""
    output_filter_hz: float = 0.0
    """Cut-off of a filter of u before its limit, Hz; 0: none."""
    d_notch_hz: float = 0.0
    """Centre of a notch before D, Hz; 0: none."""
    d_notch_bandwidth_hz: float = 0.0
    d_on_error: bool = False
    """Whether D acts on the filtered error, not on the measured rate."""

    def __post_init__(self) -> None:
        """Check that all are finite and the constants positive; raises BadInputError."""
        for item in fields(self):
            value, name = getattr(self, item.name), f'gains: {WORDS.get(item.name, item.name)}'
            if not math.isfinite(value):
                raise BadInputError(name, 'must be finite', value)
            if item.name in CONTRACT_NAMES and item.name not in TUNED and value <= 0:
                raise BadInputError(name, 'must be positive', value)
            if item.name.endswith('hz') and value < 0:
                raise BadInputError(name, 'must not be negative', value)

    @classmethod
    def default(cls, axis: str) -> CascadeGains:
        """The paper's start values; for yaw the contract's, for the climb the firmware's.

        For surge and sway some with which an aircraft of this kind holds its place.
        """
        axis_of('gains', axis)
        return STARTS[axis]

    @classmethod
    def from_mapping(cls, values: Mapping[str, float], axis: str) -> CascadeGains:
        """Gains by the contract's names (`roll.angle.kp`, …); missing ones have their defaults.

        A filter or limit that is 0, or that other firmware does not name, is switched off.
        """
        start, notch = cls.default(axis), NOTCH if EVERY[axis].turns else {}
        names = {**contract_names(axis), **notch,
                 **{field: f'{axis}.{name}' for field, name in FOREIGN_NAMES.items()}}
        missing = vars(start) | (SWITCHED_OFF if of_other_firmware(values, axis) else {})
        gains = {field: float(values.get(name, missing[field])) for field, name in names.items()}
        off = {field: value for field, value in SWITCHED_OFF.items() if not gains[field]}
        return cls(**gains | off, d_on_error=values.get(f'{axis}.rate.d_on') in ('error', 1.0))

    def to_mapping(self, axis: str, *, constants: bool = False) -> dict[str, float]:
        """The contract's names and values; with `constants` filter and limits too."""
        return {name: float(getattr(self, field))
                for field, name in contract_names(axis).items()
                if field in TUNED or (constants and getattr(self, field) < UNFILTERED_HZ)}

    def dynamics(self, dt: float) -> Dynamics:
        """The linear controller that the firmware computes: one cycle of it for each unit."""
        m, numbers = kernels.MEMORY, self.constants(dt)._replace(
            output_limit=np.inf, rate_limit=np.inf, integrator_limit=np.inf)
        memory, inputs = np.eye(m + 2, m), np.zeros((m + 2, 3))
        measured, u = np.zeros((2, m + 2)), np.zeros(m + 2)
        measured[[0, 1], [m, m + 1]] = 1.0
        if abs(self.rate_ki) < 1e-9:  # without ki the integral stays at 0: no mode
            memory[kernels.INTEGRAL] = 0.0
        kernels.control_each(numbers, memory, inputs, measured[1], measured[0], u)
        beyond = np.where(np.eye(m) > 0.0, 0.0, memory[:m])
        used = np.abs(beyond).sum(axis=1) + np.abs(u[:m]) > 0.0
        moves, a = memory.T[used], memory.T[used][:, :m][:, used]
        return a, moves[:, m:], u[None, :m][:, used], u[None, m:]

    def response(self, omega: FloatArray, dt: float) -> ComplexArray:
        """(2, f) from the measured rate and angle to u at omega, rad/s, at reference 0."""
        return responses(constants_of([self], dt), omega)[:, 0]

    def constants(self, dt: float) -> kernels.Constants:
        """The numbers of the compiled controller, with a control cycle of dt s."""
        hz, width, notch = self.d_notch_hz, self.d_notch_bandwidth_hz, 1.0
        if hz > 0.0 and width > 0.0 and (hz + 0.5 * width) * dt < HIGHEST:
            notch = 1.0 / (1.0 + np.tan(np.pi * width * dt))
        values = vars(self) | {
            'dt': dt, 'notch': notch, 'notch_turn': -2.0 * notch * np.cos(2.0 * np.pi * hz * dt),
            'notch_keep': 2.0 * notch - 1.0,
            **{f'{name}_weight': weight_of(getattr(self, f'{name}_filter_hz'), dt)
               for name in ('d', 'target', 'error', 'output')},
        }
        return kernels.Constants(*(float(values[name]) for name in kernels.Constants._fields))


STARTS = dict.fromkeys(('roll', 'pitch'), CascadeGains(
    3.0, 1.3 * FIRMWARE_UNIT, 0.01 * FIRMWARE_UNIT, 0.023 * FIRMWARE_UNIT)) | {
    'yaw': CascadeGains(2.0, 3.0 * FIRMWARE_UNIT, 0.02 * FIRMWARE_UNIT, 0.0),
    'climb': CascadeGains(1.0, 0.1, 0.05, 0.01, UNFILTERED_HZ, rate_limit=1.0,
                          integrator_limit=0.2),
} | dict.fromkeys(('surge', 'sway'), CascadeGains(
    0.6, 0.12, 0.02, 0.0, UNFILTERED_HZ, output_limit=0.35, rate_limit=2.0, integrator_limit=0.15))


def weight_of(cutoff_hz: float, dt: float) -> float:
    """Weight of the new value in a first-order filter: dt / (dt + 1 / (2 pi f)), backward Euler.

    1 without a filter.
    """
    return dt / (dt + 1.0 / (2.0 * np.pi * cutoff_hz)) if cutoff_hz > 0.0 else 1.0


def constants_of(sets: Sequence[CascadeGains], dt: float) -> npt.NDArray[np.void]:
    """(g,) the constants of each, by their names."""
    return np.array([one.constants(dt) for one in sets], kernels.EACH)


def responses(constants: npt.NDArray[np.void], omega: FloatArray) -> ComplexArray:
    """(2, g, f) from the measured rate and angle to u at omega, rad/s, at reference 0.

    constants (g,): of controllers with one control cycle.
    """
    each, dt = constants[:, None], float(constants['dt'][0])
    back = np.exp(-1j * omega * dt)

    def behind(which: str) -> ComplexArray:
        weight = each[f'{which}_weight']
        return np.asarray(weight / (1.0 - (1.0 - weight) * back))

    late, turns = behind('error'), (1.0 - back) / dt
    error = (each['rate_kp'] + each['rate_ki'] / turns) * late
    derivative = each['rate_kd'] * turns * behind('d')
    if np.any(each['notch'] < 1.0):
        turn = each['notch_turn'] * back
        notched = (each['notch'] * (1.0 + back**2) + turn) / (
            1.0 + turn + each['notch_keep'] * back**2)
        derivative = derivative * np.where(each['notch'] < 1.0, notched, 1.0)
    on_error = each['d_on_error'] > 0.0
    derivative = derivative * np.where(on_error, late, 1.0)
    forward = error + np.where(on_error, derivative, 0.0) + each['kff']
    angle = each['angle_kp'] * behind('target') * forward
    return np.stack([-error - derivative, -angle]) * behind('output')


class Controller(Protocol):
    """A controller whose margins can be judged: a cascade, a state feedback, a mixture of both."""

    def dynamics(self, dt: float) -> Dynamics:
        """The linear controller, with a control cycle of dt s."""
        ...

    def response(self, omega: FloatArray, dt: float) -> ComplexArray:
        """(2, f) from the measured rate and angle to u at omega, rad/s, at reference 0."""
        ...


@dataclass(frozen=True)
class Linear:
    """A controller by its matrices alone."""

    matrices: Dynamics

    def dynamics(self, dt: float) -> Dynamics:
        """The matrices, which are of one control cycle."""
        del dt
        return self.matrices

    def response(self, omega: FloatArray, dt: float) -> ComplexArray:
        """(2, f) from the measured rate and angle to u at omega, rad/s."""
        a, b, c, d = self.matrices
        z = np.exp(1j * omega * dt)
        states = np.linalg.solve(z[:, None, None] * np.eye(a.shape[0]) - a, b[None])
        return np.asarray((c @ states + d)[:, 0, :].T)


def open_loop(controller: Controller, plant: ComplexArray, omega: FloatArray,
              dt: float) -> ComplexArray:
    """Loop gain (p, f) broken at the control input; plant (2, p, f) from `Loops.response`."""
    rate, angle = controller.response(omega, dt)
    return np.asarray(-(plant[0] * rate + plant[1] * angle))


def reference_response(controller: Controller, plant: ComplexArray, omega: FloatArray,
                       dt: float) -> ComplexArray:
    """(p, f) response of the measured angle to the angle reference."""
    loop = open_loop(controller, plant, omega, dt)
    return np.asarray(-plant[1] * controller.response(omega, dt)[1] / (1.0 + loop))


def noise_response(controller: Controller, plant: ComplexArray, omega: FloatArray,
                   dt: float) -> ComplexArray:
    """(p, f) response of the control to noise on the measured rate."""
    loop = open_loop(controller, plant, omega, dt)
    return np.asarray(controller.response(omega, dt)[0] / (1.0 + loop))


def frequency_grid(dt: float, points: int = 240, lowest_rad_s: float = 0.1,
                   loops: Loops | None = None) -> FloatArray:
    """(points, or more) rad/s, logarithmic up to just below the Nyquist frequency.

    With further points about the lightly damped resonances of `loops`, where a loop gain turns
    within less than the distance of two points and may pass -1 unseen.
    """
    grid = np.geomspace(lowest_rad_s, 0.999 * np.pi / dt, points)
    if loops is None:
        return grid
    z = np.linalg.eigvals(loops.a).ravel().astype(complex)
    s = np.log(z[np.abs(z) > 1e-6]) / dt
    s = s[(s.imag > grid[0]) & (s.imag < grid[-1]) & (np.abs(s.real) < LIGHT * np.abs(s))]
    about = s.imag[:, None] + np.abs(s.real)[:, None] * ABOUT
    order, chosen = np.argsort(about, axis=None), [0.0]
    near, widths = about.ravel()[order], np.abs(s.real).repeat(ABOUT.size)[order]
    for omega, width in zip(near, widths, strict=True):  # of resonances side by side a few do
        if omega - chosen[-1] > 0.1 * width and grid[0] < omega < grid[-1]:
            chosen.append(omega)
    return np.union1d(grid, chosen[1:])


@dataclass(frozen=True)
class Margins:
    """Margins of p loops, (p,) each; only meaningful where the closed loop is stable.

    The smallest margin counts if |L| or its phase crosses several times, gain reduction margins
    included. Without a crossing the margin is infinite, the crossover NaN.
    """

    phase_margin_deg: FloatArray
    gain_margin_db: FloatArray
    peak_sensitivity: FloatArray
    crossover_rad_s: FloatArray
    """Highest frequency where |L| falls through 1."""


def margins(loop: ComplexArray, omega: FloatArray) -> Margins:
    """Margins of loop gains (p, f) on a grid omega (f,), crossings interpolated linearly."""
    out = np.empty((4, len(loop)))
    kernels.margins(np.ascontiguousarray(loop), np.log(omega), out)
    return Margins(*out)


def bandwidth(response: ComplexArray, omega: FloatArray) -> FloatArray:
    """(p,) rad/s where |response| (p, f) first falls below its low-frequency value by 3 dB.

    Interpolated as margins are; NaN where it never does.
    """
    level = np.log(np.abs(response) / np.abs(response[:, :1])) - 0.5 * np.log(0.5)
    row, index = np.arange(len(level)), np.maximum(np.argmax(level < 0.0, axis=1), 1)
    high, low = level[row, index - 1], level[row, index]
    share = high / np.where(low < 0.0, high - low, np.inf)
    interpolated = omega[index - 1] * (omega[index] / omega[index - 1]) ** share
    return np.where(low < 0.0, interpolated, np.nan)


def closed_loop_radius(controller: Controller, loops: Loops) -> FloatArray:
    """(p,) largest absolute eigenvalue of the linear closed loop; stable below 1.

    The states are those of the plant, the commands in the delay, and the controller's.
    """
    ca, cb, cc, cd = controller.dynamics(loops.dt)
    p, n = loops.b.shape
    control = np.zeros((p, n + len(ca)))
    control[:, :n], control[:, n:] = cd[0] @ loops.c, cc[0]
    matrix = np.zeros((p, n + len(ca), n + len(ca)))
    matrix[:, :n, :n] = loops.a
    matrix[:, :n] += loops.b[:, :, None] * control[:, None]
    matrix[:, n:, :n], matrix[:, n:, n:] = cb @ loops.c, ca
    return np.asarray(np.max(np.abs(np.linalg.eigvals(matrix)), axis=1))
