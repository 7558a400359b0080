"""Inflow, flapping and deformation of the propellers."""

from __future__ import annotations

import math

import numpy as np

from .simulator import HOVER, INERTIA, MASS, SIDE, Change, G, Plant, Situation, drive

HOVER_SPEED = 2.0 * math.pi * 95.0
"""rad/s of a propeller in hover; 5700 rpm."""


class DynamicInflow:
    """The air under a rotor must first be set in motion: thrust overshoots a change of speed, and
    falls when the rotor rises.

    Blade element: T ~ W^2 (theta/3 - lambda/2), so against the steady state
        T/T_qs = 1 + kappa [(v_qs - v) - l_i w]/v_qs,   v_qs = v_h sqrt(s/0.5)
        dv/dt = (v_qs^2 - v^2)/(2 v_h T_v)         (apparent mass of air, momentum theory;
        nonlinear in v)
    with v_h = 6 m/s, arm l = 0.1 m, T_v = 0.07 s, kappa = 0.45 strength.
    Sources: Carpenter & Fridovich, NACA TN 3044 (1953); Pitt & Peters, Vertica 5 (1981); Leishman
    ch. 10; rotor damping by axial speed: Padfield, 'Helicopter Flight Dynamics' ch. 2.
    Felt: the torque of quick control moves is larger than static thrust tests tell, that of
    lasting ones is not.
    """

    def __init__(self, strength):
        self.k = strength
        self.v = [6.0, 6.0, 6.0, 6.0]

    def step(self, s: Situation) -> Change:
        roll, pitch = float(s.rate[0]), float(s.rate[1])
        factor, v, k, dt = [], self.v, 0.45 * self.k, s.dt
        i = 0
        for speed in s.speed.tolist():
            steady = 6.0 * math.sqrt(2.0 * speed if speed > 0.05 else 0.1)
            w = v[i]
            climb = 0.1 * (SIDE[0][i] * roll + SIDE[1][i] * pitch)
            factor.append(1.0 + k * (steady - w - climb) / steady)
            v[i] = w + dt * (steady * steady - w * w) / (2.0 * 6.0 * 0.07)
            i += 1
        return Change(thrust=np.array(factor))


class FlapBackByTranslation:
    """A tilted aircraft slides off sideways, and the rotors in crosswind flap back and tilt it
    against its motion.

        dv/dt = g (T/0.5) sin(theta) - D v sqrt(T/0.5)          (rotor drag ~ v times rotor speed)
        torque = -[c1 v sqrt(T/0.5) + c2 v |v|]                 (flap-back a1 = 2 mu (4/3 theta -
        lambda); hull above c.g.)
    Sources: Mahony, Kumar & Corke, 'Multirotor aerial vehicles', IEEE RAM 19 (2012); Hoffmann,
    Huang, Waslander & Tomlin, AIAA 2007-6461; Bramwell, 'Helicopter Dynamics' (speed stability
    M_u).
    Felt: in any free flight; the known phugoid-like 'M_u' derivative, which a model of attitude
    alone has no state for.
    """

    def __init__(self, strength):
        self.k = strength
        self.v = 0.0

    def step(self, s: Situation) -> Change:
        a, b, c, d = s.speed.tolist()
        lift = 0.5 * (a + b + c + d)
        root = math.sqrt(max(0.0, lift))
        v = self.v
        self.v = v + s.dt * (G * lift * math.sin(float(s.angle[s.axis])) - 0.5 * root * v)
        out = Change()
        out.torque[s.axis] = -self.k * (0.75 * v * root + 0.2 * v * abs(v))
        return out


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


