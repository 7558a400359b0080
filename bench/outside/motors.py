"""Motors and their speed controllers: braking, governors, current limits, heat, commutation."""

from __future__ import annotations

import math

import numpy as np

from .simulator import HOVER, LAG_S, SIDE, Change, Plant, Situation

FADE = math.exp(-0.001 / LAG_S)


def command_for(wanted, speed):
    """The commands (4,) that make the simulator's lag deliver `wanted` at the end of this millisecond."""
    k = 1.0 / (1.0 - FADE)
    return np.array([(w - FADE * v) * k for w, v in zip(wanted, speed)])


class CoastingWithoutBrake:
    """ESC without complementary PWM: it can push current into the motor but not draw it out, so
    rotors slow down lazily.

    With diodes blocking the reverse current, a low-inductance motor at 8 kHz PWM sits at hover
    near the border of discontinuous conduction. Above it the winding brakes and drives alike
    (1/tau = KtKe/(RJ) + 2 kQ W/J); below it current stops in a part of each period, the
    electrical damping goes, and the propeller's torque alone slows the rotor. Load current, hence
    the border, moves with thrust n = s/0.5:
        lag factor = [1 + a (1 - tanh((u - s + x0 (n - 1))/x1))/2] / (1 + b (sqrt(n) - 1))
        a = 1.3 strength, b = 0.5 strength, x0 = 0.05, x1 = 0.008
    Sources: Mohan, Undeland & Robbins, 'Power Electronics', ch. 7 (discontinuous conduction);
    Bangura & Mahony, 'Thrust control for multirotor aerial vehicles', IEEE T-RO 33 (2017) for the
    rotor equation; 'damped light' in BLHeli manuals.
    Felt: everyday with cheap ESCs: crisp when rotors spin up or carry much load, sluggish when
    they spin down or idle low.
    """

    def __init__(self, strength):
        self.k = strength

    def step(self, s: Situation) -> Change:
        lag = []
        k = self.k
        for u, v in zip(s.command.tolist(), s.speed.tolist()):
            n = 2.0 * v if v > 0.05 else 0.1
            coast = 0.5 - 0.5 * math.tanh((u - v + 0.05 * (n - 1.0)) / 0.008)
            lag.append((1.0 + 1.3 * k * coast) / (1.0 + 0.5 * k * (math.sqrt(n) - 1.0)))
        return Change(lag=np.array(lag))


class SpeedGovernorEsc:
    """ESC in governor (closed-loop RPM) mode: a PI loop around each motor, with its current
    limit.

        e = u - s,   dx/dt = Ki e - (c_wanted - c)/T_aw,   c_wanted = u + Kp e + x,   c = s +
        d_max tanh((c_wanted - s)/d_max)
    around tau ds/dt = c - s; Ki = 14/s and Kp = 0.4 times strength, d_max = 0.05, T_aw = 0.05 s.
    Two poles, wn = sqrt(Ki/tau) = 18 rad/s with damping (1 + Kp)/(2 tau wn) = 0.9, and the PI's
    zero overshoot after each change of command; the current limit (d_max, excess voltage over
    back-EMF) makes it depend on the step's size and back-calculation stops windup.
    Sources: Astrom & Hagglund, 'Advanced PID Control' (2006), ch. 3 (back-calculation); Krishnan,
    'Permanent Magnet Synchronous and Brushless DC Motor Drives' (speed loops); governor mode of
    BLHeli_32 / Castle / APD ESCs.
    Felt: rotor thrust, hence torque, overshoots at some 3 Hz, within the attitude loop's band,
    and less so for large steps.
    """

    def __init__(self, strength):
        self.k = strength
        self.x = [0.0, 0.0, 0.0, 0.0]

    def step(self, s: Situation) -> Change:
        out = []
        ki, x, dt = 14.0 * self.k, self.x, s.dt
        i = 0
        for u, v in zip(s.command.tolist(), s.speed.tolist()):
            e = u - v
            want = e + 0.4 * self.k * e + x[i]
            got = 0.05 * math.tanh(want / 0.05)
            x[i] += dt * (ki * e - (want - got) / 0.05)
            c = v + got
            out.append(0.0 if c < 0.0 else min(c, 1.0))
            i += 1
        return Change(command=np.array(out))


