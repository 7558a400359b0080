"""A flown log → everything that is measured of it, for the whole and for each set of gains. Pure.

step.py, spectrum.py and response.py measure; here stands which signals they are given.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from quad_sysid.contract import AXES, IDLE, FloatArray
from quad_sysid.logview import response, step
from quad_sysid.logview.flown import Flown, Stretch, stretches
from quad_sysid.logview.spectrum import Frames, frames
from quad_sysid.record import AT_LIMIT, finite_runs

DEG = 180.0 / np.pi
NOISE_HZ = 80.0
"""From here on what the gyro shows is called noise: no aircraft of this kind turns so fast."""
LEAST_BAND = 1.2
"""Factor by which a spectrum must reach beyond NOISE_HZ for an RMS above it."""
LONGEST_LATENCY_S, LONGEST_ANGLE_LATENCY_S = 0.3, 1.0
"""Longest delay behind the set-point that is tried, of a rate and of an angle."""
LEAST_TRACKED_S = 2.0
"""Time with set-point and measurement from which tracking is stated."""
UNRELATED = 0.9
"""Share of the squares of set-point and rate that their difference has, whatever the delay, where
the rate does not follow: an axis held on a rig, whose set-point is its own noise fed back."""
LEAST_MEASURED = 0.5
"""Share of a signal's samples with which it counts as measured."""


@dataclass(frozen=True)
class Tracking:
    """Distance of the rate from its set-point, rad/s (angles: rad)."""

    quantity: str
    setpoint_rms: float
    error_rms: float
    error_rms_delayed: float
    """The error that is left where the set-point is delayed by `latency_s`."""
    latency_s: float
    """The delay with which that error is smallest; NaN where that is the longest that is tried and
    leaves nearly all of the error."""


@dataclass(frozen=True)
class AxisLook:
    """One axis over one stretch."""

    axis: str
    steps: tuple[step.Response, ...]
    """Step responses of the rate, and of an angle with a set-point; all windows, then classes."""
    loop: response.LoopResponse | None
    tracking: tuple[Tracking, ...]
    gyro: Frames | None
    """Spectra of the rate as the controller sees it."""
    gyro_before: Frames | None
    """Spectra of the rate before the filters."""
    d_term: Frames | None
    broken: bool
    """Whether most of the flight is between gaps that leave no room for a step response."""

    @property
    def rate_step(self) -> step.Response | None:
        """The rate's step response over all windows."""
        return next((s for s in self.steps if s.quantity == 'rate'), None)

    @property
    def noise_rms(self) -> float | None:
        """RMS of the filtered gyro above NOISE_HZ, rad/s; None for a log that is too slow."""
        return None if self.gyro is None else noise_rms(self.gyro)


def noise_rms(signal: Frames) -> float | None:
    """RMS above NOISE_HZ; None for a log that is too slow."""
    fast = signal.frequency_hz[-1] >= LEAST_BAND * NOISE_HZ
    return signal.rms(NOISE_HZ) if fast else None


@dataclass(frozen=True)
class MotorLook:
    """One motor in flight."""

    name: str
    mean: float
    """Mean command, 0..1."""
    apart_pct: float
    """Deviation of its mean command from the mean of all motors, %."""
    at_zero_pct: float
    at_one_pct: float
    """Share of the time at the limits, %; the lower one is `mixer.idle` where that is known."""
    speed_rad_s: float | None = None
    """Mean speed where it was measured."""


@dataclass(frozen=True)
class Part:
    """Measurements over one stretch of the flight."""

    stretch: Stretch
    flown_s: float
    """Time in the air."""
    axes: Mapping[str, AxisLook]


@dataclass(frozen=True)
class Measured:
    """All measurements of a log, without a model."""

    flown: Flown
    whole: Part
    parts: tuple[Part, ...]
    """Measurements per set of gains; empty where the gains never change."""
    motors: tuple[MotorLook, ...]
    motor_frames: Frames | None
    """Spectra of the motors' commands, mean over the motors."""
    rotor_hz: FloatArray | None
    """(n,) mean rotor frequency; None where it was not measured."""


