"""Twelve effects in four families: cables, structures, propulsion and power, flight software."""

from __future__ import annotations

import math

import numpy as np
from outside_simulator import Change

G = 9.81
GAIN = (450.0, 400.0)
SIGN = ((1.0, -1.0, -1.0, 1.0), (1.0, 1.0, -1.0, -1.0))
"""How each motor acts on roll and on pitch."""
ARM = 0.22
"""m, from the centre to the propellers' line"""
INERTIA = 0.012
"""kg m², roll and pitch, of the aircraft that we imagine (1.2 kg)"""


def drive(speed, axis):
    """Angular acceleration that the motors deliver about roll or pitch, rad/s²."""
    a, b, c, d = speed.tolist()
    p, q, r, t = SIGN[axis]
    return 0.25 * GAIN[axis] * (p * a + q * b + r * c + t * d)


# ------------------------------------------------------------------ cables, tethers and hoses
class UmbilicalBundle:
    """A jacketed bundle of power and data wires that runs from the rig's frame to the aircraft.

    The bundle bends with the angle. Its strands stick to each other and slip one layer after the
    other, so it is stiff after each reversal, softer later, and comes back along another path.
    Bouc-Wen model with an elastic part, a hysteretic part and the set that the bundle took when it was
    strapped down:
        torque = -[a k (theta - theta0) + (1-a) k Y z]
        Y z'   = theta' - beta |theta'| |z|^(n-1) z - gamma theta' |z|^n,   n = 1.5, beta + gamma = 1
    Sources: Wen, J. Eng. Mech. Div. ASCE 102 (1976) 249; Demetriades, Constantinou & Reinhorn, Eng.
    Struct. 15 (1993) 321 (wire rope).
    Felt here: 16 rad/s² per rad is 0.19 N m/rad on 0.012 kg m², an ordinary stiff silicone lead.
    """

    def __init__(self, strength):
        self.k = 17.0 * strength
        self.z = 0.0

    def step(self, s):
        a, y, beta = 0.35, 0.05, 0.65
        w = float(s.rate[s.axis])
        z = self.z
        m = abs(z)
        root = math.sqrt(m)
        self.z = z + s.dt * (w - beta * abs(w) * root * z - (1.0 - beta) * w * m * root) / y
        change = Change()
        change.torque[s.axis] = -self.k * (
            a * (float(s.angle[s.axis]) - 0.02) + (1.0 - a) * y * self.z)
        return change


class SaggingGuys:
    """Two light safety cords from the arm's ends to posts beside the rig, one with more slack.

    Each hangs in a flat curve; lifting its arm takes up the slack, and its pull rises the steeper the
    less slack is left, until the cord itself stretches. Irvine's cable equation, chord l, unstretched
    length S, weight w per metre, elasticity E A:
        S - l = w² l³ / (24 H²) - H S / (E A),      l = l0 +- r sin(theta)
        torque = (H2 - H1) r cos(theta) / J,    and a loss in the cord in proportion to its tightness,
        H (1 + eta l')
    Source: Irvine, Cable Structures (MIT Press 1981), ch. 2; Ernst, Bauingenieur 40 (1965) 52.
    Felt here: some tenths of a newton at 0.22 m are several rad/s².
    """

    def __init__(self, strength):
        self.strength = 1.6 * strength
        self.h = [0.08, 0.08]
        self.w = 0.15

    def step(self, s):
        length, elastic = 0.6, 2.2
        angle, rate = float(s.angle[s.axis]), float(s.rate[s.axis])
        reach, lever = ARM * math.sin(angle), ARM * math.cos(angle)
        total = 0.0
        for i, (side, slack) in enumerate(((1.0, 0.036), (-1.0, 0.052))):
            chord = length + side * reach
            excess = length + slack - chord
            c = self.w * self.w * chord**3 / 24.0
            e = (length + slack) / elastic
            h = self.h[i]
            for _ in range(3):
                # c / H² - e H - excess falls and is convex in H: Newton from the left side converges
                f = c / (h * h) - e * h - excess
                h -= f / (-2.0 * c / (h * h * h) - e)
                h = max(h, 0.01)
            self.h[i] = h
            total -= side * h * (1.0 + 0.5 * side * lever * rate)
        change = Change()
        change.torque[s.axis] = self.strength * total * lever / INERTIA
        return change


