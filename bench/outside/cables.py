"""Cables, hoses, tethers, cords and chains between the aircraft and what stands still."""

from __future__ import annotations

import math
from collections import deque

from .simulator import INERTIA, Change, G, Plant, Situation


class CableHarnessHysteresis:
    """Supply and data cables led across the gimbal: they bend elastically, stiffen, and rub
    strand on strand (Bouc-Wen).

        torque = -[k (theta - th0) + k3 (theta - th0)^3 + alpha z]
        dz/dt = w - beta |w| |z|^(n-1) z - gamma w |z|^n,   n = 1.3,  z saturates at about 0.07
        rad
    Sources: Wen, 'Method for random vibration of hysteretic systems', ASCE J. Eng. Mech. 102
    (1976); Ikhouane & Rodellar, 'Systems with Hysteresis' (2007); for gimbals: cable torque in
    Masten, 'Inertially stabilized platforms' (IEEE CSM 2008).
    Felt: the tether of a test rig is the largest parasitic torque about the axis besides
    friction, with its rest position off centre and a loop of torque over angle even when moved
    slowly.
    """

    def __init__(self, strength):
        self.k = strength
        self.z = 0.0

    def step(self, s: Situation) -> Change:
        w = float(s.rate[s.axis])
        x = float(s.angle[s.axis]) - 0.04
        z = self.z
        m = abs(z) ** 0.3
        self.z = z + s.dt * (w - 18.0 * abs(w) * m * z - 12.0 * w * m * abs(z))
        out = Change()
        out.torque[s.axis] = -self.k * (3.0 * x + 35.0 * x * x * x + 13.0 * self.z)
        return out


class StrandedCable:
    """Power loom bent over the pivot of the rig: its strands rub on one another.

    Bouc-Wen: z' = θ' - |θ'| (β z + γ sgn(θ') |z|), (β+γ) z_y = 1; torque = -[k_e (θ-θ0) (1 +
    ((θ-θ0)/0.3)²) + k_h z]. Wen, J. Eng. Mech. 102 (1976); Foti & Martinelli, "Hysteretic bending
    of strands", 2016.
    Felt because a 4 mm² supply loom holds some mNm when bent, which is 1 rad/s² on 0.012 kg m².
    """

    def __init__(self, strength):
        self.k, self.z = strength, 0.0

    def step(self, s: Situation) -> Change:
        c, a = Change(), s.axis
        w, q = float(s.rate[a]), float(s.angle[a]) - 0.04
        z = self.z
        self.z = z + s.dt * (w - (10.0 * abs(w) * z + 6.0 * w * abs(z)))
        c.torque[a] = -self.k * (2.0 * q * (1.0 + (q / 0.3) ** 2) + 17.0 * self.z)
        return c


class CableEcho:
    """Lightly tensioned cable from the arm's end to a stand beside the rig: waves run along it.

    String with end velocity v = a + b, force -Z (a - b), Z = sqrt(T μ); the outgoing wave a comes
    back after 2L/c as b = -ρ LP[a(t - 2L/c)] (clamp with loss, bending stiffness as low pass).
    Morse & Ingard, Theoretical Acoustics, ch. 4; Kinsler, Fundamentals of Acoustics, ch. 2. T = 2
    N, μ = 50 g/m, L = 0.95 m: c = 6.3 m/s, echo after 0.3 s.
    Felt because Z R² / J is about 1.6 per s and the echoes add up.
    """

    def __init__(self, strength):
        self.k, self.b = strength, 0.0
        self.line = deque([0.0] * 300)

    def step(self, s: Situation) -> Change:
        c, a = Change(), s.axis
        v = float(s.rate[a]) * math.cos(float(s.angle[a]))
        old = self.line.popleft()
        self.b += s.dt / 0.018 * (-0.82 * old - self.b)
        self.line.append(v - self.b)
        c.torque[a] = -self.k * 1.3 * (v - 2.0 * self.b)
        return c


