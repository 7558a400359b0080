"""Masses that hang, slide, slosh or spin: payloads, tanks, batteries."""

from __future__ import annotations

import math

from .simulator import INERTIA, MASS, Change, G, Plant, Situation


class SloshingTank:
    """Half-full tank on the rig: first sloshing mode as a pendulum.

    l φ'' = -g sin φ - d α cos(φ-θ) - 2 l ω (ζ0 + ζ1 |q'|) q', q = φ - θ (Keulegan's baffle
    damping); torque = κ d [(g cos φ + l φ'²) sin q]. Dodge, "The new dynamic behavior of liquids
    in moving containers" (SwRI 2000); Ibrahim 2005.
    Felt because 0.3 kg of liquid 5 cm off the axis is some 10 rad/s² per rad of the surface.
    """

    def __init__(self, strength):
        self.k, self.p, self.v = strength, 0.0, 0.0

    def step(self, s: Situation) -> Change:
        c, a = Change(), s.axis
        l, d = 0.085, 0.05
        th, w, al = float(s.angle[a]), float(s.rate[a]), float(s.acceleration[a])
        q, r = self.p - th, self.v - w
        acc = (-G * math.sin(self.p) - d * al * math.cos(q)) / l \
            - 2.0 * math.sqrt(G / l) * (0.03 + 0.05 * abs(r)) * r
        self.v += s.dt * acc
        self.p += s.dt * self.v
        c.torque[a] = self.k * 0.9 * (G * math.cos(self.p) + l * self.v * self.v) * math.sin(q)
        return c


class CommunicatingTanks:
    """Two tanks at the ends of the arm joined by a hose: liquid runs to the lower one.

    Inertance, laminar and turbulent loss (Bernoulli with friction): Q' = -a (sin Δ) - λ Q - b |Q|
    Q, Δ = u - θ; u' = Q, full tanks: u -> u0 tanh(u/u0); torque = +k u0 tanh(u/u0) cos θ. White,
    Fluid Mechanics, ch. 6; Moaleji & Greig, "anti-roll tanks", Ocean Eng. 2007.
    Felt because 100 g that run over by 20 cm turn the rig by far more than its damping.
    """

    def __init__(self, strength):
        self.k, self.u, self.flow = strength, 0.0, 0.0

    def step(self, s: Situation) -> Change:
        c, a = Change(), s.axis
        th, f = float(s.angle[a]), self.flow
        self.flow = f + s.dt * (-30.0 * math.sin(self.u - th) - 4.0 * f - 28.0 * abs(f) * f)
        self.u += s.dt * self.flow
        c.torque[a] = self.k * 7.0 * 0.35 * math.tanh(self.u / 0.35) * math.cos(th)
        return c


class SpreaderDisc:
    """Spinning spreader disc under the aircraft: gyroscopic moment and imbalance.

    torque_roll = -H q, torque_pitch = +H p, H = H0 Ω/Ω0; imbalance (U Ω²)(sin, cos) of the phase;
    Ω follows the battery and falls with the load of the feed, Ω' = (Ω* - Ω)/0.8 s. Goldstein,
    Classical Mechanics, ch. 5; Genta, Dynamics of Rotating Systems. 0.3 kg, r = 0.1 m, 9 turns/s:
    H / J is some 3 per s.
    """

    def __init__(self, strength):
        self.k, self.w, self.phase = strength, 1.0, 0.0

    def step(self, s: Situation) -> Change:
        c, a = Change(), s.axis
        goal = s.battery_v / 12.0 - 0.06 * (1.0 + math.sin(2.3 * s.t))
        self.w += s.dt / 0.8 * (goal - self.w)
        self.phase = (self.phase + s.dt * 42.0 * self.w) % (2.0 * math.pi)
        h, u = self.k * 3.2 * self.w, self.k * 0.7 * self.w * self.w
        c.torque[0] = -h * float(s.rate[1]) + u * math.sin(self.phase)
        c.torque[1] = h * float(s.rate[0]) + u * math.cos(self.phase)
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


