"""Watch over new gains: rate RMS and oscillation against what they predicted.

Pure arithmetic on arrays of three axes, no clock and no ROS. What an axis may do is what it did
before (times a margin and what the design predicts), plus what its references explain, plus a
floor; more than that for a while is an alarm, on which update.py acts. Before is the flight in
which new gains come; for gains that take off, the aircraft's last good flight, or what any sound
aircraft does. On the ground nothing is compared: cycles that do not fly are not given to `step`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from quad_bridge.gains.table import AXES
from quad_bridge.si import GRAVITY_M_S2, FloatArray

CENTRES_RAD_S = (4.0, 8.0, 16.0, 32.0, 64.0)
"""Bands one octave wide, from slow angle loops to fast rate loops; the last channel is the RMS."""
RMS_CUT_RAD_S, RMS_AVERAGE_S = 120.0, 1.0
MARGIN = 2.0  # factor on the figures before: gusts differ from one ten seconds to the next
PEAK = 1.8
"""Largest complementary sensitivity of a good loop."""
FLOOR_DEG = 1.5  # a smaller oscillation is ignored, whatever its amplitude was before
FLOOR_RMS_RAD_S = 0.3
"""A smaller rate RMS is ignored: gusts that begin with the update cause it on a slow aircraft."""
SOUND_RMS_RAD_S = 0.5
"""Rate RMS of a sound aircraft in gusts, where none of its flights is known."""
GUSTS_RAD_S = 20.0
"""Gusts shake no aircraft faster: what swings so is its loop (a sound one 0.17 rad/s RMS at
most in bench/watch.py), and without a flight before the floor alone is allowed there."""
MAX_DISTANCE_DEG, DISTANCE_PATIENCE_S = 8.0, 0.04
"""Roll or pitch away from the reference, beyond what the reference's own motion explains."""
LEAD_S = 0.06  # horizon of the angle that is predicted by the rate: a reversal takes that long
FOLLOW_S, FOLLOW_FACTOR, TURN_S = 0.5, 2.0, 0.25
BEFORE_S, BLOCK_S = 10.0, 0.5
MAX_HZ = 125.0
"""A faster loop is watched by the means of so many of its cycles that no more remain: twice what
the fastest band needs, and half the work of every cycle."""
UPRIGHT_S = 2.0  # time after take-off in which the angle may still approach its reference
SETTLE_S = 1.0  # duration of data before the first figures count


@dataclass(frozen=True)
class Predicted:
    """The design's prediction for one axis, as ratios of after to before; 1 without any."""

    rate_rms_ratio: float = 1.0
    oscillation_ratio: float = 1.0
    peak: float = PEAK  # largest complementary sensitivity of the new loop


CLIMB = 'climb'
"""The axis of the height mode's gains."""
CLIMB_LEAK_S, CLIMB_MEAN_S, CLIMB_AVERAGE_S = 1.5, 10.0, 1.5
CLIMB_FLOOR_M_S, CLIMB_PATIENCE_S = 0.5, 0.5
"""A smaller RMS of the vertical motion is ignored, also while the pilot climbs."""


class ClimbWatch:
    """Watch over the height mode's gains: RMS of the vertical speed, by the accelerometer.

    The vertical specific force less its mean is integrated with a leak, which shows oscillations
    with periods of some seconds or less. The firmware's estimate is not used: it may be wrong.
    """

    def __init__(self) -> None:
        self._mean = self._speed = self._energy = self._over_s = 0.0
        self._bound: float | None = None
        self._started = False

    def step(self, up: float, dt: float) -> None:
        """Take one cycle's vertical specific force, m/s², dt s after the one before."""
        if not self._started:
            self._mean, self._started = up, True
        self._mean += dt / CLIMB_MEAN_S * (up - self._mean)
        self._speed += dt * (up - self._mean - self._speed / CLIMB_LEAK_S)
        self._energy += dt / CLIMB_AVERAGE_S * (self._speed**2 - self._energy)
        over = self._bound is not None and self._energy > self._bound
        self._over_s = self._over_s + dt if over else 0.0

    def begin(self, ratio: float = 1.0) -> None:
        """Compare from now on with the motion before this call, times the predicted ratio."""
        self._bound = max((MARGIN * ratio) ** 2 * self._energy, CLIMB_FLOOR_M_S**2)
        self._over_s = 0.0

    @property
    def watches(self) -> bool:
        """Whether it compares."""
        return self._bound is not None

    def end(self) -> None:
        """Stop comparing."""
        self._bound = None

    def alarm(self) -> str | None:
        """Whether it has moved beyond its bound for too long."""
        if self._bound is None or self._over_s < CLIMB_PATIENCE_S:
            return None
        now, most = math.sqrt(self._energy), math.sqrt(self._bound)
        return f'climb: vertical speed {now:.2f} m/s RMS, bound {most:.2f}'


