"""Twelve physical effects of a quadrotor's attitude axis or of its one-axis test rig."""
import math

import numpy as np
from outside_simulator import MIX, Change, Situation

G = 9.81
SIGN = [[float(v) for v in MIX[:, 1 + a]] for a in range(3)]
"""SIGN[axis][motor]: +1 where the motor's thrust turns the axis up."""


# ---------------------------------------------------------------- friction and play of a rig
class LoadedBearingFriction:
    """Dry friction of the rig's pivot: LuGre with Stribeck peak, under a load that the lift
    relieves.

    z' = v - s0 |v| z / g(v),  g = N (Fc + (Fs-Fc) exp(-(v/vs)^2)),  torque = -(s0 z + s1 z'
    exp(-(v/vd)^2)).
    N: the pivot carries the weight of craft and frame less the rotors' lift, so it sticks more
    at low throttle.
    Canudas de Wit, Olsson, Astrom, Lischinsky, IEEE TAC 40 (1995); Armstrong-Helouvry 1994 (load).
    Felt: the axis reverses with every reference step and passes through stiction each time.
    """

    def __init__(self, strength):
        self.k, self.z = strength, 0.0

    def step(self, s: Situation) -> Change:
        c = Change()
        v = float(s.rate[s.axis])
        lift = float(s.speed.sum()) * 0.5
        load = 0.3 + 0.7 * abs(1.6 - lift * math.cos(float(s.angle[s.axis]))) / 0.6
        g = load * (0.75 + 0.55 * math.exp(-(v / 0.12) ** 2))
        old = self.z
        self.z = (old + s.dt * v) / (1.0 + s.dt * 400.0 * abs(v) / g)
        slide = (self.z - old) / s.dt
        c.torque[s.axis] = -self.k * (400.0 * self.z + 5.0 * slide * math.exp(-(v / 0.3) ** 2))
        return c


class GearBacklash:
    """An eddy-brake and encoder wheel geared to the axis with play between the teeth.

    Two inertias and a dead zone: d = th - th2, contact where |d| > b, Hunt-Crossley tooth force
    T = k (|d|-b) (1 + x d') >= 0;  J2 th2'' = T - d2 th2' - m2 tanh(th2'/e).  The axis receives
    -T.
    Nordin & Gutman, Automatica 38 (2002); Hunt & Crossley, J. Appl. Mech. 42 (1975).
    Felt: at each reversal the wheel coasts freely, then its inertia and drag come back with a
    knock.
    """

    def __init__(self, strength):
        self.k, self.at, self.v2 = strength, None, 0.0

    def step(self, s: Situation) -> Change:
        c = Change()
        th, v = float(s.angle[s.axis]), float(s.rate[s.axis])
        if self.at is None:
            self.at = th
        h, total = s.dt / 2, 0.0
        for i in range(2):
            d = th + v * h * i - self.at
            dv = v - self.v2
            deep = abs(d) - 0.025
            force = 0.0
            if deep > 0.0:
                side = 1.0 if d > 0.0 else -1.0
                force = side * 350.0 * deep * max(0.0, 1.0 + 1.2 * side * dv)
            total += 0.5 * force
            self.v2 += h * (force - 0.55 * self.v2 - 0.15 * math.tanh(self.v2 / 0.05)) / 0.14
            self.at += h * self.v2
        c.torque[s.axis] = -self.k * total
        return c


class ThixotropicGrease:
    """Drag of a grease-packed gimbal bearing: shear-thinning, its structure broken by motion,
    rebuilt at rest.

    torque = -l K v / (v^2 + e^2)^((1-n)/2),  l' = (1-l)/tr - kb |v| l   (n = 0.35).
    Herschel-Bulkley/Ostwald power law with Moore's structural kinetics: Barnes, J. Non-Newt.
    Fluid Mech. 70
    (1997); Lugt, Grease Lubrication in Rolling Bearings (2013).
    Felt: after a second of calm the first movement is heavy, then it eases as the grease is
    worked.
    """

    def __init__(self, strength):
        self.k, self.l = strength, 1.0

    def step(self, s: Situation) -> Change:
        c = Change()
        v = float(s.rate[s.axis])
        self.l = (self.l + s.dt / 1.4) / (1.0 + s.dt * (1.0 / 1.4 + 4.0 * abs(v)))
        c.torque[s.axis] = -self.k * 4.4 * self.l * v * (v * v + 0.0016) ** -0.325
        return c


# ---------------------------------------------------------------- motors and controllers
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