class InflowOvershoot:
    """Rotor inflow that needs time to build up, with the rotors' own climbing and sinking as the
    aircraft turns.

    tau v' = T - v (v + w)        (momentum with apparent mass, in units of hover thrust and
    inflow) T = (u/u0) f,  f = 1 - a [(v + w)/sqrt(u/u0) - 1]   (blade element),  w = y_i L p /
    v_h.
    Source: Carpenter, Fridovich, NACA TN 3044 (1953); Pitt, Peters, Vertica 5 (1981); Leishman,
    "Principles of Helicopter Aerodynamics", ch. 10. A thrust step overshoots, for the air below
    does not move yet; and a rotor that moves up loses lift until the inflow has adapted: a
    damping that fades with time. Slow, wide wakes (rig indoors) take some 0.1 s.
    """

    def __init__(self, strength):
        self.a = 0.48 * strength
        self.v = [1.0] * 4

    def step(self, s: Situation) -> Change:
        sign = SIDE[s.axis]
        p = 0.03 * float(s.rate[s.axis])
        spd, v = s.speed.tolist(), self.v
        factor = [1.0] * 4
        for i in range(4):
            u = max(spd[i], 0.05) / 0.5
            w = sign[i] * p
            f = 1.0 - self.a * ((v[i] + w) / math.sqrt(u) - 1.0)
            v[i] += s.dt / 0.22 * (u * f - v[i] * (v[i] + w))
            factor[i] = f
        c = Change()
        c.thrust = np.array(factor)
        return c


class BlowbackInTranslation:
    """Free flight: tilt makes sideways speed, and sideways speed tilts the rotor discs back and
    pushes the body.

    v' = g tan(th) - c1 sqrt(T) v - c2 v |v|;   M = -(k1 sqrt(T) v + k2 v |v|) (flapping and
    in-plane moment ~ advance ratio times tip speed, T = throttle/hover; body drag above the CG ~
    v |v|).
    Source: Pounds, Mahony, Corke, "Modelling and control of a large quadrotor robot", Control
    Eng. Practice 18 (2010); Hoffmann, Huang, Waslander, Tomlin, "Quadrotor helicopter flight
    dynamics and control", AIAA 2007-6461. Every quadrotor that runs off sideways rights itself;
    the torque follows the speed, thus the integral of the tilt.
    """

    def __init__(self, strength):
        self.k = strength
        self.v = 0.0

    def step(self, s: Situation) -> Change:
        a = s.axis
        root = math.sqrt(max(s.throttle, 0.05) / 0.5)
        v = self.v
        c = Change()
        c.torque[a] = -self.k * (1.3 * root * v + 0.35 * v * abs(v))
        self.v = v + s.dt * (G * math.tan(float(s.angle[a])) - 0.55 * root * v - 0.15 * v * abs(v))
        return c


class InflowAndStall:
    """The air through a propeller follows late (dynamic inflow); until it does, the blades bite
    more, up to their stall.

    In units where a steady propeller has Ω² = v² = thrust u, blade element theory and momentum
    theory give
        α = (1 − b·(v + V_i)/Ω)/(1 − b)  (angle of attack, 1 in steady state; V_i = side·R·rate,
        the arm's own up-speed),
        v' = (sqrt(lift) − v)·Ω/(τ·Ωh),
        lift = Ω²·(α − S·f),   f' = (max(0, α − αs) − f)/τs   (separation that builds up late; αs
        = 1.01),
    thrust factor lift/Ω². A change of speed overshoots and relaxes in a tenth of a second; the
    rate is damped, more at high speed of the blades; fast spin-ups stall.
    Source: Pitt & Peters, Vertica 5 (1981) 21; Leishman, Principles of Helicopter Aerodynamics
    (2006), ch. 9 and 10; Carpenter & Fridovich, NACA TN 3044 (1953: overshoot of thrust).
    Flat-pitched plastic blades work near stall. Strength: b and S.
    """

    def __init__(self, strength):
        self.b, self.stall = 0.29 * strength, 0.9 * strength
        self.arm = 0.02
        self.v = [math.sqrt(0.5)] * 4
        self.f = [0.0] * 4

    def step(self, s: Situation) -> Change:
        u, side = s.speed.tolist(), SIDE[s.axis]
        up, b, dt = self.arm * float(s.rate[s.axis]), self.b, s.dt
        v, f, out = self.v, self.f, [0.0] * 4
        for k in range(4):
            o = math.sqrt(max(u[k], 0.01))
            alpha = (1.0 - b * (v[k] + side[k] * up) / o) / (1.0 - b)
            over = alpha - 1.01
            f[k] += dt / 0.03 * ((max(0.0, over)) - f[k])
            c = alpha - self.stall * f[k]
            out[k] = c
            v[k] += dt / 0.11 * o / 0.7071 * (o * math.sqrt(max(c, 0.05)) - v[k])
        change = Change()
        change.thrust = np.array(out)
        return change