class WinchTether:
    """Tethered aircraft: the winch below pulls at a hook under the centre of mass.

    Torque = -(r T / J) sin(θ - ψ), ψ = atan(x/h); x'' = g (u/u0) sin θ - d x' - (T/m) sin ψ; T =
    T0 + B (l')_lag, l' = x' sin ψ, (l')_lag behind the drum's inertia 0.25 s. Nicotra, Naldi &
    Garone, "Nonlinear control of a tethered UAV", Automatica 2017; Lupashin 2013.
    Felt because 3 N at 3 cm give 0.09 Nm per rad.
    """

    def __init__(self, strength):
        self.k, self.x, self.v, self.pay = strength, 0.0, 0.0, 0.0

    def step(self, s: Situation) -> Change:
        c, a = Change(), s.axis
        th = float(s.angle[a])
        psi = math.atan2(self.x, 3.0)
        sp = math.sin(psi)
        self.pay += s.dt / 0.25 * (self.v * sp - self.pay)
        pull = max(1.0 + 0.6 * self.pay, 0.1)
        acc = G * s.throttle / 0.5 * math.sin(th) - 0.5 * self.v - 2.6 * pull * sp
        self.v += s.dt * acc
        self.x += s.dt * self.v
        c.torque[a] = -self.k * 4.0 * pull * math.sin(th - psi)
        return c


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

    ARM = 0.22
    """m, from the centre to the propellers' line"""

    def __init__(self, strength):
        self.strength = 1.6 * strength
        self.h = [0.08, 0.08]
        self.w = 0.15

    def step(self, s):
        length, elastic = 0.6, 2.2
        angle, rate = float(s.angle[s.axis]), float(s.rate[s.axis])
        reach, lever = self.ARM * math.sin(angle), self.ARM * math.cos(angle)
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


class CableTwist:
    """Supply cable and rubber bush led through the joint: Bouc-Wen hysteresis beside a spring.

    torque = -k [p (angle - set) + (1 - p) z],  z' = w - (b |w| z + c w |z|).
    The strands slide on each other over some hundredths of a rad and the bundle stays bent: the restoring
    torque depends on the way by which the angle was reached, and has a loop that does not
    depend on the rate. Wen, "Method for random vibration of hysteretic systems", J. Eng. Mech. Div. ASCE 102
    (1976); Ikhouane & Rodellar, "Systems with Hysteresis", Wiley 2007. Every rig has the cable of its supply or
    of its data go past the pivot.
    """

    def __init__(self, strength):
        self.k = 13.0 * strength
        self.part, self.set = 0.3, 0.04
        self.b, self.c = 0.6 / 0.075, 0.4 / 0.075
        self.z = 0.0

    def step(self, s: Situation) -> Change:
        change = Change()
        w, z = float(s.rate[s.axis]), self.z
        self.z = z + s.dt * (w - (self.b * abs(w) * z + self.c * w * abs(z)))
        change.torque[s.axis] = -self.k * (
            self.part * (float(s.angle[s.axis]) - self.set) + (1.0 - self.part) * self.z)
        return change


class UmbilicalCable:
    """The power and data cable of a test rig: stranded, taped to an arm, hanging down to the floor.

    Bending makes the strands slip on one another: above a little curvature the cable is softer than below it and
    it does not spring back wholly. Bouc-Wen:
        z' = φ' − β |φ'| |z|^(n−1) z − γ φ' |z|^n,     n = 1.4
        torque = −k (a φ + (1−a) z) − w r (h0 + r sin φ) cos φ / J
    The second part is the weight of what hangs (w per metre) from the arm's tip down to the floor: the higher
    the tip, the more cable it lifts (an offset and an uneven spring).
    Source: Wen, J. Eng. Mech. Div. 102 (1976); Foti & Martinelli, Mech. Syst. Signal Process. 2016 (hysteretic bending
    of metallic strands); Costello, Theory of Wire Rope.
    Felt on each rig on which the battery is replaced with a supply: cable for 30 A is as stiff as a finger.
    """

    K, A, N, YIELD = 18.0, 0.2, 1.4, 0.045
    ROPE, ARM, HEIGHT = 0.25, 0.2, 0.45
    """N/m, m, m"""

    def __init__(self, strength):
        self.strength = strength
        self.beta = 0.65 / self.YIELD**self.N
        self.gamma = 0.35 / self.YIELD**self.N
        self.z = 0.0

    def step(self, s: Situation) -> Change:
        c = Change()
        i = s.axis
        phi, p = float(s.angle[i]), float(s.rate[i])
        z = self.z
        size = abs(z)
        grown = size ** self.N
        self.z = z + s.dt * (p - self.beta * abs(p) * grown * (1.0 if z >= 0.0 else -1.0)
                             - self.gamma * p * grown)
        weight = self.ROPE * self.ARM * (self.HEIGHT + self.ARM * math.sin(phi)) * math.cos(phi) / INERTIA
        c.torque[i] = -self.strength * (self.K * (self.A * phi + (1.0 - self.A) * self.z) + weight)
        return c


