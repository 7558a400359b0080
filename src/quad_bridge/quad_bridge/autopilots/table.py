"""Gains of PX4 and ArduPilot by the contract's names: a table for each autopilot. Pure.

The bridge reads and writes parameters by these tables, and `quad-tune export` writes files by
them; it has this file by a link (`autopilot_table.py`), so nothing of ours is imported here. Ours
are commands U2..U4 per rad/s, theirs a normalised torque per rad/s; `units` is U per torque, of
roll, pitch and yaw.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

AXES = ('roll', 'pitch', 'yaw')
Units = tuple[float, float, float]
Limits = tuple[float, float]
DEGREE = math.pi / 180.0
D_FILTER = 'rate.d_filter_hz'
AUTOPILOT = 'loop.autopilot'
"""A constant beside the gains: whose they are (MAV_AUTOPILOT), and so what they may be."""


class UnfitError(ValueError):
    """A gain that a parameter cannot take, in one line."""


@dataclass(frozen=True)
class Row:
    """One gain. In `theirs`, {} is the autopilot's name of the axis, {first} its first letter."""

    ours: str
    parameter: str
    limits: Limits | None = None
    """Bounds of the parameter in the autopilot's own list; None: it is never written."""
    yaw_limits: Limits | None = None
    factor: float = 1.0
    torque: bool = False
    """Whether it is in their unit of torque."""
    multiplied: bool = False
    """Whether the table's `multiplier` acts on it."""

    def span(self, axis: int) -> Limits | None:
        """Bounds of the parameter of an axis, by its number."""
        return (self.yaw_limits if axis == 2 else None) or self.limits

    def name(self, axis: str) -> str:
        """The parameter's name; `axis` as the autopilot calls it."""
        return self.parameter.format(axis, first=axis[:1])