class FlappingInDrift:
    """Blade flapping from the sideways flight that a tilt brings about.

        dv/dt = g t sin θ - v/τ - c v |v|          (t = thrust / weight; rotor and frame drag)
        a1 = A (v/(ΩR)) / (1 + (μ/μ0)²)           (disc tilts away from the motion; saturates)
        M = -(t h + Kβ) a1,  and Kβ-weighted sideways flapping b1 into the other axis
    Ω goes as sqrt(t).
    Source: Pounds, Mahony & Corke, "Modelling and control of a large quadrotor robot", Control Eng.
    Practice 18 (2010); Hoffmann, Huang, Waslander & Tomlin, AIAA 2007-6461; Leishman, ch. 4; Mahony,
    Kumar & Corke, IEEE RAM 19 (2012).
    Felt: in free flight at 0.2 rad the aircraft soon drifts at metres per second, and the rotors push it back
    upright: the torque depends on a velocity that nobody measures.
    """

    def __init__(self, strength: float) -> None:
        self.k = 2.1 * strength
        self.v = [0.0, 0.0]

    def step(self, s: Situation) -> Change:
        m1, m2, m3, m4 = s.speed.tolist()
        t = max((m1 + m2 + m3 + m4) / (4.0 * HOVER), 0.1)
        root = math.sqrt(t)
        tilt = [0.0, 0.0]
        for i in range(2):
            v = self.v[i]
            v += s.dt * (G * t * math.sin(float(s.angle[i])) - v / 1.8 - 0.12 * v * abs(v))
            self.v[i] = v
            mu = v / root
            tilt[i] = mu / (1.0 + (mu / 4.0) ** 2)
        change = Change()
        lever = 0.6 * t + 0.4
        change.torque[0] = -self.k * (lever * tilt[0] - 0.15 * tilt[1])
        change.torque[1] = -self.k * (lever * tilt[1] + 0.15 * tilt[0])
        return change


class InflowInTwoStages:
    """Inflow of large, slow rotors that lags behind their thrust, in two stages, with the climb of each arm.

    Blade element and momentum theory in units of hover (w = Ω/Ω0 = sqrt(T)):
        T_i = (1 + κ) w² - κ w (n_i + c_i)               (thrust falls with inflow)
        c_i = ± ω L / v_h                                  (climb of the rotor by the rotation)
        n̄_i = -c_i/2 + sqrt(c_i²/4 + T_i)                 (momentum theory)
        n_i = (1 - f) n1 + f n2,   dn1/dt = (n̄_i - n1) n_i/τ1,   dn2/dt = (n̄_i - n2) n_i/τ2
    n1 is the apparent mass of the air at the disc, n2 the wake that must be convected some radii away;
    both are quicker with more flow. In steady hover T = w². A step of the rotor's speed overshoots in
    thrust, and a roll is damped at once, less when the inflow has followed.
    Source: Pitt & Peters, Vertica 5 (1981); Peters & He, J. AHS 36 (1991) (several states of different pace);
    Carpenter & Fridovich, NACA TN 3044 (1953); Leishman, ch. 10.
    Felt: on light aircraft with wide rotors the inflow lags as much as the motors do or more, and the damping by it
    exceeds that of the airframe.
    """

    FAR = 0.65

    def __init__(self, strength: float) -> None:
        self.k = 1.1 * strength
        self.near = [math.sqrt(HOVER)] * 4
        self.far = [math.sqrt(HOVER)] * 4

    def step(self, s: Situation) -> Change:
        r, p = 0.006 * float(s.rate[0]), 0.006 * float(s.rate[1])
        factor = [1.0, 1.0, 1.0, 1.0]
        roll, pitch, _ = SIDE
        for i, v in enumerate(s.speed.tolist()):
            w = math.sqrt(max(v, 0.01))
            climb = roll[i] * r + pitch[i] * p
            near, far = self.near[i], self.far[i]
            n = near + self.FAR * (far - near)
            f = (1.0 + self.k) - self.k * (n + climb) / w
            f = min(max(f, 0.0), 2.0)
            factor[i] = f
            settled = -0.5 * climb + math.sqrt(0.25 * climb * climb + f * w * w)
            pace = s.dt * n / math.sqrt(HOVER)
            self.near[i] = near + (settled - near) * pace / 0.025
            self.far[i] = far + (settled - far) * pace / 0.25
        return Change(thrust=np.array(factor))