class SlungLoad:
    """A load on a rope whose hook sits below the centre of mass, in free flight.

    In the plane of the excited axis, v the aircraft's speed along, γ the rope's angle to the
    vertical, q = thrust/weight:
        v' = q·g·(1 + ρ)·sin θ + ρ·T·sin γ − v/τ,
        L·γ'' = −q·g·cos θ·sin γ − (v' − h·θ'')·cos γ − (b/m)·|w|·w,   w = v + L·γ',
        T = q·g·cos θ·cos γ + L·γ'² − v'·sin γ   (per mass of the load, not below 0),
        torque = −(m·h/J)·T·sin(θ + γ).
    In steady acceleration the rope lies along the thrust and pulls through the centre; in every
    manoeuvre it lags, pulls on the lever h and swings with sqrt(g/L), with quadratic drag and
    with a tension that goes with throttle and swing.
    Source: Bisgaard, Modeling, Estimation and Control of Helicopter Slung Load Systems (Aalborg
    2008); Cicolani & Kanning, NASA TP-3280 (1992). A fifth of the mass on a hook 6 cm below the
    centre is an ordinary delivery. Strength: m·h/J.
    """

    def __init__(self, strength):
        self.c = 0.75 * strength
        self.length, self.h, self.rho, self.tau, self.drag = 0.6, 0.06, 0.2, 2.5, 0.12
        self.v = self.swing = self.slope = 0.0

    def step(self, s: Situation) -> Change:
        th, gamma = float(s.angle[s.axis]), self.swing
        speed = s.speed.tolist()
        w = G * 0.5 * sum(speed)
        sg, cg = math.sin(gamma), math.cos(gamma)
        g = w * math.cos(th)
        a0 = w * (1.0 + self.rho) * math.sin(th) - self.v / self.tau
        hold = g * cg + self.length * self.slope ** 2
        # the tension pulls the aircraft and depends itself on the aircraft's acceleration
        tension = max(0.0, (hold - a0 * sg) / (1.0 + self.rho * sg * sg))
        a = a0 + self.rho * tension * sg
        wind = self.v + self.length * self.slope
        self.slope += s.dt / self.length * (-g * sg - (a - self.h * float(s.acceleration[s.axis])) * cg
                                            - self.drag * abs(wind) * wind)
        self.swing = gamma + s.dt * self.slope
        self.v += s.dt * a
        change = Change()
        change.torque[s.axis] = -self.c * tension * math.sin(th + self.swing)
        return change


class BulgingTank:
    """A half filled spray tank on the rig: the first sloshing mode, with its change of frequency
    and damping by amplitude.

    Rectangular tank of length l, depth d: ω² = g·(π/l)·tanh(π·d/l); the sloshing mass moves by x
    in the tank's frame, z below the pivot:  x'' = −2·ζ·ω·(1 + |x|/x1)·x' − ω²·x·(1 + (x/x3)²) +
    g·sin θ + z·θ''
        torque = (m/J)·(g·x·cos θ − z·(ω²·x·(1 + (x/x3)²) + 2·ζ·ω·(1 + |x|/x1)·x')).
    The liquid runs to the low side and pushes on (free-surface effect), and the wave comes back
    late.
    Source: Abramson (ed.), The Dynamic Behavior of Liquids in Moving Containers, NASA SP-106
    (1966), ch. 6; Ibrahim, Liquid Sloshing Dynamics (2005), ch. 5 (mass-spring model), ch. 4
    (nonlinear). A 20 cm tank sloshes at some 1.7 Hz, the frequency of the attitude changes.
    Strength: sloshing mass.
    """

    def __init__(self, strength):
        length, depth = 0.20, 0.07
        self.k = G * math.pi / length * math.tanh(math.pi * depth / length)
        self.c = 2.0 * 0.07 * math.sqrt(self.k)
        self.m = 15.0 * strength
        self.z, self.x1, self.x3 = 0.03, 0.03, 0.06
        self.x = self.v = 0.0
        self.last = 0.0

    def step(self, s: Situation) -> Change:
        rate, th, x = float(s.rate[s.axis]), float(s.angle[s.axis]), self.x
        a = (rate - self.last) / s.dt
        self.last = rate
        f = self.k * x * (1.0 + (x / self.x3) ** 2) + self.c * (1.0 + abs(x) / self.x1) * self.v
        self.v += s.dt * (G * math.sin(th) + self.z * a - f)
        self.x = x + s.dt * self.v
        change = Change()
        change.torque[s.axis] = self.m * (G * self.x * math.cos(th) - self.z * f)
        return change