class MixedEscBraking:
    """The two controllers of one side were replaced by others without active braking.

    J W' = Kt I - kq W^2: upwards the controller pushes current, downwards the rotor only coasts
    against its drag, so lag_up < lag_down; both are shorter at high speed, tau ~ J/(2 kq W), W ~
    sqrt(u): lag/lag0 = (u0/u)^(1/2) [1 - A tanh(x)], A 0.25 up, 0.8 down;  x = (command -
    speed)/w.
    Source: Franchi, Mallet, "Adaptive closed-loop speed control of BLDC motors with applications
    to multi-rotor aerial vehicles", ICRA 2017; Bangura, Mahony, "Thrust control for multirotor
    aerial vehicles", IEEE T-RO 33 (2017). A torque towards that side comes quickly and goes
    slowly, and each change of throttle tips the aircraft.
    """

    def __init__(self, strength):
        self.k = strength

    def step(self, s: Situation) -> Change:
        sign = SIDE[s.axis]
        lag = [1.0] * 4
        cmd, spd = s.command.tolist(), s.speed.tolist()
        for i in range(4):
            if sign[i] > 0:
                t = math.tanh((cmd[i] - spd[i]) / 0.008)
                asym = -0.25 * t if t > 0 else -0.8 * t
                slow = math.sqrt(0.5 / max(spd[i], 0.1)) - 1.0
                lag[i] = max(0.2, (1.0 + self.k * asym) * (1.0 + self.k * slow))
        c = Change()
        c.lag = np.array(lag)
        return c


class EscAntiJitter:
    """The controllers' anti-jitter band on the throttle pulse: play with slow creep.

    out = clip(out, u - d, u + d);  out' = (u - out)/tau within the band   (play operator with
    creep).
    Source: play operator: Visintin, "Differential Models of Hysteresis"; Krasnosel'skii,
    Pokrovskii; the band in servo-pulse controllers is in makers' manuals as 'dead bandwidth' of
    one to some microseconds of 1000. A reversal of the command must first cross the band before
    the motor follows; held commands creep home.
    """

    def __init__(self, strength):
        self.d = 0.0042 * strength
        self.out = None

    def step(self, s: Situation) -> Change:
        cmd = s.command.tolist()
        if self.out is None:
            self.out = list(cmd)
        out, d, fade = self.out, self.d, s.dt / 0.35
        for i in range(4):
            u, y = cmd[i], out[i]
            y += fade * (u - y)
            out[i] = u - d if y < u - d else (min(y, u + d))
        c = Change()
        c.command = np.array(out)
        return c


class TwistedMotorMounts:
    """Motor mounts that are twisted on their arms: the motors' reaction torques get a part along
    the excited axis.

    M = A sum_i y_i g_i u_i + B sum_i y_i u_i',  g_i = 1 + e (u_i - u0)/u0, y_i the sense of
    rotation: drag torque Q_i ~ u_i times the tilt (which grows elastically with Q_i: torsion of a
    tube, phi = Q l / G Ip) and the reaction J_r W_i' of the rotor that is being accelerated.
    Source: Mahony, Kumar, Corke, "Multirotor aerial vehicles", IEEE RAM 19 (2012) (drag and
    reaction torques); Timoshenko, "Strength of Materials" (torsion). Clamped carbon tubes turn by
    some degrees in any hard landing; thereafter each yaw command tips the aircraft.
    """

    def __init__(self, strength):
        self.k = strength

    def step(self, s: Situation) -> Change:
        cmd, spd = s.command.tolist(), s.speed.tolist()
        yaw = SIDE[2]
        drag = react = 0.0
        for i in range(4):
            u = spd[i]
            drag += yaw[i] * u * (1.0 + 0.5 * (u - 0.5) / 0.5)
            react += yaw[i] * (cmd[i] - u) / LAG_S
        c = Change()
        c.torque[s.axis] = self.k * (9.0 * drag + 0.35 * react)
        return c


class CoastingEsc:
    """ESC without synchronous rectification: it can drive the rotor but not brake it.

    When the command falls faster than the propeller's drag slows the rotor, the current is zero and
    the rotor coasts:
        J dΩ/dt = -b Ω² - q0      →      dT/dt = -(a T^1.5 + c T^0.5)
    (T = kΩ²; b propeller drag, q0 bearing and iron loss). Otherwise it is driven with its usual lag.
    So spin-up is quick and slow-down has a rate limit that depends on the speed.
    Switches (drive / coast) in its rate of change.
    Source: Hanselman, Brushless Permanent Magnet Motor Design; Leishman, Principles of Helicopter
    Aerodynamics (rotor torque ~Ω²); BLHeli_32 manual, "non-damped mode".
    Felt: J Ω / Q of a propeller is near one second in hover, so any firm reduction of thrust coasts.
    """

    def __init__(self, strength: float) -> None:
        self.prop = 2.5 / math.sqrt(strength)
        self.iron = 0.33 / math.sqrt(strength)

    def step(self, s: Situation) -> Change:
        change = Change()
        lag = None
        for i, (u, v) in enumerate(zip(s.command.tolist(), s.speed.tolist())):
            if u < v:
                root = math.sqrt(max(v, 0.0025))
                ratio = (v - u) / (LAG_S * (self.prop * root * v + self.iron * root))
                if ratio > 1.0:
                    if lag is None:
                        lag = [1.0, 1.0, 1.0, 1.0]
                    lag[i] = min(ratio, 40.0)
        if lag is not None:
            change.lag = np.array(lag)
        return change