class UnevenInflow:
    """The air through a propeller needs time to follow its thrust.

    After an increase of thrust the induced flow is still weak, the blades meet more incidence and give
    more than they will give at last; a rolling aircraft moves its propellers through the air, which
    takes thrust at once, in proportion to the propeller's speed, and part of it returns:
        q = drive - C sqrt(throttle/0.5) rate,  tau nu' = q - nu,  tau = tau0 sqrt(0.5/throttle)
        torque = D (q - nu) - C sqrt(throttle/0.5) rate
    Sources: Carpenter & Fridovich, NACA TN 2931 (1953); Pitt & Peters, Vertica 5 (1981) 21; Leishman,
    Principles of Helicopter Aerodynamics, ch. 10; Hoffmann et al., AIAA 2007-6461. Two axes alike.
    Felt here: overshoot of a third of the thrust's change for 0.1 s.
    """

    def __init__(self, strength):
        self.d, self.c = 0.32 * strength, 0.4 * strength
        self.nu = [0.0, 0.0]

    def step(self, s):
        root = math.sqrt(max(s.throttle, 0.05) / 0.5)
        change = Change()
        for i in (0, 1):
            loss = self.c * root * float(s.rate[i])
            lack = drive(s.speed, i) - loss - self.nu[i]
            self.nu[i] += s.dt * lack * root / 0.09
            change.torque[i] = self.d * lack - loss
        return change


class FlapBack:
    """Rotors that blow back in the wind of the aircraft's own sidewards flight.

    v' = g tan(angle) T/T0 - D v_a,   v_a = v + wind;
    B' = (kv sqrt(T/T0) v_a - B)/tb   (tilt of the discs with its lag),
    torque = -K B T/T0 - Kh |v_a| v_a   (tilted thrust above the centre of mass with the stiffness of the hubs; drag of
    the hull, whose centre of pressure is above it as well).
    Leishman, "Principles of Helicopter Aerodynamics", ch. 4; Hoffmann, Huang, Waslander, Tomlin, "Quadrotor helicopter
    flight dynamics and control", AIAA 2007-6461; Pounds, Mahony, Corke, Control Eng. Pract. 18 (2010). Each tilt makes
    the aircraft drift, the drift turns it back: a torque that comes seconds after the angle.
    """

    def __init__(self, strength):
        self.k, self.hull = 1.2 * strength, 0.13 * strength
        self.wind = (0.9, -0.7)
        self.v, self.b = [0.0, 0.0], [0.0, 0.0]

    def step(self, s: Situation) -> Change:
        change = Change()
        lift = 2.0 * float(s.speed.mean())
        root = math.sqrt(max(lift, 0.01))
        for a in (0, 1):
            angle = max(min(float(s.angle[a]), 1.0), -1.0)
            air = self.v[a] + self.wind[a]
            self.v[a] += s.dt * (G * math.tan(angle) * lift - 0.55 * root * self.v[a])
            self.b[a] += s.dt / 0.03 * (root * air - self.b[a])
            change.torque[a] = -self.k * self.b[a] * lift - self.hull * abs(air) * air
        return change