class SlidingBattery:
    """A battery slides in its tray under a slack strap, with dry friction between two foam stops
    (it sticks and slips).

        y'' = g·sin θ − (µ·g·cos θ)·F(v) − ks·y − stop,   F(v) = (1 +
        0.35·exp(−(v/vs)²))·tanh(v/v0)   (Stribeck),
        stop = kp·δ^1.5·(1 + c·δ')  (Hunt–Crossley) on the way δ beyond the play,
        torque = (m/J)·(g·y·cos θ − z·(friction + strap + stop)).
    The friction falls as the frame shakes more with throttle (µ = µ0·(1 − 0.8·(throttle − 0.5))).
    The battery stays until the tilt overcomes friction, runs to the stop, and waits there until
    the tilt is reversed: the centre of mass has backlash.
    Source: Armstrong-Hélouvry, Dupont & Canudas de Wit, Automatica 30 (1994) 1083 (friction);
    Hunt & Crossley, J. Appl. Mech. 42 (1975) 440 (stops). A 200 g battery with 1 cm of play is
    found on half of all home-built copters. Strength: m/J.
    """

    def __init__(self, strength):
        self.m = 11.5 * strength
        self.mu, self.v0, self.vs = 0.075, 0.004, 0.02
        self.play, self.kp, self.loss, self.ks, self.z = 0.010, 2.0e5, 4.0, 12.0, 0.02
        self.y = self.v = 0.0

    def step(self, s: Situation) -> Change:
        th, y, v = float(s.angle[s.axis]), self.y, self.v
        ct = math.cos(th)
        mu = self.mu * (1.0 - 0.8 * (s.throttle - 0.5))
        f = mu * G * ct * (1.0 + 0.35 * math.exp(-(v / self.vs) ** 2)) * math.tanh(v / self.v0) + self.ks * y
        over = abs(y) - self.play
        if over > 0.0:
            side = 1.0 if y > 0.0 else -1.0
            f += side * max(0.0, self.kp * over * math.sqrt(over) * (1.0 + self.loss * side * v))
        self.v = v + s.dt * (G * math.sin(th) - f)
        self.y = y + s.dt * self.v
        change = Change()
        change.torque[s.axis] = self.m * (G * self.y * ct - self.z * f)
        return change


class LooseBattery:
    """The strap has come loose: the battery slides sideways on its tray until it meets a foam stop.

    On the rig the tray tilts; beyond the friction's angle the battery slides down and shifts the centre
    of gravity to the lower side, and stays there until the tilt has turned over:
        x'' = g sin(theta) - h theta'' - mu g cos(theta) sgn(x'),   stuck while |drive| < mu_s g cos(theta)
        |x| <= x_max with restitution 0.25;    torque = [m g x cos(theta) + m h x''] / J
    (the second term is the reaction of friction and stops, the tray lying h beside the pivot).
    Sources: Beer & Johnston, Vector Mechanics (dry friction, impact); Armstrong-Helouvry et al.,
    Automatica 30 (1994) 1083. Felt here: 0.2 kg moved by 7 mm on 0.012 kg m² is 1.1 rad/s².
    One of the switching effects. Strength multiplies the battery's mass.
    """

    def __init__(self, strength):
        self.m = 0.2 / INERTIA * strength
        self.x, self.v = 0.0, 0.0

    def step(self, s):
        h, limit, static, kinetic = 0.01, 0.0075, 0.055, 0.04
        angle = float(s.angle[s.axis])
        normal = G * math.cos(angle)
        push = G * math.sin(angle) - h * float(s.acceleration[s.axis])
        x, v = self.x, self.v
        if v == 0.0 and (abs(push) <= static * normal or (abs(x) >= limit and push * x > 0.0)):
            new = 0.0
        else:
            way = v or push
            new = v + s.dt * (push - math.copysign(kinetic * normal, way))
            if v and new * v < 0.0:
                new = 0.0
        x += s.dt * new
        if abs(x) > limit:
            x = math.copysign(limit, x)
            new = -0.25 * new
            if abs(new) < 0.01:
                new = 0.0
        change = Change()
        change.torque[s.axis] = self.m * (normal * x + h * (new - v) / s.dt)
        self.x, self.v = x, new
        return change