class RpmGovernor:
    """ESC in governor mode: a PI loop on the measured RPM, with a feed-forward that is too small.

        duty = (1 - d) Ωc + kp (Ωc - Ωm) + I,    dI/dt = ki (Ωc - Ωm) - leak by anti-windup
        Ωc = sqrt(command),  Ωm = Ω through the filter of the commutation interval (9 ms)
    with back-calculation (the integral is bled when the duty's step meets the slew limit, tanh), so
    a small change gets less of its thrust at once and the rest by the integral.
    Source: Åström & Hägglund, Advanced PID Control (ISA 2006), ch. 3 (anti-windup); Franchi & Mallet,
    "Adaptive closed-loop speed control of BLDC motors", ICRA 2017; KDE / BLHeli governor mode manuals.
    Felt: the attitude loop sees a motor with a slow tail beside its lag, and with overshoot at reversals.
    """

    def __init__(self, strength: float) -> None:
        self.d = 0.35 * strength
        self.sum = [self.d * math.sqrt(HOVER)] * 4
        self.seen = [math.sqrt(HOVER)] * 4

    def step(self, s: Situation) -> Change:
        out = [0.0, 0.0, 0.0, 0.0]
        for i, (u, v) in enumerate(zip(s.command.tolist(), s.speed.tolist())):
            wanted = math.sqrt(max(u, 0.0))
            seen = self.seen[i] = self.seen[i] + s.dt / 0.009 * (
                math.sqrt(max(v, 0.0)) - self.seen[i])
            e = wanted - seen
            duty = (1.0 - self.d) * wanted + 0.08 * e + self.sum[i]
            step = duty - seen
            given = 0.10 * math.tanh(step / 0.10)
            self.sum[i] += s.dt * (6.5 * e + 6.0 * (given - step))
            duty = seen + given
            out[i] = min(max(duty, 0.0), 1.0) ** 2
        return Change(command=np.array(out))


class CurrentFoldback:
    """Current limiter of each ESC: quick attack, slow release.

    Motor current in units of hover: the propeller's torque and that for speeding up,
        i = T/T_h + (J Ω_h/Q_h) (u - T) / (2 T lag)   (about T/T_h + 14 (u - T))
    The limiter turns the duty down by what exceeds the limit, softly:
        over = w ln(1 + exp((i - i_lim)/w)),   dx/dt = (over - x)/(7 ms up, 110 ms down),  u' = u - k x
    Source: Krishnan, Permanent Magnet Synchronous and Brushless DC Motor Drives (CRC 2010), current
    limiting; Mohan, Electric Drives; VESC / BLHeli_32 current protection.
    Felt: each upward step of a motor is clipped and stays so for a tenth of a second, more at high throttle.
    """

    def __init__(self, strength: float) -> None:
        self.k = 0.034 * strength
        self.x = [0.05, 0.05, 0.05, 0.05]

    def step(self, s: Situation) -> Change:
        out = [0.0, 0.0, 0.0, 0.0]
        for i, (u, v) in enumerate(zip(s.command.tolist(), s.speed.tolist())):
            current = v / HOVER + 14.0 * (u - v)
            over = 0.12 * math.log1p(math.exp(min((current - 1.12) / 0.12, 50.0)))
            x = self.x[i]
            x += s.dt * (over - x) / (0.007 if over > x else 0.110)
            self.x[i] = x
            out[i] = min(max(u - self.k * x, 0.0), 1.0)
        return Change(command=np.array(out))


class CoastingProps:
    """Big propellers on speed controllers without active braking and with a current limit.

    A propeller can lose speed only as fast as its own drag torque stops it, and gain it only as fast as
    the limited current allows:
        J w' = min(Kt i_max, .) - kQ w²  with i >= 0;   so  -L_d(speed) < tau w' < L_u,
        L_d = L (speed/0.5)^1.5,   L_u = 1.8 L,
    small steps pass as ever, big ones are soft-limited, the fall more than the rise: the excess of the
    command over the speed, e, becomes e / sqrt(1 + (e/L)²).
    Sources: Franklin/Hughes, Electric Motors and Drives, ch. 3; Bangura & Mahony, Thrust control for
    multirotor aerial vehicles, IEEE T-RO 33 (2017) 390. Felt here: on each big change of reference.
    Strength divides L.
    """

    def __init__(self, strength):
        self.limit = 0.060 / max(strength, 1e-3)

    def step(self, s):
        out = []
        for c, n in zip(s.command.tolist(), s.speed.tolist()):
            e = c - n
            if e < 0.0:
                r = e / (self.limit * (max(n, 0.02) / 0.5) ** 1.5)
            else:
                r = e / (1.8 * self.limit)
            out.append(n + e / math.sqrt(1.0 + r * r))
        change = Change()
        change.command = np.array(out)
        return change