class SwingingTether:
    """A stub of cable with a plug (0.1 kg) hangs from a hook 5 cm below the centre of gravity.

    It swings behind the sideways acceleration of the aircraft, which itself comes from the tilt:
        l phi'' = (a - d theta'') cos(phi) - g' sin(phi) - 2 zeta sqrt(g l) phi' - c |phi'| phi'
        a = g' tan(theta) - v/Tv,  v' = a;     g' = g + climb acceleration after the throttle
        torque = m (g' cos(phi) + a sin(phi) + l phi'²) d sin(phi - theta) / J
    In a lasting acceleration phi = theta and nothing is felt; after each change of tilt it swings for
    seconds near 0.8 Hz. Two axes alike. Sources: Bisgaard, la Cour-Harbo & Bendtsen, J. Guid. Control
    Dyn. 32 (2009); Cicolani & Kanning, NASA TP-3280 (1992).
    Felt here: m g d / J is about 4 rad/s² per rad of swing.
    """

    def __init__(self, strength):
        self.k = 0.10 * 0.05 / INERTIA * 1.5 * strength
        self.phi, self.dphi, self.v = [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]
        self.climb = 0.0

    def step(self, s):
        l, d = 0.40, 0.05
        up = G * (s.throttle / 0.5 - 1.0) - self.climb / 0.8
        self.climb += s.dt * up
        g = G + up
        change = Change()
        for i in (0, 1):
            theta = float(s.angle[i])
            phi, w = self.phi[i], self.dphi[i]
            a = g * math.tan(theta) - self.v[i] / 1.5
            self.v[i] += s.dt * a
            sine, cosine = math.sin(phi), math.cos(phi)
            w += s.dt * (((a - d * float(s.acceleration[i])) * cosine - g * sine) / l
                         - 2.0 * 0.07 * math.sqrt(G / l) * w - 0.15 * abs(w) * w)
            self.dphi[i], self.phi[i] = w, phi + s.dt * w
            pull = g * cosine + a * sine + l * w * w
            change.torque[i] = self.k * pull * math.sin(phi - theta)
        return change


# ------------------------------------------------------------------ structures and fasteners
class ElasticArms:
    """Folding nylon arms with the motors at their ends: hub and arm tips are two inertias.

    The thrust pushes at the tips and reaches the hub, where the gyro sits, only through the arms'
    bending. With J_tips = mu J, J_hub = (1-mu) J, y the bending as an angle:
        y'' = drive/mu - (k y + c y')/(mu (1-mu)),    hub's acceleration = (k y + c y')/(1-mu)
    (in Y = mu y: Y'' = drive - hub's, hub's = w² Y + 2 zeta w Y', w² = k/(mu (1-mu)): mu only scales y).
        c = c0 (1 + |y|/y0)      (friction in the folding joint: loss grows with amplitude)
    Sources: Meirovitch, Fundamentals of Vibrations (2001), ch. 5 and 7; Gaul & Nitsche, Appl. Mech. Rev.
    54 (2001) 93 (joints). Felt here: first bending mode near 12 Hz, little above the control's bandwidth.
    Strength multiplies the compliance. Acts about roll and pitch.
    """

    def __init__(self, strength):
        self.w = 2.0 * math.pi * 12.3 / math.sqrt(max(strength, 0.02))
        self.y, self.v = [0.0, 0.0], [0.0, 0.0]

    def step(self, s):
        zeta = 0.11
        w = self.w
        change = Change()
        for i in (0, 1):
            a = drive(s.speed, i)
            y, v = self.y[i], self.v[i]
            # y here is the docstring's Y, so that its rest value is drive / w²
            damping = 2.0 * zeta * w * (1.0 + abs(y) / 0.008)
            inner = w * w * y + damping * v
            v += s.dt * (a - inner)
            y += s.dt * v
            self.v[i], self.y[i] = v, y
            change.torque[i] = w * w * y + damping * v - a
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


