"""Twelve effects on one attitude axis: rig mechanics, surroundings, software, propulsion
mechanics.
"""

from __future__ import annotations

import math

import numpy as np
from outside_simulator import MIX, Change, Situation

G = 9.81


def signs(axis):
    """Signs of the four motors on an axis, as floats."""
    return [float(x) for x in MIX[:, axis + 1]]


# ---------------------------------------------------------------------- 1. one-axis test rigs

class LoadedPivotFriction:
    """Plain pivot bearing with presliding friction whose level follows the load on the bearing.

    Dahl: dF/dt = sigma·w·(1 − F/Fc·sgn w); Fc = mu·r·N/I with N = weight − lift (thrust relieves
    the pivot), and sigma = Fc/x0: the asperities bend over some hundredths of a radian before
    they slide.
    Source: P. Dahl, "A solid friction model" (1968); Armstrong-Hélouvry, Dupont, Canudas de Wit,
    Automatica 30 (1994). Felt: a rig's axle carries the aircraft; its friction holds against
    small torques and grows when the throttle goes down.
    """

    def __init__(self, strength):
        self.fc, self.x0, self.f = 1.0 * strength, 0.015, 0.0

    def step(self, s: Situation) -> Change:
        c = Change()
        w = float(s.rate[s.axis])
        lift = float(s.speed.sum()) * 0.5
        load = max(1.7 - lift, 0.15) / 0.7
        fc = self.fc * load
        f = self.f + s.dt * fc / self.x0 * (w - abs(w) * self.f / fc)
        self.f = min(max(f, -fc), fc)
        c.torque[s.axis] = -self.f
        return c


class FoamStops:
    """Foam end stops left and right, unevenly placed, met at 6 and 8 hundredths of a radian.

    Hunt & Crossley: M = k·d^1.5·(1 + 1.5·e·d') for the depth d > 0 (never pulling); IEEE/ASME J.
    Appl. Mech. 42 (1975) 440. Felt: rigs have bumpers that save the propellers; the square
    reference lies in them.
    """

    def __init__(self, strength):
        self.k = 45.0 * strength

    def step(self, s: Situation) -> Change:
        c = Change()
        a, w = float(s.angle[s.axis]), float(s.rate[s.axis])
        if a > 0.06:
            d = a - 0.06
            c.torque[s.axis] = -self.k * d * math.sqrt(d) * max(1.0 + 0.5 * w, 0.0)
        elif a < -0.08:
            d = -0.08 - a
            c.torque[s.axis] = 1.2 * self.k * d * math.sqrt(d) * max(1.0 - 0.5 * w, 0.0)
        return c


class HangingWeight:
    """A balance weight that hangs on a rod below the axle and swings by itself.

    Rod of length L hung at depth d under the axle: L·p'' = −g·sin p − d·a'·cos(p−q) +
    d·w²·sin(q−p) − c·(p'−w), tension N = g·cos p + L·p'² and torque on the frame m·d/I·N·sin(p−q)
    + m·c'(p'−w), with q the frame's angle. Source: double pendulum, Meriam & Kraige, Dynamics, or
    Landau & Lifshitz, Mechanics §5.
    Felt: weights on hooks or threads are how rigs are balanced.
    """

    def __init__(self, strength):
        self.m = 0.7 * strength          # m·d/I, 1/m
        self.length, self.d, self.c = 0.20, 0.10, 1.2
        self.p = self.v = 0.0

    def step(self, s: Situation) -> Change:
        c = Change()
        q, w, acc = (float(x[s.axis]) for x in (s.angle, s.rate, s.acceleration))
        r = self.p - q
        sr = math.sin(r)
        slip = self.v - w
        a = -(G * math.sin(self.p) + self.d * (acc * math.cos(r) + w * w * sr)) / self.length \
            - self.c * slip
        tension = G * math.cos(self.p) + self.length * self.v * self.v
        self.v += s.dt * a
        self.p += s.dt * self.v
        c.torque[s.axis] = self.m * (tension * sr + self.c * self.length**2 / self.d * slip)
        return c


# ---------------------------------------------------------------------- 2. surroundings