class CoastingController:
    """Speed controllers without active braking: the bridge drives, but its diodes never let current flow back.

    w' = e max(u - w, 0) - q w²,  u = sqrt(c) + (q/e) c,  thrust = w².
    (J w' = Kt i - kQ w², i = (d V - Ke w)/R, i >= 0; u is the voltage that holds the speed for the command c.)
    Upwards the motor follows with its electromechanical time constant 1/(e + 2 q w), downwards not faster than
    the drag of its propeller slows it: 2 q w³. Hughes & Drury, "Electric Motors and Drives" (chopper in the first
    quadrant); BLHeli manual, "damped light". Felt whenever a motor must give up more than a few per cent of thrust:
    one side rises at once, the other sinks late, so the torque also depends on the sign of the change.
    """

    def __init__(self, strength):
        self.q = 0.75 / strength
        self.e = 1.0 / LAG_S - 2.0 * self.q * math.sqrt(0.5)
        self.w = [math.sqrt(0.5)] * 4

    def step(self, s: Situation) -> Change:
        change = Change()
        q, e, h = self.q, self.e, s.dt
        w = self.w
        for i, c in enumerate(s.command.tolist()):
            c = max(c, 0.0)
            over = math.sqrt(c) + q / e * c - w[i]
            drive = e * over if over > 0.0 else 0.0
            w[i] = max(w[i] + h * (drive - q * w[i] * w[i]), 0.02)
        change.command = command_for([v * v for v in w], s.speed.tolist())
        return change


class SpeedGovernor:
    """Controllers that hold the speed by PI, with a limited current: overshoot of the thrust.

    e = sqrt(c) - w,  i = imax tanh[(kp e + x)/imax],  x' = ki e - kb (kp e + x - i),
    w' = i - q w²,  thrust = w².
    Linear about hover: s² + (kp + 2 q w) s + ki, well damped, but its zero at -ki/kp lies before its poles, so it overshoots. Åström & Hägglund,
    "PID Controllers" (PI of a lag, anti-windup by back-calculation); Krishnan, "Electric Motor Drives" (speed loop
    about a current loop). The governor is tuned for a steady speed with its integral in front, as in helicopter
    mode; a change of command comes out as an overshoot that is paid back, instead of as a lag.
    """

    def __init__(self, strength):
        self.ki, self.kp = 320.0 * strength, 26.0
        self.q, self.imax = 3.0, 6.0
        self.w = [math.sqrt(0.5)] * 4
        self.x = [self._needed()] * 4

    def _needed(self):
        """Integral that holds hover."""
        return self.imax * math.atanh(self.q * 0.5 / self.imax)

    def step(self, s: Situation) -> Change:
        change = Change()
        h, w, x, top = s.dt, self.w, self.x, self.imax
        for k, c in enumerate(s.command.tolist()):
            e = math.sqrt(max(c, 0.0)) - w[k]
            asked = self.kp * e + x[k]
            i = top * math.tanh(asked / top)
            x[k] += h * (self.ki * e - 10.0 * (asked - i))
            w[k] = max(w[k] + h * (i - self.q * w[k] * w[k]), 0.02)
        change.command = command_for([v * v for v in w], s.speed.tolist())
        return change