def look_at(flown: Flown) -> Measured:
    """Measure everything."""
    pieces = stretches(flown)
    whole, *parts = [_part(flown, piece) for piece in (
        pieces if len(pieces) == 1 else (Stretch(0.0, flown.length_s, {}), *pieces))]
    return Measured(
        flown, whole, tuple(parts), _motors(flown), _motor_frames(flown), _rotor_hz(flown))


def _part(flown: Flown, stretch: Stretch) -> Part:
    time = np.arange(flown.n) * flown.dt
    usable = flown.flying & (time >= stretch.start_s) & (time < stretch.end_s)
    measured = [AXES.index(axis) for axis in flown.axes]  # a rig may have one
    usable &= np.isfinite(flown.rates[:, measured]).all(axis=1)
    return Part(stretch, float(usable.sum()) * flown.dt,
                {axis: _axis(flown, axis, usable, stretch.gains) for axis in flown.axes})


def _axis(flown: Flown, axis: str, usable: npt.NDArray[np.bool_],
          gains: Mapping[str, float]) -> AxisLook:
    i, dt = AXES.index(axis), flown.dt
    rate, rate_setpoint = flown.rates[:, i], _column(flown.rate_setpoint, i)
    angle, angle_setpoint = _column(flown.angles, i), _column(flown.attitude_setpoint, i)
    steps: tuple[step.Response, ...] = ()
    tracking: tuple[Tracking, ...] = ()
    flying, injected = usable, _column(flown.injected, i)
    if injected is not None:  # there it is not the set-point that moves the axis
        usable = usable & ~np.isfinite(injected)
    if rate_setpoint is not None:
        steps += step.responses(rate_setpoint, rate, usable, dt, step.RATE)
        tracking += _tracking('rate', rate_setpoint, rate, usable, dt)
    if angle_setpoint is not None and angle is not None:
        steps += step.responses(angle_setpoint, angle, usable, dt, step.ANGLE)
        tracking += _tracking('heading' if axis == 'yaw' else 'angle', angle_setpoint, angle,
                              usable, dt)
    before = _column(flown.rates_before, i)
    same = before is not None and len(before) == flown.n and flown.before_dt == dt
    if before is not None:
        gyro_before = frames(before, usable if same else np.isfinite(before),
                             flown.before_dt or dt)
    else:
        gyro_before = None
    d_term, gyro = _column(flown.d_term, i), frames(rate, usable, dt)
    return AxisLook(
        axis, steps, _loop(flown, i, flying, gains, before if same else None,
                           follows=_follows(tracking, rate, usable)), tracking,
        gyro, gyro_before,
        _d_frames(gyro, gains, axis, flown.cycle_s) if d_term is None else
        frames(d_term, usable, dt), _broken(flown.flying & np.isfinite(rate), dt))


def _broken(known: npt.NDArray[np.bool_], dt: float) -> bool:
    runs = [b - a for a, b in finite_runs(known, (0, len(known)))]
    whole = sum(n for n in runs if n * dt > step.LEAST_RUN * step.RATE.seconds)
    return len(runs) > 1 and whole < 0.5 * sum(runs)


def _d_frames(gyro: Frames | None, gains: Mapping[str, float], axis: str,
              dt: float) -> Frames | None:
    """The D part's spectra by the gyro's and the known gains."""
    kd = gains.get(f'{axis}.rate.kd', 0.0)
    if gyro is None or not kd > 0.0:
        return None
    part = response.derivative(gains, axis, gyro.frequency_hz, dt)
    return replace(gyro, density=gyro.density * np.abs(part) ** 2)