class ClimbInflow:
    """Inflow of climbing and descending rotors: blade element against momentum, with the mass of the air.

    T_i/T_i0 = 1 - X ((v_i + V_i)/v0_i - 1),  V_i = V + l (±p ±q),  v0_i = vh sqrt(T_i0/Th);
    0.425 R v_i' = vh² T_i/Th - v_i |v_i + V_i|   (Carpenter & Fridovich's apparent mass),
    V' = g (cos cos sum T / hover - 1) - D |V| V.
    Leishman, "Principles of Helicopter Aerodynamics", ch. 2, 3 and 10; Carpenter & Fridovich, NACA TN 3044 (1953). With
    more throttle the aircraft climbs until its rotors have lost again what they gained; meanwhile all thrusts,
    and with them the gain of roll and pitch, follow the vertical speed. A rotor that
    is moved up by the turning of the axis climbs as well, and a new thrust first meets the old inflow.
    """

    VH, MASS, ARM = 2.7, 0.055, 0.06

    def __init__(self, strength):
        self.x = 1.15 * strength
        self.v = [self.VH] * 4
        self.climb = 0.0

    def step(self, s: Situation) -> Change:
        change = Change()
        vh, h, climb = self.VH, s.dt, self.climb
        p, q = float(s.rate[0]) * self.ARM, float(s.rate[1]) * self.ARM
        factors, total = [], 0.0
        for i, thrust in enumerate(s.speed.tolist()):
            rel = max(2.0 * thrust, 0.04)
            v = self.v[i]
            through = v + climb + SIDE[0][i] * p + SIDE[1][i] * q
            f = 1.0 - self.x * (through / (vh * math.sqrt(rel)) - 1.0)
            f = max(min(f, 1.6), 0.4)
            self.v[i] = max(v + h / self.MASS * (vh * vh * rel * f - v * abs(through)), 0.2)
            factors.append(f)
            total += rel * f
        level = math.cos(s.angle[0]) * math.cos(s.angle[1])
        self.climb = climb + h * (G * (0.25 * total * level - 1.0) - 0.06 * abs(climb) * climb)
        change.thrust = np.array(factors)
        return change


class FlapBackAgain:
    """The propellers' discs tilt back and pitch the aircraft up against its airspeed (speed stability, M_u).

    The tilt makes the aircraft fly sideways; the advancing blades lift more, the discs flap back, thrust no longer passes
    through the centre of gravity and stiff hubs add their moment:
        v' = (throttle/0.5) g sin φ − d1 (throttle/0.5) v − d2 |v| v
        a' = (A v (throttle/0.5)^½ + B φ' − a)/τ              (disc's tilt, quasi-steady but for a short lag)
        torque = −M (throttle/0.5) a − N |v| v                 (hub moment and arm; wash on the frame, quadratic)
    Source: Prouty, Helicopter Performance, Stability and Control (ch. 7); Pounds, Mahony & Corke, Control Eng. Practice
    18 (2010); Hoffmann, Huang, Waslander & Tomlin, AIAA 2007-6461 (flapping on quadrotors).
    Felt: Hoffmann measured some 0.05 N m at 5 m/s; at 2 m/s that is 1.5 rad/s².
    """

    D1, D2 = 0.35, 0.06
    M, N, TILT_RATE, LAG = 1.0, 0.13, 0.15, 0.03

    def __init__(self, strength):
        self.strength = strength
        self.v = self.a = 0.0

    def step(self, s: Situation) -> Change:
        c = Change()
        i, dt = s.axis, s.dt
        load = s.throttle / 0.5
        v = self.v
        self.v = v + dt * (load * G * math.sin(float(s.angle[i])) - self.D1 * load * v - self.D2 * abs(v) * v)
        self.a += dt * (math.sqrt(max(load, 0.0)) * v + self.TILT_RATE * float(s.rate[i]) - self.a) / self.LAG
        c.torque[i] = -self.strength * (self.M * load * self.a + self.N * abs(v) * v)
        return c