class GainWatch:
    """Takes each cycle by `step`; after `begin`, `alarm` says whether the gains must go back."""

    def __init__(self, rate_hz: float) -> None:
        """`rate_hz` control cycles per second, 50 or more."""
        self._every = max(1, round(rate_hz / MAX_HZ))
        self._buffer: list[tuple[Sequence[float], ...]] = []
        self._dt, self._climb = self._every / rate_hz, ClimbWatch()
        self._block = round(BLOCK_S / self._dt)  # rows
        centres = np.array(CENTRES_RAD_S)
        self._b, self._a = _bank(centres, self._dt)
        periods = 2.0 * math.pi / np.append(centres, RMS_CUT_RAD_S)
        average = np.clip(periods, 0.15, 0.8)
        average[-1] = RMS_AVERAGE_S
        self._share = (self._dt / average)[:, np.newaxis]
        self._fade = np.exp(-self._dt / (2.0 * average))[:, np.newaxis]
        self._delays_s = np.clip(periods, 0.12, 0.5)[:, np.newaxis]
        self._delays_s[-1] = 0.3
        octaves = np.clip(centres * math.radians(FLOOR_DEG) / math.sqrt(2.0), 0.2, 0.5)
        self._floor = (np.append(octaves, FLOOR_RMS_RAD_S) ** 2)[:, np.newaxis]
        most = np.append(octaves, SOUND_RMS_RAD_S)[:, np.newaxis] ** 2
        self._usual = np.repeat(most, 3, axis=1)  # most that a good flight may leave behind
        self._unknown = self._usual * np.append(centres < GUSTS_RAD_S, 1.0)[:, np.newaxis]
        self._sound = self._unknown
        self._blocks: deque[FloatArray] = deque(maxlen=round(BEFORE_S / BLOCK_S))
        self._bound: FloatArray | None = None
        self.restart()
        self._watched = np.ones(3, bool)
        self._peak = np.full(3, PEAK**2)

    def restart(self) -> None:
        """Forget: it takes off or has landed, and how it was handled says nothing of a flight."""
        channels = (len(CENTRES_RAD_S) + 1, 3)
        self._buffer.clear()
        self._memory = np.zeros((2, 2, *channels))
        self._energy = np.zeros((2, *channels))  # of the rates, and of what the references explain
        self._explained, self._worst = np.zeros(channels), np.zeros(channels)
        self._over_s = np.zeros(channels)
        self._blocks.clear()
        self._last: FloatArray | None = None
        self._slow = np.zeros(3)
        self._distance, self._allowed = np.zeros(2), np.zeros(2)
        self._allowed_before, self._exceeded_s = np.zeros(2), np.zeros(2)
        self._near = np.zeros(2, bool)  # it has come to its reference, from how it stood
        self._rows = 0

    @property
    def known(self) -> list[list[float]]:
        """The figures of the aircraft's last good flight, or what stands for them."""
        return [[float(v) for v in row] for row in self._sound]

    @property
    def before(self) -> list[list[float]]:
        """The figures of the last ten seconds of flight, for a later one."""
        return [[float(v) for v in row] for row in self._before()]

    @property
    def climbs(self) -> bool:
        """Whether the height mode's gains are on trial, which fly in that mode only."""
        return self._climb.watches

    @property
    def good(self) -> bool:
        """Whether this flight has gone well for ten seconds, by what a sound aircraft may do."""
        is_full = len(self._blocks) == self._blocks.maxlen
        return is_full and bool((self._before() <= self._most(self._unknown)).all())

    def know(self, before: object) -> None:
        """Restore levels that were stored after a good flight; invalid ones leave none."""
        self._sound = self._unknown
        try:
            levels = np.array(before, dtype=float)
        except (TypeError, ValueError):
            return
        if levels.shape == self._usual.shape and (levels >= 0.0).all():  # nor is one of them NaN
            self._sound = np.minimum(levels, self._usual)

    def step(
        self,
        rates: Sequence[float],
        attitude: Sequence[float],
        reference: Sequence[float],
        injected: Sequence[float],
        up: float = GRAVITY_M_S2,
    ) -> None:
        """Take one cycle: `rates` (3,) rad/s, `attitude` and its `reference` (3,) rad.

        `injected` (3,) is the excitation inside the loop as a rate reference, rad/s; `up` the
        specific force along the vertical, m/s².
        """
        self._climb.step(up, self._dt / self._every)
        self._buffer.append((rates, injected, attitude, reference))
        # only who compares must hurry; one turn over many rows costs a fraction of as many turns
        rows = 1 if self._bound is not None else self._block - self._rows % self._block
        if len(self._buffer) >= rows * self._every:
            self._run()

    def _run(self) -> None:
        """Work through the rows that are whole: means of rates, the last attitude."""
        count = len(self._buffer) // self._every
        samples = np.array(self._buffer[: count * self._every])
        del self._buffer[: count * self._every]
        rows = samples.reshape(count, self._every, 4, 3)
        rates, injected = np.moveaxis(np.add.reduce(rows[:, :, :2], axis=1) / self._every, 1, 0)
        attitude, reference = np.moveaxis(rows[:, -1, 2:], 1, 0)
        if self._last is None:
            self._last = self._slow = reference[0]
        turn = reference - np.concatenate((self._last[np.newaxis], reference[:-1]))
        turn -= 2.0 * math.pi * np.round(turn / (2.0 * math.pi))
        self._last = reference[-1]
        signals = np.stack((rates, turn / self._dt + injected), axis=1)[:, :, np.newaxis]
        slow, energies = np.empty_like(reference), np.empty((count, *self._energy.shape))
        memory, b, a = self._memory, self._b, self._a
        for k, signal in enumerate(signals):
            self._slow = self._slow + self._dt / FOLLOW_S * (reference[k] - self._slow)
            out = b[0] * signal + memory[0]
            memory[0] = b[1] * signal - a[0] * out + memory[1]
            memory[1] = b[2] * signal - a[1] * out
            self._energy += self._share * (out * out - self._energy)
            slow[k], energies[k] = self._slow, self._energy
        motion = np.abs(reference - slow) + TURN_S * np.abs(injected)
        distance = np.abs(attitude + LEAD_S * rates - reference)[:, :2]
        follows = FOLLOW_FACTOR * motion[:, :2]
        allowed = _fading(follows, self._allowed, 1.0 - self._dt / FOLLOW_S)
        explained = _fading(energies[:, 1], self._explained, self._fade)
        self._distance, self._allowed = distance[-1], allowed[-1]
        self._explained = explained[-1]
        self._rows += count
        if self._bound is None:
            self._remember(energies[:, 0] - self._peak * explained, distance - allowed)
        else:
            self._compare(self._bound)

    def begin(
        self, predicted: Mapping[str, Predicted] | None = None, axes: Collection[str] = AXES
    ) -> None:
        """Compare from now on with the figures before this call, times the `predicted` ratios.

        Only `axes` are looked at: what gains have not changed, they have not spoilt.
        """
        if len(self._buffer) >= self._every:
            self._run()
        self._watched = np.array([axis in axes for axis in AXES])
        predicted = predicted or {}
        if CLIMB in axes:
            self._climb.begin(predicted.get(CLIMB, Predicted()).rate_rms_ratio)
        predictions = [predicted.get(axis, Predicted()) for axis in AXES]
        ratio = np.ones_like(self._worst)
        ratio[:-1] = [p.oscillation_ratio**2 for p in predictions]
        ratio[-1] = [p.rate_rms_ratio**2 for p in predictions]
        self._peak = np.array([p.peak**2 for p in predictions])
        before = self._before() if self._blocks else self._sound
        self._near[:] = bool(self._blocks)
        self._exceeded_s[:] = 0.0
        self._bound = self._most(ratio * before)
        self._over_s[:] = 0.0

    def end(self) -> None:
        """Stop comparing and collect new figures of before."""
        self._bound = None
        self._climb.end()
        self._blocks.clear()
        self._worst[:] = 0.0
        self._allowed_before[:] = 0.0

    def alarm(self) -> str | None:
        """The worst axis and band beyond its bound for too long; None: no alarm."""
        if self._bound is None:
            return None
        swings = self._climb.alarm()
        if swings is not None:
            return swings
        if (self._exceeded_s > DISTANCE_PATIENCE_S).any():
            i = int(np.argmax(self._exceeded_s))
            measured, limit = np.degrees((self._distance[i], self._limit()[i]))
            return f'{AXES[i]}: away from its reference {measured:.2f} deg, bound {limit:.2f}'
        late = self._over_s > self._delays_s
        if not late.any():
            return None
        bound = self._bound + self._peak * self._explained
        ratio = np.where(late, self._energy[0] / bound, 0.0)
        channel, axis = np.unravel_index(int(np.argmax(ratio)), ratio.shape)
        what = 'rate'
        if channel < len(CENTRES_RAD_S):
            what = f'oscillation near {CENTRES_RAD_S[channel]:.0f} rad/s:'
        measured, limit = np.sqrt((self._energy[0, channel, axis], bound[channel, axis]))
        return f'{AXES[axis]}: {what} {measured:.2f} rad/s RMS, bound {limit:.2f}'

    def figures(self) -> dict[str, float]:
        """Rate RMS per axis now, and the bound while it is watched, rad/s."""
        energies = {'rate_rms': self._energy[0, -1]}
        if self._bound is not None:
            energies['rate_rms_bound'] = self._bound[-1] + self._peak * self._explained[-1]
        return {
            f'{axis}.{name}': math.sqrt(energy[i])
            for name, energy in energies.items()
            for i, axis in enumerate(AXES)
        }

    def _before(self) -> FloatArray:
        return np.asarray(np.max([*self._blocks, self._worst], axis=0))

    def _most(self, before: FloatArray) -> FloatArray:
        most: FloatArray = MARGIN**2 * before + self._floor
        return most

    def _remember(self, excess: FloatArray, beyond: FloatArray) -> None:
        """Take rows of energies that no reference explains, and of angles beyond what one does."""
        numbers = self._rows - len(excess) + np.arange(1, len(excess) + 1)
        settled = numbers * self._dt >= SETTLE_S
        if not settled.any():
            return
        self._worst = np.maximum(self._worst, excess[settled].max(axis=0))
        fade = 1.0 - self._dt / BEFORE_S
        self._allowed_before = _fading(beyond[settled], self._allowed_before, fade)[-1]
        if self._rows % self._block == 0:
            self._blocks.append(self._worst)
            self._worst = np.zeros_like(self._worst)

    def _limit(self) -> FloatArray:
        """(2,) rad that roll and pitch may be away from their reference."""
        return math.radians(MAX_DISTANCE_DEG) + self._allowed + MARGIN * self._allowed_before

    def _compare(self, bound: FloatArray) -> None:
        exceeded = self._distance > self._limit()
        self._near |= ~exceeded | (self._rows * self._dt > UPRIGHT_S)
        exceeded &= self._near & self._watched[:2]
        self._exceeded_s = np.where(exceeded, self._exceeded_s + self._dt, 0.0)
        over = (self._energy[0] > bound + self._peak * self._explained) & self._watched
        self._over_s = np.where(over, self._over_s + self._dt, 0.0)