class SafetyCords:
    """Rubber cords from the arms' tips to the rig's base that keep it from tipping over; both hang slack in the
    middle, not equally slack.

    Cord j is stretched by e = ±r sin φ − slack_j; λ = 1 + e/L. It pulls only when stretched (e > 0):
        F = G A (λ − 1/λ²) + q,     q' = G₁A/L e' − q/τ,     F ≥ 0
        torque = −r cos φ F_right + r cos φ F_left
    Rubber's own curve (stiff at first, then softer) and one relaxing branch: it pulls harder when loaded fast than when
    held, and less on the way back.
    Source: Treloar, The Physics of Rubber Elasticity (neo-Hookean uniaxial); Ferry, Viscoelastic Properties of
    Polymers (Maxwell branch); unilateral contact as in any text on nonlinear vibration.
    Felt: the cords are put where the operator is afraid, a few degrees from level. This one may be counted among the switching effects.
    """

    ARM, REST = 0.2, 0.05
    SLACK = (0.012, 0.026)
    """m: 3.4 and 7.5 degrees."""
    GA, GA1, TAU = 0.14, 0.16, 0.35
    """N, N, s"""

    def __init__(self, strength):
        self.strength = strength
        self.before = [0.0, 0.0]
        self.q = [0.0, 0.0]

    def step(self, s: Situation) -> Change:
        c = Change()
        i = s.axis
        phi = float(s.angle[i])
        lift = self.ARM * math.sin(phi)
        total = 0.0
        for j, sign in ((0, 1.0), (1, -1.0)):
            e = sign * lift - self.SLACK[j]
            e = max(e, 0.0)
            q = self.q[j] + self.GA1 / self.REST * (e - self.before[j])
            q -= s.dt / self.TAU * q
            self.before[j], self.q[j] = e, q
            if e > 0.0:
                lam = 1.0 + e / self.REST
                force = self.GA * (lam - 1.0 / (lam * lam)) + q
                if force > 0.0:
                    total -= sign * force
        c.torque[i] = self.strength * total * self.ARM * math.cos(phi) / INERTIA
        return c


class HeapedAnchorChain:
    """A chain hangs from one arm's tip of the rig to a heap on the floor (balanced by a counterweight).

    Rising, the tip lifts further links: their weight is added and they must be brought to its speed;
    sinking, it lays links down, which needs no force. With z = z0 + R sin(angle) the hanging length,
    T = λ (g z + z z'' + z'² [z' > 0]),  torque = -R cos(angle) (T - λ g z0) / J.
    Source: Meriam & Kraige, Dynamics, variable mass (the lifted chain); Irodov, problem 1.177 ff.
    Felt here: the weight of the links is a spring, the hanging part an inertia that grows with the
    angle, and the links picked up brake one direction only. Ground-anchored chains are a usual restraint.
    """

    R, Z0, LOAD = 0.35, 0.30, 2.5

    def __init__(self, strength):
        self.c = strength * self.LOAD
        """λ R / J, 1/m²: 0.1 kg/m at 0.014 kg m²"""
        self.az = 0.0

    def step(self, s: Situation) -> Change:
        i = s.axis
        a, w, wd = float(s.angle[i]), float(s.rate[i]), float(s.acceleration[i])
        ca, sa = math.cos(a), math.sin(a)
        z = max(0.0, self.Z0 + self.R * sa)
        v = self.R * ca * w
        self.az += 0.15 * (self.R * (ca * wd - sa * w * w) - self.az)
        pull = G * (z - self.Z0) + z * self.az + (v * v if v > 0.0 else 0.0)
        out = Change()
        out.torque[i] = -self.c * ca * pull
        return out