def _loop(flown: Flown, i: int, usable: npt.NDArray[np.bool_], gains: Mapping[str, float],
          before: FloatArray | None, *, follows: bool) -> response.LoopResponse | None:
    """The loop, by what was injected into its command, or else by the set-point it follows."""
    axis, dt, rate = AXES[i], flown.dt, flown.rates[:, i]
    setpoint, command = _column(flown.rate_setpoint, i), _column(flown.control, i + 1)
    injected = _column(flown.injected, i)

    def by(instrument: FloatArray) -> response.LoopResponse | None:
        spectra = response.spectra(
            instrument, instrument if command is None else command, rate, usable, dt)
        return None if spectra is None else response.loop_response(
            spectra, flown.cycle_s, gains if command is not None else {}, axis)

    loop = by(injected) if injected is not None and command is not None else None
    if loop is not None:
        loop = replace(loop, tracking=np.full_like(loop.tracking, np.nan),  # it is no set-point's
                       bandwidth_hz=np.nan, peak=np.nan, peak_hz=np.nan)
    elif setpoint is not None and follows:
        loop = by(setpoint)
        if loop is not None and command is None:
            loop = replace(loop, plant=None, loop=None)
    return None if loop is None else _delayed(flown, i, usable, gains, before, loop)


def _delayed(flown: Flown, i: int, usable: npt.NDArray[np.bool_], gains: Mapping[str, float],
             before: FloatArray | None, loop: response.LoopResponse) -> response.LoopResponse:
    """The loop with its delays: each that can be measured, the rest of the whole."""
    axis, dt, rate = AXES[i], flown.dt, flown.rates[:, i]
    crossover = response.at_crossover(loop)
    delays = [_gyro_delay(rate, before, usable, dt, gains, crossover),
              _motor_delay(flown, usable, crossover)]
    parts = [delay for delay in delays if delay is not None]
    total = response.plant_delay(loop, crossover)
    if total is not None:
        rest = total - sum(part.milliseconds for part in parts) * 1e-3
        if rest > 0.0:  # damping leads by more than a short rest delays
            parts.append(response.of_seconds(
                'rest: output, airframe' + ('' if delays[1] else ', motors')
                + ('' if delays[0] else ', filters'), rest, crossover, 'measurement'))
        parts.append(
            response.of_seconds('command to acceleration', total, crossover, 'measurement'))
    parts += _d_delay(gains, axis, flown.cycle_s, crossover)
    return replace(loop, delays=tuple(parts), delay_hz=crossover)


def _gyro_delay(rate: FloatArray, before: FloatArray | None, usable: npt.NDArray[np.bool_],
                dt: float, gains: Mapping[str, float], at_hz: float) -> response.Delay | None:
    if before is not None:
        return response.measured_delay('gyro filters', before, rate, usable, dt, at_hz)
    cutoff = gains.get('sensor.gyro_filter_hz', 0.0)
    centre = gains.get('sensor.notch_1_hz', 0.0)
    lowpass = gains.get('sensor.gyro_lowpass_delay_s', 0.0)
    if not max(cutoff, centre, lowpass) > 0.0:
        return None
    f = np.array([at_hz])
    total = response.butterworth(cutoff, f) * response.notch(
        centre, gains.get('sensor.notch_1_bandwidth_hz', 0.0), f)
    total = total * np.exp(-2j * np.pi * f * lowpass)
    return response.of_filter('gyro filters', total, at_hz, 'settings')


def _motor_delay(
    flown: Flown, usable: npt.NDArray[np.bool_], at_hz: float
) -> response.Delay | None:
    """From the motors' commands to the rotors' speeds, which telemetry may delay further."""
    if flown.motors is None or flown.speeds is None:
        return None
    delays = [response.measured_delay('motors', flown.motors[:, k], flown.speeds[:, k], usable,
                                      flown.dt, at_hz)
             for k in range(flown.speeds.shape[1])]
    delays_ms = [delay.milliseconds for delay in delays if delay is not None]
    return response.of_seconds('motors', 1e-3 * float(np.median(delays_ms)), at_hz,
                               'measurement') if delays_ms else None


def _d_delay(gains: Mapping[str, float], axis: str, dt: float,
             at_hz: float) -> list[response.Delay]:
    """The D part's own filters, which delay D alone."""
    f, out = np.array([at_hz]), []
    total = response.first_order(gains.get(f'{axis}.rate.d_filter_hz', 0.0), f, dt)
    if gains.get(f'{axis}.rate.kd', 0.0) > 0.0 and abs(float(np.angle(total[0]))) > 0.0:
        out.append(response.of_filter('D filters (of D alone)', total, at_hz, 'settings'))
    return out