class HotWinding:
    """Copper that grows hot and resists: one motor with a blocked vent loses thrust as it has just worked.

    C D' = P (i/i0)² (1 + al D) - (w/w0)^0.8 D / Rth   (D: rise of the winding's temperature, per motor; i ~ thrust),
    u = w + r (1 + al D) w²  with u the voltage that would give the commanded speed when cold, thrust = w².
    al = 0.0039 1/K. The heat goes with the square of the current and of the resistance that it raised itself, the
    cooling with the air of the propeller. Krishnan, "Electric Motor Drives", ch. thermal; Incropera, "Heat and Mass
    Transfer" (h ~ Re^0.8). A winding of some grams follows in about 3 s; the motors differ in their ventilation, so
    that each change of throttle comes back seconds later as a torque about roll and pitch.
    """

    RISE = (62.0, 18.0, 22.0, 14.0)
    """K in hover at strength 1."""

    def __init__(self, strength):
        self.hover = [v * strength for v in self.RISE]
        self.d = [0.3 * v for v in self.hover]
        self.tau, self.r, self.al = 2.6, 0.34, 0.0039

    def step(self, s: Situation) -> Change:
        change = Change()
        factors = []
        for k, thrust in enumerate(s.speed.tolist()):
            thrust = max(thrust, 0.01)
            w = math.sqrt(thrust)
            d, al = self.d[k], self.al
            rise = self.hover[k] * 4.0 * thrust * thrust * (1.0 + al * d) / (1.0 + al * self.hover[k])
            self.d[k] = d + s.dt / self.tau * (rise - (w / 0.7071) ** 0.8 * d)
            u = w + self.r * thrust
            r = self.r * (1.0 + al * self.d[k])
            real = 2.0 * u / (1.0 + math.sqrt(1.0 + 4.0 * r * u))
            factors.append(real * real / thrust)
        change.thrust = np.array(factors)
        return change


class ShadedStatorHeat:
    """The windings of two motors warm up more than the others' (they sit in the canopy's lee).

    The copper loss I²R heats the winding, which gives its heat to the stator and this to the air:
        dT1/dt = P/C1 - (T1 - T2)/τ1,   dT2/dt = (T1 - T2)/τ12 - T2/τ2,   P ∝ thrust²·(1 + α·T1)
    (current is proportional to the torque and so to the thrust; copper's α = 0.39 %/K, T in units of 41 K). The higher
    resistance makes the motor turn more slowly at the same duty: thrust·(1 - β·T1). Only the motors
    of one side are cooled badly, so their loss is a torque that follows the throttle's and their
    own load of the last seconds.
    Source: Hughes & Drury, Electric Motors and Drives, ch. on ratings and thermal time constants;
    Mellor, Roberts & Turner, Lumped parameter thermal model for electrical machines, IEE Proc. B
    138 (1991). Felt here: a per cent of the hover thrust on one side is 1 rad/s² about the axis.
    """

    def __init__(self, strength: float) -> None:
        self.loss = 0.034 * strength
        self.cooling = {0: np.array([1.0, 0.15, 0.1, 0.9]), 1: np.array([1.0, 0.9, 0.1, 0.15])}
        self.hot, self.core = np.full(4, 0.6), np.full(4, 0.25)

    def step(self, s: Situation) -> Change:
        load = 4.0 * s.speed * s.speed * (1.0 + 0.16 * self.hot)
        flow = self.hot - self.core
        self.hot = self.hot + s.dt * (load / 1.6 - flow / 0.7)
        self.core = self.core + s.dt * (flow / 3.0 - self.core / 3.0)
        return Change(thrust=1.0 - self.loss * self.cooling[s.axis] * self.hot)


class TardySectorTiming:
    """A sensorless six-step ESC commutates late while the rotor accelerates.

    It waits half of the *last* sector's duration after each zero crossing; if the speed changes,
    that is wrong by an angle that grows with the relative acceleration, and the freewheeling
    (demagnetisation) spike, which is longer at a high current, hides the crossing besides:
        δ = δ0 + a·(u - n)/n + d·(1 + tanh((u - n)/0.04)),
        torque per ampere ∝ cos δ, so the lag of the speed is τ·cos δ0 / cos δ
    with n the speed, u the command. Spinning up is slowed down, braking (early commutation, which
    acts as timing advance) is not: the lag depends on the direction and on the speed.
    Source: Krishnan, Permanent Magnet Synchronous and Brushless DC Motor Drives, ch. 9-10 (phase
    advance, sensorless commutation); Kim et al., commutation delay in sensorless BLDC drives, IEEE
    Trans. Ind. Electron. Felt here: the attitude loop lives of speed changes within 0.1 s.
    """

    def __init__(self, strength: float) -> None:
        self.a, self.d = 2.2 * strength, 0.45 * strength

    def step(self, s: Situation) -> Change:
        lag = np.empty(4)
        for i in range(4):
            n = float(s.speed[i])
            ahead = float(s.command[i]) - n
            late = self.a * ahead / max(n, 0.15) + self.d * (1.0 + math.tanh(ahead / 0.04))
            late = 1.25 * math.tanh((0.25 + late) / 1.25)
            lag[i] = 0.9689 / math.cos(late)
        return Change(lag=lag)