class TableUnderRotors:
    """The rig stands on a table: each rotor has its own height over it, and the air cushion
    follows late.

    Sánchez-Cuevas, Heredia, Ollero (Int. J. Aerospace Eng. 2017), after Cheeseman & Bennett
    (1955), for each rotor at height z: T/T∞ = 1/(1 − (R/4z)² − R²z/(d²+4z²)^1.5 −
    R²z/2/(2d²+4z²)^1.5 − 2·K·R²z/(b²+4z²)^1.5), with z = z0 + y·sin(angle); the factor follows by
    the lag of the inflow, 80 ms. Felt: the lower rotors push more, and the cushion scales with
    throttle.
    """

    def __init__(self, strength):
        self.k, self.r2, self.z0, self.arm = strength, 0.0144, 0.26, 0.16
        self.low = self.high = None

    def ratio(self, z):
        r2, z4 = self.r2, 4.0 * z * z
        x, y, b = 0.1024 + z4, 0.2048 + z4, 0.2048 + z4
        loss = r2 / (16.0 * z * z) + r2 * z / (x * math.sqrt(x)) + 0.5 * r2 * z / (y * math.sqrt(y)) \
            + 4.0 * r2 * z / (b * math.sqrt(b))
        return 1.0 / (1.0 - min(loss, 0.5))

    def step(self, s: Situation) -> Change:
        rise = self.arm * math.sin(float(s.angle[s.axis]))
        high = self.ratio(max(self.z0 + rise, 0.04))
        low = self.ratio(max(self.z0 - rise, 0.04))
        if self.low is None:
            self.low, self.high = low, high
        self.high += s.dt / 0.08 * (high - self.high)
        self.low += s.dt / 0.08 * (low - self.low)
        up, down = 1.0 + self.k * (self.high - 1.0), 1.0 + self.k * (self.low - 1.0)
        return Change(thrust=np.array([up if m > 0 else down for m in signs(s.axis)]))


class WallRecirculation:
    """A wall at one side: the wake runs along the floor, up the wall, and is inhaled again after
    its journey.

    v_i = sqrt(T/2rhoA) (momentum theory); the part that returns leans with the aircraft, r = v·(1
    + a·sin q), arrives after the time path/v and mixes with 0.15 s; inflow added to a rotor costs
    thrust, dT/T ≈ −k·r for the near rotors and a quarter of it for the far ones. The mean is
    trimmed away. Sources: Leishman, Principles of Helicopter Aerodynamics (momentum theory,
    recirculation); Robinson, Chung, Ryan (2014) on quadrotors by walls.
    Felt: indoor flight and rigs in a corner.
    """

    def __init__(self, strength):
        self.k, self.lean = 0.042 * strength, 2.2
        self.past, self.at = [1.0] * 1024, 0
        self.mixed, self.wake = 1.0, 1.0

    def step(self, s: Situation) -> Change:
        c = Change()
        m = signs(s.axis)
        near = 0.0
        for i in range(4):
            if m[i] > 0:
                near += float(s.speed[i])
        v = math.sqrt(max(near, 0.1))
        self.wake += s.dt / 0.2 * (v - self.wake)
        self.at = (self.at + 1) & 1023
        self.past[self.at] = v * (1.0 + self.lean * math.sin(float(s.angle[s.axis])))
        back = min(int(250.0 / self.wake), 1000)
        self.mixed += s.dt / 0.15 * (self.past[(self.at - back) & 1023] - self.mixed)
        loss = self.k * self.mixed
        c.thrust = np.array([1.0 - (loss if x > 0 else 0.25 * loss) for x in m])
        c.torque[s.axis] = 450.0 * 0.25 * 0.75 * self.k
        return c


class SideWindAirspeed:
    """Free flight in a breeze: leaning makes sideways speed, and airspeed makes a moment that
    rights the aircraft.

    v' = g·sin q·T/T0 − b·(v−w) − b2·|v−w|(v−w); moment = −(k1·sqrt(T)·u + k2·u·|u|) with u = v −
    w (flap back of the blades, and drag over the centre of mass); w a breeze that wavers by
    periods of 2.3 and 5.9 s. Source: Bramwell, Helicopter Dynamics; Hoffmann, Huang, Waslander,
    Tomlin, AIAA 2007-6461; Mahony, Kumar, Corke (2012). Felt: always, outdoors.
    """

    def __init__(self, strength):
        self.k, self.v = strength, 0.0

    def step(self, s: Situation) -> Change:
        c = Change()
        t = s.t
        w = 0.5 + 0.3 * math.sin(2.73 * t) + 0.4 * math.sin(1.065 * t + 1.0)
        u = self.v - w
        load = float(s.speed.sum()) * 0.5
        self.v += s.dt * (G * math.sin(float(s.angle[s.axis])) * load - 0.45 * u - 0.08 * u * abs(u))
        c.torque[s.axis] = -self.k * (0.75 * math.sqrt(max(load, 0.0)) * u + 0.20 * u * abs(u))
        return c