@dataclass(frozen=True)
class Table:
    """The gains of one autopilot."""

    number: int
    """MAV_AUTOPILOT."""
    axes: tuple[str, str, str]
    rows: tuple[Row, ...]
    shared: tuple[Row, ...]
    """Rows of the whole aircraft, whose `ours` is the full contract name."""
    multiplier: str = ''
    """A parameter of each axis that multiplies P, I and D."""
    d_on_error: bool = False
    """Whether D acts on the error, not on the measured rate."""
    former: Mapping[str, str] = field(default_factory=dict)
    """Parameters' names of earlier releases, which logs still hold → today's."""

    def of_axes(self) -> Iterator[tuple[str, int, Row, str]]:
        """Contract name, number of the axis, row and parameter of each gain of an axis."""
        for i, axis in enumerate(AXES):
            for row in self.rows:
                if '{' in row.parameter or row.ours == D_FILTER:
                    yield f'{axis}.{row.ours}', i, row, row.name(self.axes[i])

    @cached_property
    def names(self) -> tuple[str, ...]:
        """All parameters that are to be read."""
        names = [name for *_, name in self.of_axes()]
        names += [self.multiplier.format(axis) for axis in self.axes if self.multiplier]
        return tuple(dict.fromkeys([*names, *(row.parameter for row in self.shared)]))

    @property
    def logged(self) -> tuple[str, ...]:
        """All parameters that a log of any release may hold."""
        return (*self.names, *self.former)

    @cached_property
    def written(self) -> tuple[str, ...]:
        """Parameters that an update may write, which together are a set."""
        return tuple(dict.fromkeys(n for _, _, row, n in self.of_axes() if row.limits))

    @property
    def ranges(self) -> dict[str, Limits]:
        """What each parameter may be, in the autopilot's own list."""
        return {parameter: span for _, i, row, parameter in self.of_axes()
                if (span := row.span(i))}

    @property
    def in_common(self) -> frozenset[str]:
        """Contract names whose parameter is one for all axes."""
        return frozenset(n for n, _, row, _ in self.of_axes() if '{' not in row.parameter)

    def factor(self, row: Row, axis: int, known: Mapping[str, float], units: Units) -> float:
        """Ours per theirs."""
        multiplier = known.get(self.multiplier.format(self.axes[axis]), 1.0)
        return (row.factor * (units[axis] if row.torque else 1.0)
                * (multiplier if row.multiplied else 1.0))

    def gains(self, known: Mapping[str, float], units: Units) -> dict[str, float]:
        """Gains by contract name, SI, from parameters; a limit or filter of 0 is left out."""
        known = {now: known[old] for old, now in self.former.items() if old in known} | dict(known)
        gains = {}
        for gain, axis, row, parameter in self.of_axes():
            value = known.get(parameter)
            if value is not None and (value > 0.0 or not gain.endswith(('limit', '_hz'))):
                gains[gain] = float(value * self.factor(row, axis, known, units))
        for name, unit in zip(AXES, units, strict=True):
            if f'{name}.rate.kp' in gains:
                gains[f'{name}.rate.output_limit'] = float(unit)
                gains[AUTOPILOT] = float(self.number)
                if self.d_on_error:
                    gains[f'{name}.rate.d_on'] = 1.0
        for row in self.shared:
            if known.get(row.parameter, 0.0) > 0.0:
                gains[row.ours] = float(known[row.parameter] * row.factor)
        return gains

    def limits(self, axis: int, units: Units) -> dict[str, Limits]:
        """Lowest and highest value, ours, of each gain of an axis that can be written."""
        limits = {}
        for gain, i, row, _ in self.of_axes():
            span = row.span(i)
            if i == axis and span is not None:
                factor = self.factor(row, axis, {}, units)
                limits[gain] = span[0] * factor, span[1] * factor
        return limits

    def parameters(
        self, gains: Mapping[str, float], known: Mapping[str, float], units: Units
    ) -> dict[str, float]:
        """Parameters for these gains; one that all axes share gets the lowest of their values.

        Raises UnfitError where one has no parameter, or leaves what the parameter may be.
        """
        parameters: dict[str, float] = {}
        rows = {gain: (axis, row, parameter) for gain, axis, row, parameter in self.of_axes()}
        for gain, value in gains.items():
            entry = rows.get(gain)
            if entry is None or entry[1].limits is None:
                raise UnfitError(f'{gain}: this autopilot has no such gain that can be set')
            axis, row, parameter = entry
            factor = self.factor(row, axis, known, units)
            new = value / factor if factor else math.nan
            low, high = row.span(axis) or (0.0, 0.0)
            slack = 1e-6 * high
            if not low - slack <= new <= high + slack:
                raise UnfitError(
                    f'{gain}: {parameter} must lie in {low:g} .. {high:g}: found {new:.4g}'
                )
            parameters[parameter] = min(new, parameters.get(parameter, sys.float_info.max))
        return parameters