class BridgeBlankingLoss:
    """Blanking (dead) time and diode drops of the ESC's half bridges eat voltage.

    During the blanking time the diodes decide, so the mean voltage is wrong by Δ = t_d·f_pwm (plus
    the drops) against the current's direction; with a ripple in the current the jump is a smooth
    S around zero current:
        u_eff = u - Δ·tanh(i/i_r) - R_on·i,   i = k·(u - n) + i_load·(n/0.5)²
    Above hover load the loss is constant (a trim); when a motor shall slow down, its current passes
    zero and Δ changes sign, so that the motor brakes less than was asked: a dead zone on one side.
    Source: Mohan, Undeland & Robbins, Power Electronics, §8-5 (effect of blanking time); Jeong &
    Park, The analysis and compensation of dead-time effects in PWM inverters, IEEE Trans. Ind.
    Electron. 38 (1991). Felt here: with 1 µs at 24-48 kHz and small motors Δ is some per cent of
    full duty, and the commands only move by ±5 %.
    """

    def __init__(self, strength: float) -> None:
        self.drop, self.resist = 0.019 * strength, 0.04 * strength

    def step(self, s: Situation) -> Change:
        command = np.empty(4)
        for i in range(4):
            u, n = float(s.command[i]), float(s.speed[i])
            current = (u - n) + 0.035 * (2.0 * n) ** 2
            command[i] = u - self.drop * (math.tanh(current / 0.03) - 0.8) - self.resist * current
        return Change(command=command)


class CoastingBladeSpooldown:
    """Speed controllers without active braking: the motor drives a propeller up, only air slows it.

    J Ω' = k i - q Ω², with i not below zero: upwards the current shortens the rise, downwards the
    rotor coasts with J/(2 q Ω), which is also longer the slower it turns:
    lag/lag0 = [1 + b σ((speed - command)/w)] (Ω0/Ω)^p, σ the logistic function, Ω² ~ speed.
    Source: Krishnan, Permanent Magnet Synchronous and Brushless DC Motor Drives; Bangura & Mahony 2014.
    Felt here: the falling motors of each manoeuvre answer twice as late as the rising ones, and all
    are later at low throttle.
    """

    MORE, WIDTH, POWER = 1.0, 0.008, 1.0

    def __init__(self, strength):
        self.more = strength * self.MORE
        self.power = strength * self.POWER

    def step(self, s: Situation) -> Change:
        lag = []
        for c, v in zip(s.command.tolist(), s.speed.tolist(), strict=True):
            x = (v - c) / self.WIDTH
            x = 30.0 if x > 30.0 else max(x, -30.0)
            lag.append((1.0 + self.more / (1.0 + math.exp(-x)))
                       * (0.5 / (max(0.1, v))) ** (0.5 * self.power))
        out = Change()
        out.lag = np.array(lag)
        return out


class CoastingSpinDown:
    """ESC without active braking: rotors speed up under power but slow down by the drag of the
    blades only.

    J w' = k_t i - k_q w^2, i >= 0: the fall's time constant J/(2 k_q w) goes as 1/w; for a deep
    drop the
    back-EMF exceeds the bus and the bridge's diodes brake again.  lag = 1 + a S(speed-command)
    (w0/w)/(1+drop/d).
    w as sqrt(thrust).  Hughes & Drury, Electric Motors and Drives, ch. 3; Mahony, Kumar, Corke,
    IEEE RAM 2012.
    Felt: the falling pair lags behind the rising pair, more so at low throttle.
    """

    def __init__(self, strength):
        self.k = strength

    def step(self, s: Situation) -> Change:
        out = []
        for u, w in zip(s.command.tolist(), s.speed.tolist(), strict=False):
            drop = w - u
            share = 0.5 * (1.0 + math.tanh(drop / 0.004))
            out.append(1.0 + self.k * 1.2 * share * math.sqrt(0.5 / max(w, 0.1))
                       / (1.0 + max(drop, 0.0) / 0.10))
        return Change(lag=np.array(out))


class GovernorCurrentLimit:
    """ESC with a speed governor: its integrator overshoots, and the phase-current limit holds
    it back.

    I' = ki (ref - w) + (i_lim - i)/Ta (back-calculation),  drive = w + L tanh((ref + I - w)/L).
    Astrom & Hagglund, Advanced PID Control, ch. 3 (windup); Krishnan, Permanent Magnet
    Synchronous and
    Brushless DC Motor Drives, ch. 9.  Felt: thrust overshoots small steps, large ones are
    slope-limited.
    """

    def __init__(self, strength):
        self.k, self.i = strength, [0.0] * 4

    def step(self, s: Situation) -> Change:
        out, lim = [], 0.14
        for m, (u, w) in enumerate(zip(s.command.tolist(), s.speed.tolist(), strict=False)):
            want = u - w + self.i[m]
            got = lim * math.tanh(want / lim)
            self.i[m] += s.dt * (5.0 * self.k * (u - w) + 3.0 * (got - want))
            out.append(w + got)
        return Change(command=np.array(out))