# ---------------------------------------------------------------------- 3. flight software

class AdaptiveGyroFilter:
    """A low-pass on the gyro that opens with the motion, as the "1 euro" filter and the dynamic
    low-passes do.

    y' = (w − y)/tau, tau = tau0/(1 + |y_s|/w0), y_s the rate behind a slower filter of its own
    (60 ms).
    Source: Casiez, Roussel, Vogel, CHI 2012. Felt: little phase lag when it turns fast, much when
    it turns slowly.
    """

    def __init__(self, strength):
        self.tau, self.w0 = 0.030 * strength, 0.5
        self.y = self.size = 0.0

    def step(self, s: Situation) -> Change:
        c = Change()
        w = float(s.rate[s.axis])
        self.size += s.dt / 0.06 * (abs(self.y) - self.size)
        tau = self.tau / (1.0 + self.size / self.w0)
        self.y += (w - self.y) * s.dt / (tau + s.dt)
        c.gyro[s.axis] = self.y - w
        return c


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


class UnsynchronisedLoops:
    """Two tasks of almost equal period hand the command on through a buffer without being
    synchronised.

    The sender latches at k·P, the driver at k·P·(1+e): its command is as old as the beat phase
    says, from 0 to P, a saw of the period P/e, besides the hold's own P/2. Source: Åström &
    Wittenmark, Computer-Controlled Systems (sample and hold); Wittenmark, Nilsson, Törngren,
    "Timing problems in real-time control systems" (ACC 1995).
    Felt: I²C or CAN motor drivers with a clock of their own.
    """

    def __init__(self, strength):
        self.p = 0.012 * strength
        self.q = self.p * (1.0 + 0.012 / 2.9)
        self.send = self.take = 0.0
        self.buffer = self.out = None

    def step(self, s: Situation) -> Change:
        if self.out is None:
            self.buffer = self.out = s.command.copy()
        if s.t >= self.take - 1e-9:
            self.take += self.q
            self.out = self.buffer
        if s.t >= self.send - 1e-9:
            self.send += self.p
            self.buffer = s.command.copy()
        return Change(command=self.out.copy())


# ---------------------------------------------------------------------- 4. propulsion mechanics

class RubberHub:
    """Propellers held by rubber rings: the blades turn after the motor bell through a soft,
    damped, hardening coupling.

    x' = n_m − n; n' = W²·(x + h·x³) + 2·D·W·(n_m − n) − q·n²; thrust ∝ n². Source: torsional
    coupling, Den Hartog, Mechanical Vibrations; Dresig & Holzweissig, Dynamics of Machinery
    (elastomer couplings). Felt: "prop savers" and rubber-damped hubs; the mean torque winds the
    ring up, so that it is stiffer at high throttle.
    """

    def __init__(self, strength):
        self.w = 2.0 * math.pi * 10.0 / math.sqrt(strength)
        self.d, self.q, self.h = 0.28, 6.0, 8000.0
        self.n = self.x = None

    def step(self, s: Situation) -> Change:
        n_m = [math.sqrt(max(v, 0.02)) for v in s.speed.tolist()]
        w2, d = self.w * self.w, 2.0 * self.d * self.w
        if self.n is None:
            self.n, self.x = list(n_m), []
            for n in n_m:
                x = 0.0
                for _ in range(20):
                    x -= (w2 * (x + self.h * x**3) - self.q * n * n) / (w2 * (1.0 + 3.0 * self.h * x * x))
                self.x.append(x)
        f = [0.0] * 4
        for i in range(4):
            n, x = self.n[i], self.x[i]
            slip = n_m[i] - n
            n += s.dt * (w2 * (x + self.h * x * x * x) + d * slip - self.q * n * n)
            self.x[i] = x + s.dt * (n_m[i] - n)
            self.n[i] = n
            r = n / n_m[i]
            f[i] = r * r
        return Change(thrust=np.array(f))


