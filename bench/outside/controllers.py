"""Limits, schedules, rounding and mixing between the controller and the motors."""

from __future__ import annotations

import math

import numpy as np

from .simulator import Change, Plant, Situation


class SlewLimit:
    """The motor drivers' ramp limit: a command may rise slowly and fall faster.

    |dc/dt| ≤ up, down, each motor for itself: a rate limiter, e.g. Stein, "Respect the unstable"
    (1989/2003); Duda, "Prediction of pilot-in-the-loop oscillations due to rate saturation", JGCD
    20 (1997). Felt: drivers limit the ramp to spare current; small corrections pass untouched,
    large ones become ramps, late by an amount that grows with their size.
    """

    def __init__(self, strength):
        self.up, self.down, self.c = 1.3 / strength, 2.0 / strength, None

    def step(self, s: Situation) -> Change:
        if self.c is None:
            self.c = s.command.tolist()
        up, down = self.up * s.dt, self.down * s.dt
        self.c = [o + min(max(x - o, -down), up) for o, x in zip(self.c, s.command.tolist())]
        return Change(command=np.array(self.c))


class IntegerLowPass:
    """The motor outputs pass a low-pass in integers with an arithmetic shift.

    Each millisecond, in units of q (a microsecond of the 1 ms pulse):
        acc += (x - acc) >> 3,   x = round(command/q)
    `>>` rounds towards minus infinity: an upward difference below 8 units is lost altogether, a downward
    one of a single unit is followed at a unit per call. So small commands upwards never arrive, those
    downwards arrive late, and a motor's output keeps a memory of where it came from.
    Sources: Oppenheim & Schafer, Discrete-Time Signal Processing, ch. 6 (dead bands of IIR filters);
    Jackson, Bell Syst. Tech. J. 49 (1970) 159. Felt here: a dead band of 7 units is a third of the usual
    command's change. One of the jumping effects. Strength multiplies q.
    """

    def __init__(self, strength):
        self.q = 0.0011 * max(strength, 1e-3)
        self.acc = None

    def step(self, s):
        q = self.q
        x = [math.floor(c / q + 0.5) for c in s.command.tolist()]
        if self.acc is None:
            self.acc = x
        self.acc = [a + ((n - a) >> 3) for a, n in zip(self.acc, x)]
        change = Change()
        # the dead band's mean loss is made up for in the throttle's calibration
        change.command = np.array([q * (a + 3.5) for a in self.acc])
        return change


class SlewLimitAgain:
    """The output driver limits how fast each motor's command may change, more strictly upward (to spare the
    supply and the regulators) than downward.

        o_j' = clip((u_j − o_j)/τ_f, −D, +U),      τ_f = 4 ms
    Limits in 1/s (MOT_SLEW_UP_TIME and MOT_SLEW_DN_TIME of ArduPilot, MOT_SLEW_MAX of PX4 are 1/U, 1/D), behind the small
    smoothing filter of such a driver.
    Source: Franklin, Powell & Emami-Naeini, Feedback Control of Dynamic Systems (rate saturation); Åström & Murray,
    Feedback Systems; parameter references of PX4 and ArduPilot.
    Felt: in each quick manoeuvre the drive is a triangle rather than a step, and late by tens of milliseconds.
    Strength stretches the times: U, D ~ 1/strength.
    """

    UP, DOWN, SMOOTH = 1.1, 1.8, 0.004

    def __init__(self, strength):
        self.up, self.down = self.UP / strength, self.DOWN / strength
        self.out = None

    def step(self, s: Situation) -> Change:
        u = s.command.tolist()
        if self.out is None:
            self.out = list(u)
        out, up, down = self.out, self.up * s.dt, -self.down * s.dt
        gain = s.dt / self.SMOOTH
        for j in (0, 1, 2, 3):
            move = gain * (u[j] - out[j])
            out[j] += up if move > up else max(move, down)
        c = Change()
        c.command = np.array(out)
        return c


class CoarseSteps:
    """Motor commands as small integers: the message to the regulators carries whole steps of the range only, and the regulator
    ignores a change of less than a step and a bit against jitter.

        n_j is kept while |u_j − n_j Δ| < (½ + h) Δ, else n_j = round(u_j/Δ);     Δ = 0.019 · strength, h = 0.25
    sent each 4 ms. A staircase with hysteresis in each of four motors; what is left of it in the axis depends on how the
    throttle places the four on their stairs.
    Source: Widrow & Kollár, Quantization Noise; Franklin, Powell & Workman, Digital Control of Dynamic Systems (ch. 10);
    pulse width input with dead band as in hobby regulators.
    Felt: the drive in the axis is some ±0.01 of the range, hence a stair or two. Counted among the effects that jump.
    """

    STEP, HOLD = 0.019, 0.25

    def __init__(self, strength):
        self.size = self.STEP * strength
        self.out = None

    def step(self, s: Situation) -> Change:
        u = s.command.tolist()
        size = self.size
        if self.out is None:
            self.out = [round(x / size) * size for x in u]
        out, band = self.out, (0.5 + self.HOLD) * size
        for j in (0, 1, 2, 3):
            if abs(u[j] - out[j]) > band:
                out[j] = round(u[j] / size) * size
        c = Change()
        c.command = np.array(out)
        return c