# ---------------------------------------------------------------- aerodynamics
class DynamicInflow:
    """Inflow that has to build up, and rotors that plunge with the turning arm.

    Carpenter-Fridovich per rotor, in units of hover inflow: tau v' = T - v (v + c),  c = climb
    of the hub by
    arm * rate;  T = T0 (1 - a (v + c - v0)),  v0 = sqrt(T0) (where the blade finds its old
    thrust).
    Carpenter & Fridovich NACA TN 3044 (1953); Leishman, Principles of Helicopter Aerodynamics,
    ch. 10.
    Felt on large slow propellers: thrust jumps ahead and settles; the turning arm is damped,
    then partly let go.
    """

    def __init__(self, strength):
        self.k, self.v = strength, None

    def step(self, s: Situation) -> Change:
        c, i = Change(), s.axis
        t0 = [max(2.0 * w, 0.05) for w in s.speed.tolist()]
        if self.v is None:
            self.v = [math.sqrt(t) for t in t0]
        climb, total = 0.03 * float(s.rate[i]), 0.0
        for m in range(4):
            sign, v = SIGN[i][m], self.v[m]
            up = sign * climb
            t = t0[m] * (1.0 - 0.65 * (v + up - math.sqrt(t0[m])))
            self.v[m] = v + s.dt * (t - v * (v + up)) / 0.08
            total += sign * (t - t0[m])
        c.torque[i] = self.k * (450.0, 400.0, 60.0)[i] * total / 8.0
        return c


class FlappingInWind:
    """Blades that flap back and a hull above the centre of mass that is blown, in the craft's
    own airspeed.

    u' = g sin(angle) - c1 (u-W) T - c2 (u-W)|u-W|;  torque = -T k1 (u-W)/(1+(u-W)^2/U^2) - k2
    (u-W)|u-W| - k3 T rate,
    wind W a mean with slow swell.  Flapping a1 ~ mu: Prouty, Helicopter Performance, ch. 7;
    Hoffmann et al. AIAA 2007-6461;
    Pounds, Mahony, Corke 2010.  Felt: whoever tilts starts to slide and the sliding rights the
    craft seconds later.
    """

    def __init__(self, strength):
        self.k, self.u = strength, 0.0

    def step(self, s: Situation) -> Change:
        c, i = Change(), s.axis
        wind = 1.0 + 0.8 * math.sin(0.9 * s.t) + 0.5 * math.sin(2.3 * s.t + 1.0)
        a, lift = self.u - wind, float(s.speed.sum()) * 0.5
        self.u += s.dt * (G * math.sin(float(s.angle[i])) - 0.35 * a * lift - 0.06 * a * abs(a))
        c.torque[i] = -self.k * (lift * 0.75 * a / (1.0 + a * a / 36.0) + 0.08 * a * abs(a)
                                 + 0.3 * lift * float(s.rate[i]))
        return c


class GroundCushion:
    """A rig low over the floor: each rotor in its own ground effect, with the fountain between
    them.

    Cheeseman-Bennett per rotor T = T0 / (1 - (R/4z)^2), z = h - r sin(angle): the low side is
    carried more;
    the cushion follows through tau = 0.08 s; the fountain under the hull pushes up
    the risen side, +kf lift^2 sin(angle)/(1 + (sin(angle)/w)^2), and so fights the cushion.
    Cheeseman & Bennett ARC R&M 3021 (1955); Sanchez-Cuevas, Heredia,
    Ollero, Int. J. Aerosp. Eng. 2017.  Felt: a stiffening spring, with delay, soft near level,
    that grows with thrust.
    """

    def __init__(self, strength):
        self.k, self.y = strength, None

    def step(self, s: Situation) -> Change:
        c, i = Change(), s.axis
        lean = math.sin(float(s.angle[i]))
        if self.y is None:
            self.y = [0.0] * 4
        total, sp = 0.0, s.speed.tolist()
        for m in range(4):
            sign = SIGN[i][m]
            z = max(0.125 + 0.16 * sign * lean, 0.06)
            q = (0.125 / (4.0 * z)) ** 2
            self.y[m] += s.dt / 0.08 * (q / (1.0 - q) - self.y[m])
            total += sign * sp[m] * self.y[m]
        lift = 0.5 * sum(sp)
        fountain = 2.0 * lift * lift * 2.0 * lean / (1.0 + (lean / 0.12) ** 2)
        c.torque[i] = self.k * (0.28 * (450.0, 400.0, 60.0)[i] * total / 4.0 + 0.35 * fountain)
        return c


# ---------------------------------------------------------------- sensing and estimation
class SoftGyroMount:
    """Gyro board on foam: it swings on its pad, which stiffens as it is compressed.

    q'' = -2 z wn (q' - rate) - wn^2 (q - angle) (1 + ((q-angle)/d)^2);  the gyro shows q'.
    Den Hartog, Mechanical Vibrations, ch. 2-3; Duffing stiffening: Harris' Shock and Vibration
    Handbook ch. 4.
    Felt: the heavy controller on soft foam overshoots each quick turn and rings at some 7 Hz.
    """

    def __init__(self, strength):
        self.w2 = (2.0 * math.pi * 7.5) ** 2 / strength
        self.d, self.v, self.old = 0.0, 0.0, None

    def step(self, s: Situation) -> Change:
        c, i = Change(), s.axis
        # d: swing against the hull, v: its rate
        spring = self.w2 * self.d * (1.0 + (self.d / 0.012) ** 2)
        push = -spring - 0.36 * math.sqrt(self.w2) * self.v
        self.v += s.dt * (push - float(s.acceleration[i]))
        self.d += s.dt * self.v
        c.gyro[i] = self.v
        return c