class BendingPlate:
    """The flight controller sits on a thin bottom plate that the arms' roots twist.

    The motors' torque bends the plate; the board tilts by beta against the frame, and the gyro shows
    the speed of that tilt besides the frame's rate. The plate of glass-filled nylon on rubber pads
    follows its load as a Kelvin-Voigt solid whose stiffness hardens:
        T beta' + beta (1 + (beta/beta0)²) = c drive,       gyro = rate + beta'
    Sources: Ward & Sweeney, Mechanical Properties of Solid Polymers, ch. 5; Timoshenko & Woinowsky-
    Krieger, Theory of Plates and Shells (large deflections); base-strain error in sensor makers' notes.
    Felt here: half a degree of tilt at full torque, within 50 ms, is some 0.1 rad/s.
    """

    def __init__(self, strength):
        self.c = 9.5e-4 * strength
        self.beta = [0.0, 0.0]

    def step(self, s):
        change = Change()
        for i in (0, 1):
            b = self.beta[i]
            r = b / 0.012
            d = (self.c * drive(s.speed, i) - b * (1.0 + r * r)) / 0.03
            self.beta[i] = b + s.dt * d
            change.gyro[i] = d
        return change


# ------------------------------------------------------------------ propulsion and power
class DynamicInflow:
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


class SaggingQuadratic:
    """Thrust goes with the square of duty times voltage, and the voltage sags behind the current.

    The makers of the simple model took thrust as linear in the command; the propeller starts at u0 and gives
        T_i ~ ((u_i - u0) V)²   ->   factor_i = (u_i - u0)² / (2 (0.5 - u0) u_i) (V/V0)²
    (scaled to the slope in hover, where the simple gain was measured),
        V = V_battery - R0 I - V1,   V1' = (R1 I - V1)/tau1,   I = I_max mean(u^1.5)
    with the leads' resistance and a cell pack's second (diffusion) branch. So the same difference of
    commands turns the aircraft more at high throttle, then, as the voltage sinks, less again.
    Sources: McCormick, Aerodynamics, Aeronautics and Flight Mechanics, ch. 6; Chen & Rincon-Mora, IEEE
    Trans. Energy Conv. 21 (2006) 504 (battery). Felt here: throttle 0.42 to 0.6 alone is 50 % of gain.
    Strength mixes between the linear thrust (0) and this one (1), and beyond.
    """

    def __init__(self, strength):
        self.strength = strength
        self.v1 = 0.0

    def step(self, s):
        u = s.speed.tolist()
        i = 0.0
        for n in u:
            n = max(n, 0.0)
            i += 15.0 * n * math.sqrt(n)
        # 21 A in hover; 10 mOhm of leads and cells, 12 mOhm of diffusion
        self.v1 += s.dt * (0.012 * i - self.v1) / 2.5
        v = (s.battery_v - 0.010 * i - self.v1) / 11.5
        v *= v
        start, k = 0.16, self.strength
        out = []
        for n in u:
            n = max(n, 0.02)
            e = max(n - start, 0.0)
            out.append(1.0 + k * (e * e * v / (2.0 * (0.5 - start) * n) - 1.0))
        change = Change()
        change.thrust = np.array(out)
        return change


# ------------------------------------------------------------------ flight-control software
class BiasEstimator:
    """The attitude filter's integrator learns tilts as gyro bias, and the rate loop uses that gyro.

    In free flight the accelerometer shows no lasting tilt (the thrust lies along the body's z), so the
    filter pulls its attitude to zero and takes the difference as a bias. Mahony's filter, with the usual
    weight that trusts the accelerometer less when its length differs from g:
        e = 0 - est,  est' = gyro - b + kP W e,   b' = -kI W e - b/Tb,      gyro used = gyro - b
        W = 1/(1 + (|a|/g - 1)²/s²),  |a|/g = throttle/0.5
    Sources: Mahony, Hamel & Pflimlin, IEEE TAC 53 (2008) 1203; Leishman et al., Quadrotors and
    accelerometers, IEEE Control Syst. Mag. 34 (2014) 28. Felt here: gains too high by haste (kI = 1.2 /s²)
    show as a slow false rate after each manoeuvre. Two axes alike. Strength multiplies kI.
    """

    def __init__(self, strength):
        self.ki = 1.2 * strength
        self.est, self.b = [0.0, 0.0], [0.0, 0.0]

    def step(self, s):
        off = (s.throttle / 0.5 - 1.0) / 0.25
        weight = 1.0 / (1.0 + off * off)
        change = Change()
        for i in (0, 1):
            e = -self.est[i]
            b = self.b[i]
            self.est[i] += s.dt * (float(s.rate[i]) - b + 1.2 * weight * e)
            self.b[i] = b + s.dt * (-self.ki * weight * e - b / 4.0)
            change.gyro[i] = -b
        return change


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