class SwingingLoad:
    """A parcel on a line of 0.6 m, hooked 2 cm below the centre of gravity, in free flight.

    The aircraft's tilt φ accelerates the hook sideways, the load swings (θ from the vertical), and the line's
    tension pulls at the hook's arm. With μ = m_load/m, f = (1+μ) g throttle/0.5 the thrust per mass of aircraft,
    τ = tension/m_load (taken from the radial equation, so it knows of the swing and of throttle):
        τ (1+μ) = f cos(φ+θ) + l θ'² + (d v + h φ'') sin θ
        v'      = f sin φ + μ τ sin θ − d v
        a_z     = f cos φ − g − μ τ cos θ
        l θ''   = −(g + a_z) sin θ − (v' − h φ'') cos θ − k_d |v_l| v_l,   v_l = v + l θ' cos θ
        torque  = −h m_load τ sin(θ + φ) / J
    Second terms: centrifugal tension, quadratic air drag of the load, the load's pull on the aircraft.
    Source: Cicolani & Kanning, NASA TP-3280 (1992), slung load equations; Padfield, Helicopter Flight Dynamics;
    Sreenath, Lee & Kumar, CDC 2013 (quadrotor with a cable-suspended load).
    Felt because the hook is never exactly at the centre of gravity: 3 N times 2 cm is a good tenth of
    what the drive does, and it swings at 0.7 Hz, in the midst of the manoeuvres.
    """

    L, HOOK, DRAG, AIR = 0.6, 0.022, 0.35, 0.06

    def __init__(self, strength):
        self.mu = 0.25 * strength
        self.theta = self.slope = self.v = 0.0

    def step(self, s: Situation) -> Change:
        c = Change()
        i, dt = s.axis, s.dt
        phi, alpha = float(s.angle[i]), float(s.acceleration[i])
        th, w, v, mu, l, h = self.theta, self.slope, self.v, self.mu, self.L, self.HOOK
        st, ct = math.sin(th), math.cos(th)
        f = (1.0 + mu) * G * s.throttle / 0.5
        tau = (f * math.cos(phi + th) + l * w * w + (self.DRAG * v + h * alpha) * st) / (1.0 + mu)
        tau = max(tau, 0.0)
        ax = f * math.sin(phi) + mu * tau * st - self.DRAG * v
        up = f * math.cos(phi) - mu * tau * ct
        vl = v + l * w * ct
        self.slope = w + dt * (-up * st - (ax - h * alpha) * ct - self.AIR * abs(vl) * vl) / l
        self.theta = th + dt * self.slope
        self.v = v + dt * ax
        c.torque[i] = -h * mu * MASS * tau * math.sin(th + phi) / INERTIA
        return c


class SlidingBatteryAgain:
    """A battery whose strap is loose: on the rig (which holds the aircraft, so that gravity acts along the tray
    when it tilts) it creeps to the low side, sticks there, and slides back.

        y'' = g sin φ − h φ'' − (k/m) y (1 + (y/y_s)⁴) − (c/m) y' − μ(y') g cos φ sgn(y')
        torque = m (g y cos φ − 2 y y' φ') / J
    h: height of the tray over the pivot; μ falls from its static to its sliding value (Stribeck); the strap is a
    spring that stiffens sharply at its end y_s. Second terms: Stribeck, stop, Coriolis moment of the moving mass.
    Source: Armstrong-Hélouvry, Dupont & Canudas de Wit, Automatica 30 (1994) on friction; Meriam & Kraige, Dynamics.
    Felt: 0.25 kg that is 6 mm off centre is 1.2 rad/s². It sticks and slips: counted among the switching effects.
    """

    OVER, SPRING, DAMP = 0.02, 110.0, 9.0
    """m, 1/s², 1/s"""
    STOP, MU_S, MU_C, V_S, V_0 = 0.009, 0.09, 0.06, 0.01, 0.0015
    """m, -, -, m/s, m/s"""

    def __init__(self, strength):
        self.mass = 0.24 * strength
        self.y = self.v = 0.0

    def step(self, s: Situation) -> Change:
        c = Change()
        i, dt = s.axis, s.dt
        phi, p, alpha = float(s.angle[i]), float(s.rate[i]), float(s.acceleration[i])
        y, v = self.y, self.v
        cosine = math.cos(phi)
        r = (y / self.STOP) ** 2
        a = G * math.sin(phi) - self.OVER * alpha - self.SPRING * y * (1.0 + r * r)
        mu = self.MU_C + (self.MU_S - self.MU_C) * math.exp(-((v / self.V_S) ** 2))
        # friction as a damper that saturates, taken implicitly: it stays stable at standstill
        friction = mu * G * cosine / math.sqrt(v * v + self.V_0 * self.V_0)
        self.v = (v + dt * a) / (1.0 + dt * (self.DAMP + friction))
        self.y = y + dt * self.v
        c.torque[i] = self.mass * (G * self.y * cosine - 2.0 * self.y * self.v * p) / INERTIA
        return c