class EstimatorBiasLeak:
    """Attitude filter that takes the craft's tilt for gyro bias, since an accelerometer in
    flight hardly sees tilt.

    Mahony: e = (acc - est) w(rate), est' = gyro - b + kp e, b' = -ki e - b/Tb; the rate handed
    out is gyro - b.
    In free flight acc shows rotor drag only: acc = cd u/g, u' = g angle - cd u.
    w = 1/(1+(rate/r)^2): less trust while turning.  Mahony, Hamel, Pflimlin, IEEE TAC 53
    (2008); Martin & Salaun, ICRA 2010.
    Felt: after a long tilt the reported rate is off for seconds.
    """

    def __init__(self, strength):
        self.k, self.est, self.b, self.u = strength, 0.0, 0.0, 0.0

    def step(self, s: Situation) -> Change:
        c, i = Change(), s.axis
        rate = float(s.rate[i])
        self.u += s.dt * (G * float(s.angle[i]) - 0.4 * self.u)
        e = (0.4 * self.u / G - self.est) / (1.0 + (rate / 0.8) ** 2)
        self.est += s.dt * (rate - self.b + 1.2 * e)
        self.b += s.dt * (-1.4 * e - self.b / 6.0)
        c.gyro[i] = -self.k * self.b
        return c


class AdaptiveRateFilter:
    """Smoothing of the rate whose cutoff opens with quick motion and with throttle.

    y' = 2 pi fc (x - y),  fc = f0 (1 + g (throttle-0.5)) + beta |slope|,  slope = x' through 3 Hz.
    Casiez, Roussel, Vogel, "1 euro filter", CHI 2012; dynamic low-pass of Betaflight (throttle).
    Felt: slow movements arrive late, quick ones nearly in time.
    """

    def __init__(self, strength):
        self.k, self.y, self.slope = strength, 0.0, 0.0

    def step(self, s: Situation) -> Change:
        c, i = Change(), s.axis
        x = float(s.rate[i])
        self.slope += s.dt * 2.0 * math.pi * 3.0 * (float(s.acceleration[i]) - self.slope)
        fc = (4.0 * (1.0 + 3.0 * (s.throttle - 0.5)) + 1.2 * abs(self.slope)) / self.k
        self.y += (x - self.y) * (1.0 - math.exp(-2.0 * math.pi * fc * s.dt))
        c.gyro[i] = self.y - x
        return c


EFFECTS = {
    'loaded_bearing_friction': (LoadedBearingFriction, True),
    'gear_backlash': (GearBacklash, True),
    'thixotropic_grease_again': (ThixotropicGrease, True),
    'coasting_spin_down': (CoastingSpinDown, True),
    'governor_current_limit': (GovernorCurrentLimit, True),
    'commutation_beat': (CommutationBeat, True),
    'dynamic_inflow_again': (DynamicInflow, False),
    'flapping_in_wind': (FlappingInWind, False),
    'ground_cushion_again': (GroundCushion, True),
    'soft_gyro_mount': (SoftGyroMount, False),
    'estimator_bias_leak': (EstimatorBiasLeak, False),
    'adaptive_rate_filter': (AdaptiveRateFilter, True),
}
FAMILIES = {
    'friction': ('loaded_bearing_friction', 'gear_backlash', 'thixotropic_grease_again'),
    'motors': ('coasting_spin_down', 'governor_current_limit', 'commutation_beat'),
    'aerodynamics': ('dynamic_inflow_again', 'flapping_in_wind', 'ground_cushion_again'),
    'sensing': ('soft_gyro_mount', 'estimator_bias_leak', 'adaptive_rate_filter'),
}

MAY_BE = {
    'loaded_bearing_friction': ('coulomb_friction',),
    'gear_backlash': ('backlash', 'coulomb_friction'),
    'thixotropic_grease_again': ('coulomb_friction',),
    'coasting_spin_down': ('motor_lag',),
    'governor_current_limit': ('saturation', 'motor_lag'),
    'commutation_beat': ('cross_axis_input', 'thrust_curve'),
    'flapping_in_wind': ('periodic_disturbance',),
    'ground_cushion_again': ('pendulum_stiffness', 'cubic_stiffness'),
    'soft_gyro_mount': ('resonance', 'cubic_stiffness'),
}