class LeewardDiscShadow:
    """The lee rotors fly in the wake of the windward rotors.

    Moving edgewise with airspeed v, the windward rotors' wake is skewed by χ = atan(v/v_i) towards
    the lee rotors, which then work in downwash and lose thrust; slowly nothing reaches them:
        loss = κ·x²/(1 + x²)·(thrust of the windward pair/0.5),  x = v/v_i,  v_i ∝ √thrust
    after the way of the wake from rotor to rotor, some 0.15 s. The airspeed comes from tilting:
        dv/dt = g·sin(angle) - (v - wind)/τ
    Source: Leishman, Principles of Helicopter Aerodynamics, §3.5 (skewed wake) and tandem-rotor
    interference; Luo, Zhu & Yan, Novel quadrotor forward-flight model based on wake interference,
    AIAA J. 53 (2015). Felt here: the axis tilts for up to 0.7 s by 0.2 rad and so gets to some m/s
    against an induced speed of 4; one per cent of lee thrust is a torque of 1 rad/s². Opposes the
    tilt, but with the memory of the speed.
    """

    def __init__(self, strength: float) -> None:
        self.share = 0.11 * strength
        self.v, self.plus, self.minus = 0.0, 0.0, 0.0

    def step(self, s: Situation) -> Change:
        wind = 0.9 * math.sin(0.9 * s.t) + 0.6 * math.sin(2.3 * s.t + 1.0)
        self.v += s.dt * (G * math.sin(float(s.angle[s.axis])) - (self.v - wind) / 1.6)
        air = self.v - wind
        n = [float(x) for x in s.speed]
        signs = SIDE[s.axis]
        up = down = 0.0
        for i in range(4):
            if signs[i] > 0.0:
                up += 0.5 * n[i]
            else:
                down += 0.5 * n[i]
        x = air / 4.0
        windward = max(down if air > 0.0 else up, 0.05)
        x2 = x * x / (2.0 * windward)
        loss = self.share * x2 / (1.0 + x2) * 2.0 * windward
        blend = s.dt / 0.15
        self.plus += blend * ((loss if air > 0.0 else 0.0) - self.plus)
        self.minus += blend * ((loss if air < 0.0 else 0.0) - self.minus)
        return Change(thrust=np.array(
            [1.0 - (self.plus if sign > 0.0 else self.minus) for sign in signs]))


class WakeFillingDelay:
    """Large, slow propellers: their wake must be accelerated before it weakens the blades' incidence.

    Momentum theory with the apparent mass of air (Carpenter & Fridovich), in units of hover:
    τ v' = T - v |v|,   blade element: T = n + κ √n (√n - v - u),
    n the quasi-steady thrust (speed / 0.5), v the induced velocity, u = ± arm rate / v_hover the
    hub's own motion. Thus a step of speed overshoots in thrust by some κ/2 and settles in τ/2.
    Source: Carpenter & Fridovich, NACA TN 3044; Leishman, Principles of Helicopter Aerodynamics, ch. 10.
    Felt here: each differential command gives an extra push at first, faster settling at high thrust,
    and the rolling rotors damp.
    """

    KAPPA, TAU, HUB = 0.75, 0.24, 0.05
    ROLL, PITCH = (1.0, -1.0, 1.0, -1.0), (1.0, -1.0, -1.0, 1.0)
    """On which side of each axis its writer saw the motors."""

    def __init__(self, strength):
        self.kappa = strength * self.KAPPA
        self.v = [1.0, 1.0, 1.0, 1.0]

    def step(self, s: Situation) -> Change:
        p, q, _ = s.rate.tolist()
        h = s.dt / self.TAU
        k, v, factor = self.kappa, self.v, []
        for j, speed in enumerate(s.speed.tolist()):
            n = 2.0 * speed if speed > 0.05 else 0.1
            root = math.sqrt(n)
            u = self.HUB * (self.ROLL[j] * p + self.PITCH[j] * q)
            thrust = n + k * root * (root - v[j] - u)
            v[j] += h * (thrust - v[j] * abs(v[j]))
            factor.append(thrust / n)
        out = Change()
        out.thrust = np.array(factor)
        return out


class DynamicInflowAgain:
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
            sign, v = SIDE[i][m], self.v[m]
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