def _tracking(quantity: str, setpoint: FloatArray, measured: FloatArray,
              usable: npt.NDArray[np.bool_], dt: float) -> tuple[Tracking, ...]:
    """The error as it is, and beside the set-point delayed so that it is least."""
    is_finite = usable & np.isfinite(setpoint) & np.isfinite(measured)
    if is_finite.sum() < LEAST_TRACKED_S / dt or not float(np.ptp(setpoint[is_finite])) > 0.0:
        return ()
    if quantity == 'heading':  # counted from north, whatever the aircraft does
        north = float(setpoint[is_finite].mean())
        quantity, setpoint, measured = 'angle', setpoint - north, measured - north
    power = float(np.mean(setpoint[is_finite] ** 2))
    error = float(np.sqrt(np.mean((setpoint - measured)[is_finite] ** 2)))
    best, latency = error, 0.0
    most = LONGEST_LATENCY_S if quantity == 'rate' else LONGEST_ANGLE_LATENCY_S
    longest = max(round(most / dt), 2)
    # all short delays, then in steps of some per cent
    for k in sorted({round(k) for k in np.geomspace(1, longest, 60)}):
        both = is_finite[k:] & is_finite[:len(is_finite) - k]
        behind = (setpoint[:len(setpoint) - k] - measured[k:])[both]
        residual = float(np.sqrt(np.mean(behind**2)))
        if residual < best:
            best, latency = residual, k * dt
    if latency == longest * dt and best**2 > UNRELATED * error**2:
        best, latency = error, np.nan
    return (Tracking(quantity, float(np.sqrt(power)), error, best, latency),)


def _follows(
    tracking: Sequence[Tracking], rate: FloatArray, usable: npt.NDArray[np.bool_]
) -> bool:
    """Whether the rate has to do with its set-point; True where that was not measured."""
    power = float(np.mean(rate[usable] ** 2)) if usable.any() else 0.0
    return all(track.error_rms_delayed**2 < UNRELATED * (track.setpoint_rms**2 + power)
               for track in tracking if track.quantity == 'rate')


def _motors(flown: Flown) -> tuple[MotorLook, ...]:
    if flown.motors is None:
        return ()
    in_flight = flown.flying & np.isfinite(flown.motors).all(axis=1)
    if not in_flight.any():
        return ()
    used = flown.motors[in_flight]
    idle = stretches(flown)[-1].gains.get(IDLE, 0.0)
    mean = used.mean(axis=0)
    out = []
    for k, value in enumerate(mean):
        speed = None
        if flown.speeds is not None:
            own = flown.speeds[flown.flying, k]
            speed = float(np.nanmean(own)) if np.isfinite(own).any() else None
        out.append(MotorLook(
            f'motor_{k + 1}', float(value),
            100.0 * float(value / mean.mean() - 1.0) if mean.mean() > 0.0 else 0.0,
            100.0 * float(np.mean(used[:, k] <= idle + AT_LIMIT)),
            100.0 * float(np.mean(used[:, k] >= 1.0 - AT_LIMIT)), speed))
    return tuple(out)


def _motor_frames(flown: Flown) -> Frames | None:
    if flown.motors is None:
        return None
    every = [frames(flown.motors[:, k], flown.flying, flown.dt)
             for k in range(flown.motors.shape[1])]
    maps = [frames for frames in every if frames is not None]
    if not maps or any(len(frames.at) != len(maps[0].at) for frames in maps):
        return None
    return replace(maps[0], density=np.mean([frames.density for frames in maps], axis=0))


def _rotor_hz(flown: Flown) -> FloatArray | None:
    if flown.speeds is None or np.isfinite(flown.speeds).mean() < LEAST_MEASURED:
        return None
    return np.asarray(np.nanmean(flown.speeds, axis=1) / (2.0 * np.pi))


def _column(signal: FloatArray | None, i: int) -> FloatArray | None:
    """One axis of a signal; None where it is not measured."""
    if signal is None or not np.isfinite(signal[:, i]).any():
        return None
    return signal[:, i]