PX4 = Table(
    12,
    ('ROLL', 'PITCH', 'YAW'),
    (
        Row('angle.kp', 'MC_{}_P', (0.0, 12.0), (0.0, 5.0)),
        Row('rate.kp', 'MC_{}RATE_P', (0.01, 0.6), (0.0, 0.6), torque=True, multiplied=True),
        Row('rate.ki', 'MC_{}RATE_I', (0.0, 5.0), torque=True, multiplied=True),
        Row('rate.kd', 'MC_{}RATE_D', (0.0, 0.01), torque=True, multiplied=True),
        Row('rate.kff', 'MC_{}RATE_FF', torque=True),
        Row('angle.rate_limit', 'MC_{}RATE_MAX', factor=DEGREE),
        Row('rate.integrator_limit', 'MC_{first}R_INT_LIM', torque=True),
        Row(D_FILTER, 'IMU_DGYRO_CUTOFF', (10.0, 200.0)),
    ),
    (
        Row('sensor.gyro_filter_hz', 'IMU_GYRO_CUTOFF'),
        Row('sensor.notch_1_hz', 'IMU_GYRO_NF0_FRQ'),
        Row('sensor.notch_1_bandwidth_hz', 'IMU_GYRO_NF0_BW'),
        Row('yaw.rate.output_filter_hz', 'MC_YAW_TQ_CUTOFF'),
    ),
    'MC_{}RATE_K',
    former={'MC_DTERM_CUTOFF': 'IMU_DGYRO_CUTOFF', 'IMU_GYRO_NF_FREQ': 'IMU_GYRO_NF0_FRQ',
            'IMU_GYRO_NF_BW': 'IMU_GYRO_NF0_BW'},
)
ARDUPILOT = Table(
    3,
    ('RLL', 'PIT', 'YAW'),
    (
        Row('angle.kp', 'ATC_ANG_{}_P', (3.0, 12.0)),
        Row('rate.kp', 'ATC_RAT_{}_P', (0.01, 0.5), (0.05, 2.5), torque=True),
        Row('rate.ki', 'ATC_RAT_{}_I', (0.0, 1.0), torque=True),
        Row('rate.kd', 'ATC_RAT_{}_D', (0.0, 0.05), torque=True),
        Row('rate.kff', 'ATC_RAT_{}_FF', torque=True),
        Row('angle.rate_limit', 'ATC_RATE_{first}_MAX', factor=DEGREE),
        Row('rate.integrator_limit', 'ATC_RAT_{}_IMAX', torque=True),
        Row(D_FILTER, 'ATC_RAT_{}_FLTD', (5.0, 100.0)),
        Row('rate.target_filter_hz', 'ATC_RAT_{}_FLTT'),
        Row('rate.error_filter_hz', 'ATC_RAT_{}_FLTE'),
    ),
    (Row('sensor.gyro_filter_hz', 'INS_GYRO_FILTER'),),
    d_on_error=True,
    # Copter 3.4 to 3.6 filtered D alone of roll and pitch, and the whole error of yaw
    former={'ATC_RAT_RLL_FILT': 'ATC_RAT_RLL_FLTD', 'ATC_RAT_PIT_FILT': 'ATC_RAT_PIT_FLTD',
            'ATC_RAT_YAW_FILT': 'ATC_RAT_YAW_FLTE'},
)
TABLES = {table.number: table for table in (PX4, ARDUPILOT)}


def px4_units(mixer: npt.NDArray[np.float64], x: Sequence[float], y: Sequence[float]) -> Units:
    """U per torque of PX4's control allocation; `mixer` of a craft, `x` and `y` of its motors.

    PX4 scales its allocation so that roll and pitch have a root mean square of 1/√2 over their
    motors, both by the larger of their scales, and yaw a largest entry of 1.
    """
    size = np.array([np.abs(y).sum(), np.abs(x).sum(), 1.0])  # of geometry per row of U
    columns = mixer[:, 1:] / size
    used = np.maximum((np.abs(columns) > 1e-9).sum(axis=0), 1)
    scale = np.sqrt((columns**2).sum(axis=0) / (used / 2.0))
    scale[:2], scale[2] = scale[:2].max(), np.abs(columns[:, 2]).max()
    roll, pitch, yaw = (1.0 / (scale * size)).tolist()
    return roll, pitch, yaw


def ardupilot_units(mixer: npt.NDArray[np.float64], known: Mapping[str, float]) -> Units:
    """U per torque of ArduPilot's mixer, near hover: the thrust curve's slope is in it.

    The largest factor of each axis is 0.5; thrust becomes a command by MOT_THST_EXPO, between
    MOT_SPIN_MIN and MOT_SPIN_MAX.
    """
    expo = min(max(known.get('MOT_THST_EXPO', 0.65), 0.0), 1.0)
    hover = min(max(known.get('MOT_THST_HOVER', 0.35), 0.1), 0.9)
    span = known.get('MOT_SPIN_MAX', 0.95) - known.get('MOT_SPIN_MIN', 0.15)
    slope = span / math.sqrt((1.0 - expo) ** 2 + 4.0 * expo * hover)
    roll, pitch, yaw = (0.5 * slope / np.abs(mixer[:, 1:]).max(axis=0)).tolist()
    return roll, pitch, yaw


OF_MOTORS = ('MOT_THST_EXPO', 'MOT_THST_HOVER', 'MOT_SPIN_MIN', 'MOT_SPIN_MAX')