class StaggeredFrames:
    """The commands travel as a pulse train: one channel after the other, each once a frame.

    A loop of 250 Hz writes to a slower output (about 65 Hz, not in step with the loop). Channel i is taken
    over from the buffer at its own place in the frame, and holds until its next turn:
        u_i(t) = command_i(t_ki),   t_ki = (k + i/4) T + 1 ms + command_i 1 ms (end of its pulse)
    The age of a command runs as a saw-tooth from the pulse's own length to the frame's, differently for
    each motor, so that one side of the aircraft answers before the other.
    Sources: Astrom & Wittenmark, Computer-Controlled Systems, ch. 2-4; Cervin et al., jitter, IEEE Control
    Syst. Mag. 23 (2003) 16. Felt here: 8 ms of delay in the mean beside 8 ms of its own, and steps.
    One of the jumping effects. Strength multiplies T.
    """

    def __init__(self, strength):
        self.period = 0.0150 * strength
        self.held, self.coming, self.due, self.turn = None, None, None, None

    def step(self, s):
        if self.held is None:
            self.held = s.command.tolist()
            self.coming = list(self.held)
            self.due = [math.inf] * 4
            self.turn = [0.25 * i * self.period for i in range(4)]
        now = s.t + 1e-9
        for i in range(4):
            if now >= self.turn[i]:
                c = float(s.command[i])
                self.coming[i], self.due[i] = c, self.turn[i] + 0.001 + 0.001 * c
                self.turn[i] += max(self.period, 0.0021)
            if now >= self.due[i]:
                self.held[i], self.due[i] = self.coming[i], math.inf
        change = Change()
        change.command = np.array(self.held)
        return change


EFFECTS = {
    'umbilical_bundle': (UmbilicalBundle, True),
    'sagging_guys': (SaggingGuys, True),
    'swinging_tether': (SwingingTether, False),
    'elastic_arms': (ElasticArms, False),
    'loose_battery': (LooseBattery, True),
    'bending_plate': (BendingPlate, False),
    'uneven_inflow': (DynamicInflow, False),
    'coasting_props': (CoastingProps, False),
    'sagging_quadratic': (SaggingQuadratic, False),
    'bias_estimator': (BiasEstimator, False),
    'integer_low_pass': (IntegerLowPass, True),
    'staggered_frames': (StaggeredFrames, False),
}
FAMILIES = {
    'cables': ('umbilical_bundle', 'sagging_guys', 'swinging_tether'),
    'structures': ('elastic_arms', 'loose_battery', 'bending_plate'),
    'propulsion': ('uneven_inflow', 'coasting_props', 'sagging_quadratic'),
    'software': ('bias_estimator', 'integer_low_pass', 'staggered_frames'),
}
MAY_BE = {
    'umbilical_bundle': ('pendulum_stiffness', 'coulomb_friction'),
    'sagging_guys': ('pendulum_stiffness', 'cubic_stiffness'),
    'swinging_tether': ('resonance', 'pendulum_stiffness'),
    'elastic_arms': ('resonance',),
    'coasting_props': ('saturation', 'motor_lag'),
    'sagging_quadratic': ('thrust_curve', 'battery_sag'),
    'integer_low_pass': ('backlash', 'dead_zone'),
}
"""Names of the table that are no lie: what the effect contains, or cannot be told from."""