class TranslationMoment:
    """Propellers in sideways flight: the blades' flapping and the front propellers' wake pitch
    it back.

    A tilt accelerates the aircraft sideways; the advancing blades lift more and the discs tilt
    back,
    while the rear propellers work in the wake of the front ones; both need time to build up
    inflow:
        v' = g tan(th) T/T0 - d1 v - d2 v|v|
        wanted = -(k1 W/W0 v + k2 v|v| / (1 + (v/vh)^2)),   tau m' = wanted - m
    Source: Hoffmann, Huang, Waslander & Tomlin, "Quadrotor Helicopter Flight Dynamics and Control"
    (AIAA 2007); Leishman, "Principles of Helicopter Aerodynamics", ch. 4 and 10. Felt in every
    free
    flight of a light quadrotor: at 1 m/s it takes about 1 rad/s² to hold the tilt.
    """

    def __init__(self, strength: float) -> None:
        self.k1, self.k2 = 0.75 * strength, 0.35 * strength
        self.v = self.m = 0.0

    def step(self, s: Situation) -> Change:
        c = Change()
        i, dt = s.axis, s.dt
        lift = 2.0 * s.throttle
        v = self.v
        self.v = v + dt * (G * math.tan(max(-0.9, min(0.9, float(s.angle[i])))) * lift
                           - 0.35 * v - 0.12 * v * abs(v))
        wanted = -(self.k1 * math.sqrt(max(0.0, lift)) * v
                   + self.k2 * v * abs(v) / (1.0 + v * v / 9.0))
        self.m += dt / 0.08 * (wanted - self.m)
        c.torque[i] = self.m
        return c


class ChippedPropellerAgain:
    """A piece of one blade of motor 0 is missing: less lift, and it shakes.

    A mechanic says: chipped prop, nicked blade.
    Source: blade element theory (Leishman, Principles of Helicopter Aerodynamics, ch. 3: the lift
    of a blade station goes as c r² dr) for the lift that is lost; rotating unbalance m e W² (Den
    Hartog, Mechanical Vibrations, ch. 2) at the height of the motor over the centre of mass.
    Felt: it leans to one corner, and the frame buzzes in the hand.
    """

    def __init__(self, strength: float) -> None:
        radius, inner = 0.12, 0.12 - 0.0047 * strength
        width = 0.45  # of the chord, one of two blades
        self.lost = 0.5 * width * (1.0 - (inner / radius) ** 3)
        self.unbalance = 2.0e-5 * strength  # kg m: 0.2 g at 0.1 m
        self.height = 0.04  # m
        self.phase = 0.0

    def step(self, s: Situation) -> Change:
        w = HOVER_SPEED * math.sqrt(max(float(s.speed[0]), 0.0) / HOVER)
        middle = self.phase + 0.5 * w * s.dt
        self.phase = (self.phase + w * s.dt) % (2.0 * math.pi)
        shake = self.height * self.unbalance * w * w / INERTIA
        factors = np.ones(4)
        factors[0] = 1.0 - self.lost
        return Change(
            torque=np.array([shake * math.sin(middle), shake * math.cos(middle), 0.0]),
            thrust=factors,
        )


class SoftBladesFlap:
    """Whippy propellers: in motion the advancing blade rises and the disc leans back.

    A mechanic says: soft, floppy props; it "rears up" against its own speed.
    Source: blade flapping, Hoffmann et al., AIAA 2007-6461, and Pounds, Mahony & Corke, Control
    Eng. Practice 18 (2010): a1 = c v; moment (T h + 4 k_beta) a1 against the motion; the lag of
    the disc behind the frame, 16/(gamma W) of the rate. The speed follows v' = g tan a - D v.
    Felt: it leans away from where it flies and does not hold its tilt.
    """

    def __init__(self, strength: float) -> None:
        self.flap = 0.019 * strength  # rad per m/s
        self.moment = MASS * G * 0.035 + 4.0 * 0.16  # N m/rad: height of the discs, stiff roots
        self.behind = 16.0 / (2.5 * HOVER_SPEED) * strength  # s
        self.drag = 0.35  # 1/s
        self.v = np.zeros(2)  # m/s, where a positive angle drives it

    def step(self, s: Situation) -> Change:
        self.v = self.v + s.dt * (G * np.tan(np.clip(s.angle[:2], -1.0, 1.0)) - self.drag * self.v)
        leaned = self.flap * self.v + self.behind * s.rate[:2]
        return Change(torque=np.r_[-self.moment * leaned / INERTIA, 0.0])