class BifilarCargoTray:
    """A long tray of cargo hangs below the frame by two elastic lines close to each other.

    The frame's tilt against the tray's, y = angle - φ, stretches one line and slackens the other:
    φ'' = (g b / 2 r²) n [f(1 + y/y0) - f(1 - y/y0)] + 2 ζ ω y',  f(x) = (x + √(x² + ε²)) / 2,
    where r is the tray's radius of gyration, b half the distance of the lines, y0 the tilt that takes
    the whole static stretch from one of them, and n = thrust / weight, as the tray is accelerated
    upwards with the aircraft; a line does not push (f). Torque = -(J_tray/J) φ''.
    Source: bifilar suspension in Den Hartog, Mechanical Vibrations; two-cable sling loads: Cicolani &
    Kanning, NASA TP-2768.
    Felt here: an inertia that follows elastically with a resonance of 3 Hz and less when a line is slack.
    """

    RATIO, B, GYRATION, Y0, EPS, ZETA = 0.18, 0.055, 0.15, 0.065, 0.25, 0.07

    def __init__(self, strength):
        self.ratio = strength * self.RATIO
        self.k = G * self.B / (2.0 * self.GYRATION**2)
        self.c = 2.0 * self.ZETA * math.sqrt(2.0 * self.k / self.Y0)
        self.phi = self.phid = 0.0

    def step(self, s: Situation) -> Change:
        i = s.axis
        y = float(s.angle[i]) - self.phi
        x = y / self.Y0
        e = self.EPS * self.EPS
        up, down = 1.0 + x, 1.0 - x
        f = 0.5 * (up - down + math.sqrt(up * up + e) - math.sqrt(down * down + e))
        v = s.speed
        n = 0.5 * float(v[0] + v[1] + v[2] + v[3])
        acc = self.k * n * f + self.c * (float(s.rate[i]) - self.phid)
        self.phid += s.dt * acc
        self.phi += s.dt * self.phid
        out = Change()
        out.torque[i] = -self.ratio * acc
        return out


class SlungLoadAgain:
    """A small load on a sling whose hook sits below the centre of gravity, in free flight.

    The load is a pendulum driven by the hook's horizontal acceleration; the aircraft's own
    horizontal
    acceleration follows its tilt, less drag:
        v' = g tan(th) - d v,   a_h = v' - h th''
        L ph'' = a_h cos(ph) - g sin(ph) - c L ph'
        T = m (g cos(ph) + L ph'^2 + a_h sin(ph)),   torque = -h T sin(th - ph) / I
    (ph: angle of the sling from the vertical; T: tension, with the centrifugal term.)
    Source: Bisgaard, "Modeling, Estimation and Control of Helicopter Slung Load System" (2008),
    ch. 3;
    Stevens & Lewis for the carrier. Felt because 0.1 kg at 8 cm below the centre of gravity pulls
    with several rad/s² per rad, and the sling lags behind a tilt by its swing of about half a
    second.
    """

    def __init__(self, strength: float) -> None:
        self.mass, self.hook, self.length = 0.10 * strength, 0.09, 0.55
        self.swing = self.swing_rate = self.v = 0.0

    def step(self, s: Situation) -> Change:
        c = Change()
        i, dt = s.axis, s.dt
        th = float(s.angle[i])
        vdot = G * math.tan(max(-0.9, min(0.9, th))) - 0.5 * self.v
        self.v += dt * vdot
        ah = vdot - self.hook * float(s.acceleration[i])
        sp, cp = math.sin(self.swing), math.cos(self.swing)
        self.swing_rate += dt * ((ah * cp - G * sp) / self.length - 0.5 * self.swing_rate)
        self.swing += dt * self.swing_rate
        tension = self.mass * max(
            0.0, G * cp + self.length * self.swing_rate * self.swing_rate + ah * sp)
        c.torque[i] = -self.hook * tension * math.sin(th - self.swing) / INERTIA
        return c