def _fading(values: FloatArray, previous: FloatArray, fade: FloatArray | float) -> FloatArray:
    """In each row the largest value so far, which fades from row to row; `before` the first."""
    ages = np.arange(1, len(values) + 1).reshape(-1, *[1] * previous.ndim)
    faded = np.power(fade, ages)
    largest = np.maximum.accumulate(np.concatenate((previous[np.newaxis], values / faded)))
    return np.asarray(largest[1:] * faded)


def _bank(centres: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
    """Biquads (b0 b1 b2), (a1 a2), each (6, 1): band passes of quality 1.4, and one low pass.

    Bilinear transform, as in Bristow-Johnson's cookbook.
    """
    w = np.append(centres, RMS_CUT_RAD_S) * dt
    quality = np.append(np.full(centres.size, 1.4), math.sqrt(0.5))
    alpha, cos = np.sin(w) / (2.0 * quality), np.cos(w)
    b = np.stack((alpha, np.zeros_like(w), -alpha))
    b[:, -1] = np.array([0.5, 1.0, 0.5]) * (1.0 - cos[-1])
    a = np.stack((-2.0 * cos, 1.0 - alpha))
    return (b / (1.0 + alpha))[..., np.newaxis], (a / (1.0 + alpha))[..., np.newaxis]