class EyeletRopeWrap:
    """A safety line runs from the arm's tip over a fixed eyelet to a small hanging weight.

    Euler-Eytelwein: the arm feels T0 exp(μβ) while it draws line in and T0 exp(-μβ) while it gives
    it back; between, the rope's fibres yield before they slide (Dahl):
    T = T0 exp(μ β z),  z' = (v/δ) (1 - z sgn v),  and the wrap β = β0 + c angle changes with the tilt.
    The weight's inertia adds T0 z''/g. Torque = -R T/J.
    Source: Euler 1769 (any book of statics); Dahl 1968, A solid friction model.
    Felt here: friction that is stronger one way than the other, on top of the weight's pull, and that
    depends on the angle. One-axis rigs are kept from overturning by just such lines.
    """

    PULL, MU, WRAP, BEND, SLIP, ARM = 2.6, 0.27, 1.9, 2.2, 0.012, 0.25

    def __init__(self, strength):
        self.pull = strength * self.PULL
        self.z = 0.0
        self.soft = 0.0

    def step(self, s: Situation) -> Change:
        i = s.axis
        w = float(s.rate[i])
        step = w * s.dt / self.SLIP
        # implicit in the decay, so that it stays within ±1
        self.z = (self.z + step) / (1.0 + abs(step))
        wrap = self.WRAP + self.BEND * float(s.angle[i])
        self.soft += 0.15 * (float(s.acceleration[i]) - self.soft)
        tension = math.exp(self.MU * wrap * self.z) * (1.0 + self.ARM * self.soft / G)
        out = Change()
        out.torque[i] = -self.pull * (tension - 1.0)
        return out


class Umbilical:
    """The power and data bundle of a test rig, bent back and forth by the rotation.

    Stranded cable: it bends elastically, stiffer as it straightens against its clamp, and its
    strands
    rub on each other, so that the bending moment has a rate-independent loop:
        torque = -(k (th - th0) + k3 (th - th0)^3) - M z,   dz = (dth - z |dth|) / e
    Source: Dahl's friction model (1968) = Bouc-Wen with n = 1; Papailiou, "On the bending
    stiffness of
    transmission line conductors" (IEEE Trans. Power Delivery, 1997). Felt on every rig with a
    thick
    cable: a moment of some hundredth Nm on 0.012 kg m² is about 1 rad/s².
    """

    def __init__(self, strength: float) -> None:
        self.k, self.k3, self.loop = 1.6 * strength, 30.0 * strength, 0.95 * strength
        self.z, self.rest = 0.0, 0.05

    def step(self, s: Situation) -> Change:
        c = Change()
        i = s.axis
        moved = float(s.rate[i]) * s.dt
        side = 1.0 if moved > 0.0 else -1.0
        self.z = side + (self.z - side) * math.exp(-abs(moved) / 0.035)
        bend = float(s.angle[i]) - self.rest
        c.torque[i] = -(self.k + self.k3 * bend * bend) * bend - self.loop * self.z
        return c


class SafetyLines:
    """Two slack safety cords of a rig, one on each side: each pulls only when its slack is used
    up.

    The slacks differ. A taut braided cord stiffens with stretch and loses energy within:
        torque = -k d^1.3 (1 + l d'),  d = th - slack > 0, never pushing; likewise on the other
        side
    Source: the contact law of Hunt & Crossley (1975; damping as in Lankarani & Nikravesh 1990),
    here for a
    cord in tension; stiffening of ropes with load, Feyrer, "Wire Ropes" (2007). Felt because
    references of ±0.2 rad run
    into cords that go taut at a tenth of a rad.
    """

    def __init__(self, strength: float) -> None:
        self.k = 55.0 * strength
        self.slack_up, self.slack_down = 0.09, 0.12

    def step(self, s: Situation) -> Change:
        c = Change()
        i = s.axis
        th, w = float(s.angle[i]), float(s.rate[i])
        if th > self.slack_up:
            c.torque[i] = -self.k * (th - self.slack_up) ** 1.3 * max(0.0, 1.0 + 0.35 * w)
        elif th < -self.slack_down:
            c.torque[i] = self.k * (-th - self.slack_down) ** 1.3 * max(0.0, 1.0 - 0.35 * w)
        return c