class LooseBatteryAgain:
    """A battery on the top plate, held by a worn strap, slides sideways on a rig that tilts it.

    Strap spring, dry friction under the strap, and the rails at the ends of its play:
        x'' = g sin(th) - h th'' - w^2 x - c x' - mu g tanh(x'/vs) - stops(x)
        torque = m (g x cos(th) - h x'') / I
    Source: Lagrange's equations of a mass sliding on a rocking plate (Goldstein; Meirovitch);
    regularised Coulomb friction after Armstrong-Hélouvry. Felt because 0.25 kg displaced by 5 mm
    are 1 rad/s², and it arrives late and with a jerk.
    """

    def __init__(self, strength: float) -> None:
        self.mass, self.h, self.w2, self.gap = 0.25 * strength, 0.04, 190.0, 0.0075
        self.x = self.v = 0.0

    def step(self, s: Situation) -> Change:
        c = Change()
        i, dt = s.axis, s.dt
        th = float(s.angle[i])
        x, v = self.x, self.v
        a = (G * math.sin(th) - self.h * float(s.acceleration[i]) - self.w2 * x - 3.0 * v
             - 0.06 * G * math.tanh(v / 0.004))
        if x > self.gap:
            a -= max(0.0, 12000.0 * (x - self.gap) + 60.0 * v)
        elif x < -self.gap:
            a -= min(0.0, 12000.0 * (x + self.gap) + 60.0 * v)
        self.v = v + dt * a
        self.x = x + dt * self.v
        c.torque[i] = self.mass * (G * x * math.cos(th) - self.h * a) / INERTIA
        return c


class BatterySlidesUnderStrap:
    """The strap has lost its grip: the pack creeps downhill to its stop and back.

    A mechanic says: loose battery, worn-out strap.
    Source: block on an incline with dry friction between two plastic stops (Meriam & Kraige,
    Dynamics, ch. 3): x'' = g sin a + x w² - mu g cos a sign(x'); its weight out of the middle
    turns the frame by m g x cos a / I, and its push or knock at the height h by -m h x'' / I.
    Felt: a soft knock after each tilt, and the frame wants to stay on the side it fell to.
    """

    def __init__(self, strength: float) -> None:
        self.mass = 0.19  # kg
        self.height = 0.012  # m above the axis
        self.play = 0.010 * strength  # m to each side
        self.static, self.kinetic = 0.055, 0.035  # vibration has shaken most of the friction away
        self.x, self.v = 0.0, 0.0

    def step(self, s: Situation) -> Change:
        a, w = float(s.angle[s.axis]), float(s.rate[s.axis])
        pull = G * math.sin(a) + self.x * w * w
        normal = G * math.cos(a)
        before = self.v
        if self.v == 0.0:
            against = (self.x >= self.play and pull > 0.0) or (self.x <= -self.play and pull < 0.0)
            if not against and abs(pull) > self.static * normal:
                self.v = s.dt * (pull - math.copysign(self.kinetic * normal, pull))
        else:
            self.v += s.dt * (pull - math.copysign(self.kinetic * normal, self.v))
            if self.v * before < 0.0:
                self.v = 0.0
        self.x += s.dt * self.v
        if abs(self.x) >= self.play:
            self.x = math.copysign(self.play, self.x)
            if self.v * self.x > 0.0:
                self.v = 0.0
        slid = (self.v - before) / s.dt
        change = Change()
        change.torque[s.axis] = (
            self.mass * (G * self.x * math.cos(a) - self.height * slid) / INERTIA)
        return change