class CreepingBlades:
    """Soft plastic blades untwist under their load, part at once and part by creep.

    Twist of a standard linear solid: e = T/T0 − 1, z' = (e − z)/tau, thrust factor 1 − a·(e +
    e²/2) − b·z; each rotor for itself.
    Source: Findley, Lai, Onaran, Creep and Relaxation of Nonlinear Viscoelastic Materials;
    Bisplinghoff, Ashley, Halfman, Aeroelasticity (twist under load). Felt: cheap nylon
    propellers; the thrust overshoots and then settles within a second.
    """

    def __init__(self, strength):
        self.a, self.b, self.tau = 0.15 * strength, 0.32 * strength, 0.7
        self.z = [0.0] * 4

    def step(self, s: Situation) -> Change:
        f = [1.0] * 4
        for i, v in enumerate(s.speed.tolist()):
            e = 2.0 * v - 1.0
            z = self.z[i] = self.z[i] + s.dt / self.tau * (e - self.z[i])
            f[i] = 1.0 - self.a * (e + 0.5 * e * e) - self.b * z
        return Change(thrust=np.array(f))


class ChippedPropeller:
    """One propeller has lost a tip; the aircraft was trimmed at hover, so that only what differs
    from hover shows.

    Blade elements: the tip's share of thrust goes with n² and, as it is the part where the
    Reynolds number and the flow's speed are highest, somewhat faster: loss = d·T·(T/T0)^0.5; and
    the axial flow y·w at the rotor takes its share a·n·y·w of the remaining thrust. Trim: +d·T0.
    Source: Leishman, Principles of Helicopter Aerodynamics (blade element theory, climb);
    Ghalamchi & Mueller (ICUAS 2018) on damaged propellers. Felt: after every crash; throttle
    rolls the aircraft.
    """

    def __init__(self, strength):
        self.d, self.a = 0.085 * strength, 0.020 * strength

    def step(self, s: Situation) -> Change:
        c = Change()
        v = max(float(s.speed[0]), 0.02)
        loss = self.d * v * math.sqrt(2.0 * v) + self.a * math.sqrt(2.0 * v) * float(s.rate[s.axis])
        c.thrust = np.array([1.0 - loss / v, 1.0, 1.0, 1.0])
        c.torque[s.axis] = 450.0 * 0.25 * self.d * 0.5
        return c


EFFECTS = {
    'loaded_pivot_friction': (LoadedPivotFriction, True),
    'foam_stops': (FoamStops, True),
    'hanging_weight': (HangingWeight, True),
    'table_under_rotors': (TableUnderRotors, True),
    'wall_recirculation': (WallRecirculation, False),
    'side_wind_airspeed': (SideWindAirspeed, False),
    'adaptive_gyro_filter': (AdaptiveGyroFilter, True),
    'slew_limit': (SlewLimit, True),
    'unsynchronised_loops': (UnsynchronisedLoops, True),
    'rubber_hub': (RubberHub, True),
    'creeping_blades': (CreepingBlades, True),
    'chipped_propeller': (ChippedPropeller, False),
}
FAMILIES = {
    'rig mechanics': ('loaded_pivot_friction', 'foam_stops', 'hanging_weight'),
    'surroundings': ('table_under_rotors', 'wall_recirculation', 'side_wind_airspeed'),
    'flight software': ('adaptive_gyro_filter', 'slew_limit', 'unsynchronised_loops'),
    'propulsion mechanics': ('rubber_hub', 'creeping_blades', 'chipped_propeller'),
}
MAY_BE = {
    'loaded_pivot_friction': ('coulomb_friction',),
    'foam_stops': ('cubic_stiffness',),
    'hanging_weight': ('pendulum_stiffness', 'resonance'),
    'side_wind_airspeed': ('periodic_disturbance',),
    'rubber_hub': ('resonance', 'thrust_curve'),
    'creeping_blades': ('thrust_curve',),
    'chipped_propeller': ('thrust_curve',),
}
"""Names of the table that are no lie: what the effect contains, or cannot be told from."""