class SupplyLeadPullsTight:
    """The lead from the bench supply is too short: slack on one side, taut on the other.

    A mechanic says: power lead too short, tugs when it rolls that way.
    Source: unilateral (one-sided) spring with a loss in the cable, Hunt & Crossley, J. Appl. Mech.
    42 (1975): F = k d (1 + c d'), d = stretch > 0, never pushing.
    Felt: free to one side, a rubbery tug at the other.
    """

    def __init__(self, strength: float) -> None:
        self.slack = 0.03  # rad of tilt until it is taut
        self.stiffness = 0.25 * strength / INERTIA  # 0.25 N m/rad, a silicone lead
        self.loss = 0.35  # s/rad

    def step(self, s: Situation) -> Change:
        stretch = float(s.angle[s.axis]) - self.slack
        change = Change()
        if stretch > 0.0:
            pull = self.stiffness * stretch * (1.0 + self.loss * float(s.rate[s.axis]))
            change.torque[s.axis] = -max(pull, 0.0)
        return change


class ShortTether:
    """A nylon safety line that is too short: slack on one side, taut beyond an angle.

    A mechanic says: safety line tied too short, it catches on one side.

    Unilateral elastic constraint (rope: Hooke's law with Kelvin-Voigt damping, tension only;
    Meriam & Kraige, Dynamics). T = max(0, k·x + c·x'), x the stretch beyond the slack. Felt: free
    to one side, to the other side the axis is softly pulled back from about 6 degrees on.
    """

    SLACK = 0.10
    """rad"""
    STIFF, DAMP = 60.0, 1.2
    """(rad/s²)/rad and (rad/s²)/(rad/s) at strength 1."""

    def __init__(self, strength):
        self.k, self.c = self.STIFF * strength, self.DAMP * strength

    def step(self, s: Situation) -> Change:
        change = Change()
        stretch = s.angle[s.axis] - self.SLACK
        if stretch > 0.0:
            change.torque[s.axis] = -max(0.0, self.k * stretch + self.c * s.rate[s.axis])
        return change


PLANTS = (
    Plant('cable_harness_hysteresis', CableHarnessHysteresis, 'bearings', 2, rig=True,
          may_be=('coulomb_friction', 'pendulum_stiffness', 'cubic_stiffness')),
    Plant('stranded_cable', StrandedCable, 'cables', 0, rig=True,
          may_be=('coulomb_friction', 'pendulum_stiffness', 'cubic_stiffness')),
    Plant('cable_echo', CableEcho, 'cables', 1, rig=True),
    Plant('winch_tether', WinchTether, 'cables', 2, rig=False, may_be=('pendulum_stiffness',)),
    Plant('umbilical_bundle', UmbilicalBundle, 'hoses', 0, rig=True,
          may_be=('pendulum_stiffness', 'coulomb_friction')),
    Plant('sagging_guys', SaggingGuys, 'hoses', 1, rig=True,
          may_be=('pendulum_stiffness', 'cubic_stiffness')),
    Plant('swinging_tether', SwingingTether, 'hoses', 2, rig=False,
          may_be=('resonance', 'pendulum_stiffness')),
    Plant('cable_twist', CableTwist, 'gears', 2, rig=True,
          may_be=('pendulum_stiffness', 'coulomb_friction')),
    Plant('umbilical_cable', UmbilicalCable, 'slings', 1, rig=True,
          may_be=('pendulum_stiffness', 'coulomb_friction')),
    Plant('safety_cords', SafetyCords, 'slings', 2, rig=True,
          may_be=('cubic_stiffness', 'pendulum_stiffness')),
    Plant('heaped_anchor_chain', HeapedAnchorChain, 'chains', 0, rig=True,
          may_be=('pendulum_stiffness', 'quadratic_drag')),
    Plant('eyelet_rope_wrap', EyeletRopeWrap, 'chains', 1, rig=True, may_be=('coulomb_friction',)),
    Plant('umbilical', Umbilical, 'umbilicals', 1, rig=True,
          may_be=('pendulum_stiffness', 'cubic_stiffness', 'coulomb_friction')),
    Plant('safety_lines', SafetyLines, 'umbilicals', 2, rig=True,
          may_be=('cubic_stiffness', 'pendulum_stiffness')),
    Plant('supply_lead_pulls_tight', SupplyLeadPullsTight, 'workshop', 2, rig=True),
    Plant('short_tether', ShortTether, 'field', 1, rig=True),
)