class CommutationBeat:
    """Commutation pulled into step with the PWM: flat spots of the throttle where the two
    frequencies lock.

    Near f_pwm = n/2 * f_comm the sampling of the switching instants gives a detent torque as in
    Adler's
    equation: tau w' = u - w - A [sin(p) + 0.35 sin(2p + 0.6)],  p = 2 pi w V/(12 P), speed for
    a given drive with V.
    Adler, Proc. IRE 34 (1946); BLHeli manual (PWM/commutation beat, steps in mid throttle).
    Felt: sluggish inside a lock, a lively hop between two; every motor sits at its own place.
    """

    def __init__(self, strength):
        self.k = strength

    def step(self, s: Situation) -> Change:
        period = 0.085
        a = self.k * 0.50 * period / (2.0 * math.pi)
        w1 = 2.0 * math.pi * s.battery_v / (12.0 * period)
        out = []
        for m, (u, w) in enumerate(zip(s.command.tolist(), s.speed.tolist(), strict=False)):
            p = w1 * w * (1.0 + 0.012 * (m - 1.5))
            out.append(u - a * (math.sin(p) + 0.35 * math.sin(2.0 * p + 0.6)))
        return Change(command=np.array(out))


class CoastingMotors:
    """Speed controllers that drive the propeller up but let it coast down.

    Without active braking only the propeller's drag slows the rotor; J W' = -kq W^2 has the time
    constant J/(2 kq W), longer the slower it turns; upwards the motor's back-EMF adds its damping:
        lag / lag0 = 1 + 0.9 a sqrt(0.5/speed) * coasting,  coasting = 1/2 - 1/2 tanh((command -
        speed)/0.008)
    Source: motor equation in Mahony, Kumar & Corke, "Multirotor Aerial Vehicles" (IEEE RAM
    2012) and
    in Franchi & Mallet, "Adaptive closed-loop speed control of BLDC motors" (ICRA 2017). Felt with
    every controller whose 'damped light' is off: half of the torque comes from the falling motors.
    """

    def __init__(self, strength: float) -> None:
        self.a = 0.9 * strength

    def step(self, s: Situation) -> Change:
        c = Change()
        a = self.a
        c.lag = np.array([
            1.0 + a * math.sqrt(0.5 / max(0.1, v)) * (0.5 - 0.5 * math.tanh((u - v) / 0.008))
            for u, v in zip(s.command.tolist(), s.speed.tolist())
        ])
        return c


class CoastingWithoutBrakeAgain:
    """The ESCs are set without damped light: they drive the propellers, but do not slow them.

    A mechanic says: active braking (damped light, complementary PWM) is off.
    Source: a motor fed over a freewheeling diode takes no reversed current (Mohan, Undeland &
    Robbins, Power Electronics, discontinuous conduction of the step-down converter). The
    electrical damping K²/(R J) with that of the air acts while it is driven; when it has to slow,
    only the share of the air is left besides what a falling drive still gives: a longer lag.
    Felt: crisp when it picks up, mushy when it lets go; wobbles after a flick.
    """

    def __init__(self, strength: float) -> None:
        electric = 0.45  # the share of the damping that is lost at strength 1
        self.down = 1.0 + strength * (1.0 / (1.0 - electric) - 1.0)

    def step(self, s: Situation) -> Change:
        return Change(lag=np.where(s.command < s.speed, self.down, 1.0))


class EscLosesStep:
    """The ESC of motor 2 loses the rotor at a quick rise and needs a moment to catch it again.

    A mechanic says: ESC desync, stutter on punch-outs, timing set too low.
    Source: pull-out of a synchronous machine: T = Tmax sin(load angle), synchronism is lost beyond
    90° (Fitzgerald, Electric Machinery, ch. 5). The load angle grows with the acceleration that is
    wanted of the rotor, (command - speed)/lag; while it is lost the rotor coasts.
    Felt: a hiccup, a chirp of one motor, and that arm dips for a tenth of a second.
    """

    def __init__(self, strength: float) -> None:
        self.pull_out = 0.030  # lead of the command over the rotor
        self.deep = 1.0 - 0.18 * strength  # where it would coast to
        self.coast, self.catch = 0.035, 0.030  # s
        self.lost_s, self.wait_s = 0.070, 0.20  # s until it has found it; sure for a while
        self.factor, self.left, self.sure = 1.0, 0.0, 0.0

    def step(self, s: Situation) -> Change:
        self.left, self.sure = max(self.left - s.dt, 0.0), max(self.sure - s.dt, 0.0)
        lead = float(s.command[2] - s.speed[2])
        if self.left == 0.0 and self.sure == 0.0 and lead > self.pull_out:
            self.left, self.sure = self.lost_s, self.lost_s + self.wait_s
        goal, tau = (self.deep, self.coast) if self.left > 0.0 else (1.0, self.catch)
        self.factor += s.dt / tau * (goal - self.factor)
        factors = np.ones(4)
        factors[2] = self.factor
        return Change(thrust=factors)