class SlidingBatteryOnWetDeck:
    """The battery strap has stretched and its deck is wet: the pack slides between its stops.

    A mechanic says: loose battery, it slips from side to side under its strap.

    A mass with Coulomb friction on an incline that turns (Meriam & Kraige, Dynamics, relative
    motion): x'' = g·sin a - h·a'' - mu·g·cos a·sign(x'), between stops with a coefficient of
    restitution. Moment on the frame m·(g·x·cos a - h·x''): the weight goes to the low side and
    knocks when it arrives. Felt: a thud some tenths of a second after each tilt, then it hangs to
    that side.
    """

    PACK, HEIGHT = 0.35, 0.03
    """kg, and m above the axis."""
    TRAVEL = 0.014
    """m each way at strength 1."""
    FRICTION, BOUNCE = 0.06, 0.2

    def __init__(self, strength):
        self.travel = self.TRAVEL * strength
        self.x = self.v = 0.0

    def step(self, s: Situation) -> Change:
        angle = s.angle[s.axis]
        pull = G * math.sin(angle) - self.HEIGHT * s.acceleration[s.axis]
        grip = self.FRICTION * G * math.cos(angle)
        before = self.v
        free = self.v + s.dt * pull
        self.v = math.copysign(max(0.0, abs(free) - s.dt * grip), free)
        self.x += s.dt * self.v
        if abs(self.x) > self.travel:
            self.x = math.copysign(self.travel, self.x)
            if self.v * self.x > 0.0:
                self.v = -self.BOUNCE * self.v if abs(self.v) > 0.01 else 0.0
        jerked = (self.v - before) / s.dt
        change = Change()
        change.torque[s.axis] = self.PACK / INERTIA * (
            G * self.x * math.cos(angle) - self.HEIGHT * jerked)
        return change


PLANTS = (
    Plant('sloshing_tank', SloshingTank, 'cables', 6, rig=True,
          may_be=('pendulum_stiffness', 'resonance')),
    Plant('communicating_tanks', CommunicatingTanks, 'cables', 7, rig=True,
          may_be=('pendulum_stiffness',)),
    Plant('spreader_disc', SpreaderDisc, 'cables', 8, rig=False,
          may_be=('gyroscopic_coupling', 'periodic_disturbance')),
    Plant('hanging_weight', HangingWeight, 'rigs', 2, rig=True,
          may_be=('pendulum_stiffness', 'resonance')),
    Plant('slung_load', SlungLoad, 'arms', 3, rig=False,
          may_be=('pendulum_stiffness', 'resonance')),
    Plant('bulging_tank', BulgingTank, 'arms', 4, rig=True,
          may_be=('pendulum_stiffness', 'resonance')),
    Plant('sliding_battery', SlidingBattery, 'arms', 5, rig=True, may_be=('coulomb_friction',)),
    Plant('loose_battery', LooseBattery, 'hoses', 4, rig=True),
    Plant('swinging_load', SwingingLoad, 'slings', 0, rig=False,
          may_be=('pendulum_stiffness', 'resonance')),
    Plant('sliding_battery_again', SlidingBatteryAgain, 'slings', 3, rig=True,
          may_be=('pendulum_stiffness', 'coulomb_friction')),
    Plant('bifilar_cargo_tray', BifilarCargoTray, 'chains', 2, rig=False, may_be=('resonance',)),
    Plant('slung_load_again', SlungLoadAgain, 'umbilicals', 0, rig=False,
          may_be=('pendulum_stiffness', 'resonance')),
    Plant('loose_battery_again', LooseBatteryAgain, 'umbilicals', 4, rig=True,
          may_be=('pendulum_stiffness', 'coulomb_friction', 'resonance', 'cubic_stiffness')),
    Plant('battery_slides_between_stops', BatterySlidesUnderStrap, 'workshop', 1, rig=True,
          may_be=('backlash',)),
    Plant('sliding_battery_on_wet_deck', SlidingBatteryOnWetDeck, 'field', 2, rig=True),
)