class HeadroomCompander:
    """A mixer that keeps every motor within its headroom by shrinking all differences alike.

    room = κ min(top - throttle, throttle - idle),  peak = max|command - throttle|,
    wanted = min(1, (room / peak)^m) with m = 1 - 1/(compression ratio);
    the factor g falls to `wanted` at once (4 ms) and recovers with 0.15 s, as a limiter with attack
    and release does: command = throttle + g (command - throttle).
    Source: desaturation in the mixers of PX4 and Betaflight (motor mix range); limiter: Zölzer, DAFX;
    directional control allocation: Bodson 2002.
    Felt here: hard manoeuvres are answered weakly, and so is what follows within a fifth of a
    second; more so at low and high throttle.
    """

    TOP, IDLE, SHARE, SLOPE, ATTACK, RELEASE = 0.72, 0.30, 0.27, 0.7, 0.004, 0.15

    def __init__(self, strength):
        self.slope = self.SLOPE * strength
        self.g = 1.0

    def step(self, s: Situation) -> Change:
        c = s.command.tolist()
        mean = s.throttle
        peak = max(max(c) - mean, mean - min(c))
        room = self.SHARE * max(0.05, min(self.TOP - mean, mean - self.IDLE))
        wanted = (room / peak) ** self.slope if peak > room else 1.0
        slow = self.ATTACK if wanted < self.g else self.RELEASE
        self.g += s.dt / slow * (wanted - self.g)
        g = self.g
        out = Change()
        out.command = np.array([mean + g * (x - mean) for x in c])
        return out


class UnevenSlewLimit:
    """The output stage limits how fast a motor command may change, upwards tighter than downwards.

        out += clip(command - out, -down dt, +up dt)
    Source: rate limiter, Franklin, Powell & Emami-Naeini, "Feedback Control of Dynamic
    Systems", and
    ArduPilot's MOT_SLEW_UP_TIME / MOT_SLEW_DN_TIME. It protects controllers and propellers; felt
    because a step of the reference asks for a tenth of the range within one cycle.
    """

    def __init__(self, strength: float) -> None:
        self.up, self.down = 1.5 / strength, 2.0 / strength
        self.out = None

    def step(self, s: Situation) -> Change:
        c = Change()
        new = s.command.tolist()
        if self.out is not None:
            up, down = self.up * s.dt, self.down * s.dt
            new = [o + max(-down, min(up, u - o)) for u, o in zip(new, self.out)]
        self.out = new
        c.command = np.array(new)
        return c


class GainSchedule:
    """Gains scheduled on throttle in the mixer: less authority the more throttle, and a late
    boost.

    The roll and pitch parts of the commands are scaled by a curve of the throttle, filtered, and
    raised while the throttle moves quickly:
        g = 1 - a tanh((Thr_f - 0.51)/0.06) + b |Thr - Thr_f|,   tau Thr_f' = Thr - Thr_f
        command = Thr + g (roll and pitch part) + (yaw part)
    Source: gain scheduling, Åström & Wittenmark, "Adaptive Control", ch. 9; Betaflight's
    throttle PID
    attenuation and anti-gravity. Felt because the loop's gain differs by a factor between a slow
    descent and a climb.
    """

    def __init__(self, strength: float) -> None:
        self.a, self.b = 0.33 * strength, 3.0 * strength
        self.slow = 0.5

    def step(self, s: Situation) -> Change:
        c = Change()
        thr = s.throttle
        self.slow += s.dt / 0.35 * (thr - self.slow)
        g = 1.0 - self.a * math.tanh((self.slow - 0.51) / 0.06) + self.b * abs(thr - self.slow)
        m0, m1, m2, m3 = s.command.tolist()
        roll = g * 0.25 * (m0 - m1 + m2 - m3)
        pitch = g * 0.25 * (m0 - m1 - m2 + m3)
        yaw = 0.25 * (m0 + m1 - m2 - m3)
        c.command = np.array([
            min(1.0, max(0.0, thr + roll + pitch + yaw)),
            min(1.0, max(0.0, thr - roll - pitch + yaw)),
            min(1.0, max(0.0, thr + roll - pitch - yaw)),
            min(1.0, max(0.0, thr - roll + pitch - yaw)),
        ])
        return c


class CoarseThrottleSteps:
    """Old ESCs that tell only some fifty widths of the pulse apart: the thrust goes in stairs.

    A mechanic says: notchy throttle, cheap ESCs with coarse steps.
    Source: uniform quantiser (Widrow & Kollár, Quantization Noise, ch. 1): y = q round(x/q).
    Felt: you hear the pitch of the motors go up in steps; it hunts about level.
    """

    def __init__(self, strength: float) -> None:
        self.q = 0.020 * strength

    def step(self, s: Situation) -> Change:
        return Change(command=np.clip(self.q * np.floor(s.command / self.q + 0.5), 0.0, 1.0))


PLANTS = (
    Plant('slew_limit', SlewLimit, 'rigs', 7, rig=True),
    Plant('integer_low_pass', IntegerLowPass, 'hoses', 10, rig=True,
          may_be=('backlash', 'dead_zone')),
    Plant('slew_limit_again', SlewLimitAgain, 'slings', 9, rig=True,
          may_be=('motor_lag', 'saturation')),
    Plant('coarse_steps', CoarseSteps, 'slings', 10, rig=False, may_be=('dead_zone', 'backlash')),
    Plant('headroom_compander', HeadroomCompander, 'chains', 11, rig=True, may_be=('saturation',)),
    Plant('uneven_slew_limit', UnevenSlewLimit, 'umbilicals', 9, rig=True,
          may_be=('motor_lag', 'saturation')),
    Plant('gain_schedule', GainSchedule, 'umbilicals', 11, rig=False, may_be=('saturation',)),
    Plant('coarse_throttle_steps', CoarseThrottleSteps, 'workshop', 11, rig=True,
          may_be=('dead_zone',)),
)