class CoastingMotorsAgain:
    """The ESCs' active braking is off: the propellers are driven up, but coast down by drag alone.

    A mechanic says: damped light / braking switched off in the ESCs, the motors run on.

    A brushless motor without regenerative braking (Franchi & Mallet 2017, closed-loop ESCs;
    complementary PWM in the BLHeli manual): while the command is below the speed the bridge
    delivers no torque, J·w' = -k·w², slower than under drive. Felt: crisp in acceleration, sloppy
    when it should stop; it floats after a throttle cut.
    """

    SLOWER = 1.1
    """Part by which the lag is longer in the fall, at strength 1."""

    def __init__(self, strength):
        self.slower = self.SLOWER * strength

    def step(self, s: Situation) -> Change:
        # the drag of the propeller goes with thrust: slower yet where it is slow already
        slow = self.slower * np.sqrt(HOVER / np.maximum(s.speed, 0.1))
        return Change(lag=1.0 + np.where(s.command < s.speed, slow, 0.0))


PLANTS = (
    Plant('coasting_without_brake', CoastingWithoutBrake, 'bearings', 3, rig=True),
    Plant('speed_governor_esc', SpeedGovernorEsc, 'bearings', 4, rig=True),
    Plant('mixed_esc_braking', MixedEscBraking, 'hinges', 3, rig=False,
          may_be=('motor_lag', 'thrust_curve')),
    Plant('esc_anti_jitter', EscAntiJitter, 'hinges', 4, rig=True, may_be=('backlash',)),
    Plant('twisted_motor_mounts', TwistedMotorMounts, 'hinges', 5, rig=False,
          may_be=('cross_axis_input', 'thrust_curve')),
    Plant('coasting_esc', CoastingEsc, 'joints', 3, rig=False, may_be=('motor_lag', 'saturation')),
    Plant('rpm_governor', RpmGovernor, 'joints', 4, rig=False, may_be=('motor_lag',)),
    Plant('current_foldback', CurrentFoldback, 'joints', 5, rig=False,
          may_be=('saturation', 'motor_lag')),
    Plant('coasting_props', CoastingProps, 'hoses', 7, rig=False,
          may_be=('saturation', 'motor_lag')),
    Plant('coasting_controller', CoastingController, 'gears', 3, rig=True,
          may_be=('motor_lag', 'saturation')),
    Plant('speed_governor', SpeedGovernor, 'gears', 4, rig=False, may_be=('saturation',)),
    Plant('hot_winding', HotWinding, 'gears', 5, rig=False, may_be=('cross_axis_input',)),
    Plant('shaded_stator_heat', ShadedStatorHeat, 'greases', 3, rig=False),
    Plant('tardy_sector_timing', TardySectorTiming, 'greases', 4, rig=True, may_be=('motor_lag',)),
    Plant('bridge_blanking_loss', BridgeBlankingLoss, 'greases', 5, rig=False,
          may_be=('dead_zone', 'motor_lag', 'thrust_curve')),
    Plant('coasting_blade_spooldown', CoastingBladeSpooldown, 'chains', 6, rig=True,
          may_be=('motor_lag',)),
    Plant('coasting_spin_down', CoastingSpinDown, 'governors', 3, rig=True, may_be=('motor_lag',)),
    Plant('governor_current_limit', GovernorCurrentLimit, 'governors', 4, rig=True,
          may_be=('saturation', 'motor_lag')),
    Plant('commutation_beat', CommutationBeat, 'governors', 5, rig=True,
          may_be=('cross_axis_input', 'thrust_curve')),
    Plant('coasting_motors', CoastingMotors, 'umbilicals', 6, rig=False, may_be=('motor_lag',)),
    Plant('coasting_without_brake_again', CoastingWithoutBrakeAgain, 'workshop', 4, rig=False,
          may_be=('motor_lag',)),
    Plant('esc_loses_step', EscLosesStep, 'workshop', 6, rig=True),
    Plant('coasting_motors_again', CoastingMotorsAgain, 'field', 6, rig=False,
          may_be=('motor_lag',)),
)