class IcedPropellers:
    """Freezing fog: rime grows on the blades, spoils their lift, and is thrown off in pieces.

    A mechanic says: ice on the props.

    Accretion is proportional to the time and to the speed of the blade; the thrust falls in
    proportion to the thickness (Liu et al. 2019, icing of UAS propellers; Bragg, Broeren &
    Blumenthal 2005), the moment of inertia rises; shed when centrifugal force m·w²·r exceeds the
    adhesion of ice. Felt: more and more throttle for hover, it gets lazy and pulls to a side,
    then a jolt as a piece flies away.
    """

    LOSS_PER_S = np.array([0.0068, 0.0060, 0.0064, 0.0055])
    """At strength 1 and in hover speed."""
    FIRST = np.array([0.08, 0.06, 0.07, 0.06])
    SHED = 0.33
    KEPT = 0.5

    def __init__(self, strength):
        self.strength = strength
        self.ice = self.FIRST.copy()

    def step(self, s: Situation) -> Change:
        spin = np.sqrt(np.maximum(s.speed, 0.0) / HOVER)
        self.ice = self.ice + s.dt * self.LOSS_PER_S * spin
        gone = self.ice * spin**2 > self.SHED
        self.ice = np.where(gone, self.KEPT * self.ice, self.ice)
        lost = self.strength * self.ice
        return Change(thrust=1.0 - np.minimum(lost, 0.7), lag=1.0 + 0.5 * lost)


PLANTS = (
    Plant('dynamic_inflow', DynamicInflow, 'bearings', 6, rig=False),
    Plant('flap_back_by_translation', FlapBackByTranslation, 'bearings', 7, rig=False),
    Plant('rubber_hub', RubberHub, 'rigs', 9, rig=True, may_be=('resonance', 'thrust_curve')),
    Plant('creeping_blades', CreepingBlades, 'rigs', 10, rig=True, may_be=('thrust_curve',)),
    Plant('chipped_propeller', ChippedPropeller, 'rigs', 11, rig=False, may_be=('thrust_curve',)),
    Plant('inflow_overshoot', InflowOvershoot, 'hinges', 7, rig=True),
    Plant('blowback_in_translation', BlowbackInTranslation, 'hinges', 8, rig=False),
    Plant('inflow_and_stall', InflowAndStall, 'arms', 9, rig=True, may_be=('thrust_curve',)),
    Plant('flapping_in_drift', FlappingInDrift, 'joints', 6, rig=False),
    Plant('inflow_in_two_stages', InflowInTwoStages, 'joints', 7, rig=False),
    Plant('uneven_inflow', UnevenInflow, 'hoses', 6, rig=False),
    Plant('flap_back', FlapBack, 'gears', 6, rig=False),
    Plant('climb_inflow', ClimbInflow, 'gears', 8, rig=False),
    Plant('flap_back_again', FlapBackAgain, 'slings', 7, rig=False),
    Plant('leeward_disc_shadow', LeewardDiscShadow, 'greases', 7, rig=False,
          may_be=('periodic_disturbance',)),
    Plant('wake_filling_delay', WakeFillingDelay, 'chains', 7, rig=False,
          may_be=('gyroscopic_coupling',)),
    Plant('dynamic_inflow_again', DynamicInflowAgain, 'governors', 6, rig=False),
    Plant('flapping_in_wind', FlappingInWind, 'governors', 7, rig=False,
          may_be=('periodic_disturbance',)),
    Plant('translation_moment', TranslationMoment, 'umbilicals', 8, rig=False),
    Plant('chipped_propeller_again', ChippedPropellerAgain, 'workshop', 3, rig=True,
          may_be=('cross_axis_input', 'periodic_disturbance')),
    Plant('soft_blade_flapping', SoftBladesFlap, 'workshop', 8, rig=False,
          may_be=('pendulum_stiffness',)),
    Plant('iced_propellers', IcedPropellers, 'field', 5, rig=False,
          may_be=('cross_axis_input', 'step_event')),
)
