"""Twelve effects: cables, structures, carried loads, batteries and heat."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from outside_simulator import Change, Situation

G = 9.81
NEGATIVE = {0: (1, 2), 1: (2, 3)}
"""Motors whose thrust turns the axis backwards."""


def _side(a: int):
    low = NEGATIVE[a]
    return low, tuple(i for i in range(4) if i not in low)


# ---------------------------------------------------------------------- cables, hoses, tethers


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


# ---------------------------------------------------------------------- structures


class FlexibleBoom:
    """Carbon boom across the frame (spray bar): its antisymmetric bending mode.

    q'' + 2ζω q' + d|q'|q' + ω² q + β q³ = -α ; torque = -μ q''  (μ = boom's part of the inertia).
    Craig & Kurdila, Fundamentals of Structural Dynamics; Meirovitch, hybrid coordinates (Likins).
    Quadratic term: air drag of the moving bar; cubic: stretching. Felt because the mode, 4.2 Hz,
    lies at the crossover of the rate loop.
    """

    def __init__(self, strength):
        self.mu, self.q, self.v = 0.11 * strength, 0.0, 0.0
        self.w = 2.0 * math.pi * 4.2

    def step(self, s: Situation) -> Change:
        c, a, w = Change(), s.axis, self.w
        al = float(s.acceleration[a])
        v, q = self.v, self.q
        acc = -al - 2.0 * 0.05 * w * v - 1.5 * abs(v) * v - w * w * q * (1.0 + (q / 0.12) ** 2)
        self.v = v + s.dt * acc
        self.q = q + s.dt * self.v
        c.torque[a] = -self.mu * acc
        return c


class FoamMountedGyro:
    """The sensor box stands on soft foam and turns against the frame.

    q'' = -α - 2ζω q' - ω² (q + z + q³/q1²), z' = g q' - z/τ (Zener branch of the foam); the gyro
    shows rate + q'. ω² = ω0² / strength. Rivin, Passive Vibration Isolation; Lakes, Viscoelastic
    Materials, ch. 2.
    Felt because a heavy box on 10 mm of foam stands at 6 to 9 Hz.
    """

    def __init__(self, strength):
        self.w2 = (2.0 * math.pi * 8.0) ** 2 / strength
        self.w = math.sqrt(self.w2)
        self.q = self.v = self.z = 0.0

    def step(self, s: Situation) -> Change:
        c, a = Change(), s.axis
        al = float(s.acceleration[a])
        q, v = self.q, self.v
        acc = -al - 2.0 * 0.12 * self.w * v - self.w2 * (q + self.z + q * (q / 0.03) ** 2)
        self.z += s.dt * (0.6 * v - self.z / 0.05)
        self.v = v + s.dt * acc
        self.q = q + s.dt * self.v
        c.gyro[a] = self.v
        return c


class RattlingGear:
    """Folding landing gear with play in its down-lock: it swings between its stops.

    q'' = -α - c q' - ω_g² q + f, f = -k δ (1 + e δ') sgn(q) beyond the gap (Hunt-Crossley),
    torque on the frame = -μ f + μ c q'. Hunt & Crossley, J. Appl. Mech. 42 (1975); Nordin &
    Gutman, "Systems with backlash", 2002.
    Felt because gear is an eighth of the inertia and 2 degrees of play are common.
    """

    def __init__(self, strength):
        self.mu, self.q, self.v = 0.11 * strength, 0.0, 0.0

    def step(self, s: Situation) -> Change:
        c, a = Change(), s.axis
        q, v = self.q, self.v
        deep = abs(q) - 0.03
        f = 0.0
        if deep > 0.0:
            side = 1.0 if q > 0.0 else -1.0
            f = -side * max(5000.0 * deep * (1.0 + 0.8 * side * v), 0.0)
        acc = -float(s.acceleration[a]) - 1.5 * v - 9.0 * q + f
        self.v = v + s.dt * acc
        self.q = q + s.dt * self.v
        c.torque[a] = self.mu * (1.5 * v - f)
        return c


# ---------------------------------------------------------------------- carried loads, liquids


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


# ---------------------------------------------------------------------- batteries, wiring, heat


class WeakBattery:
    """Old, cold pack: its voltage sinks under load, at once and by two polarisations.

    V = E - I R0 - V1 - V2, Vi' = (I Ri - Vi)/τi (Thevenin), I ~ Σ thrust^1.5; thrust factor
    (V/Vh)^1.8, Vh at hover, fresh. Plett, Battery Management Systems vol. 1, ch. 2; Podhradsky et
    al. 2014.
    Felt because every gain goes with the square of the voltage.
    """

    def __init__(self, strength):
        self.k, self.v1, self.v2 = strength, 0.0, 0.0

    def step(self, s: Situation) -> Change:
        c = Change()
        i = 0.0
        for n in range(4):
            i += max(float(s.speed[n]), 0.0) ** 1.5
        i /= 4.0 * 0.35355
        k = self.k
        self.v1 += s.dt / 0.5 * (0.9 * k * i - self.v1)
        self.v2 += s.dt / 4.0 * (1.0 * k * i - self.v2)
        v = s.battery_v - 0.9 * k * i - self.v1 - self.v2
        c.thrust = np.full(4, (max(v, 6.0) / (12.6 - 2.6 * k)) ** 1.8)
        return c


class CorrodedPlug:
    """Bad plug in the harness of the two motors of one side; it heats itself.

    ΔV/V = r (1 + a ϑ) (I1 + I2), ϑ' = ((I1+I2)² (1 + a ϑ) - ϑ)/τ, I ~ thrust^1.5; their thrust
    factor (1 - ΔV/V)² + what was trimmed away in hover. Holm, Electric Contacts (1967),
    self-heating of a contact; Slade 2014.
    Felt because two per cent of a side's thrust are 2 rad/s².
    """

    def __init__(self, strength):
        self.k, self.hot = strength, 1.0

    def step(self, s: Situation) -> Change:
        c = Change()
        m, n = NEGATIVE[s.axis]
        i = (max(float(s.speed[m]), 0.0) ** 1.5 + max(float(s.speed[n]), 0.0) ** 1.5) / 0.7071
        self.hot += s.dt / 2.0 * (i * i * (1.0 + 0.3 * (self.hot - 1.0)) - self.hot)
        drop = 0.011 * self.k * i * (1.0 + 0.6 * (self.hot - 1.0))
        f = (1.0 - drop) ** 2 + 1.0 - (1.0 - 0.011 * self.k) ** 2
        thrust = np.ones(4)
        thrust[m] = thrust[n] = f
        c.thrust = thrust
        return c


class WarmGyro:
    """The gyro sits beside the speed controllers of one side; its offset follows their heat.

    Foster network: Ti' = (Ri P - Ti)/τi, P ~ thrust^1.5 + losses by switching ~ thrust, τ 0.7, 5
    s; offset = c1 T + c2 T² + c3 (T_chip - T_board) (stress of the package by the gradient).
    Prikhodko, Trusov & Shkel, "Compensation of drifts in MEMS gyros", 2013; Incropera, ch. 5.
    Felt because cheap chips wander by 0.03 rad/s and more within 10 K.
    """

    def __init__(self, strength):
        self.k, self.t1, self.t2 = strength, 1.0, 1.0

    def step(self, s: Situation) -> Change:
        c, a = Change(), s.axis
        near = _side(a)[1]
        p = 0.0
        for n in near:
            x = max(float(s.speed[n]), 0.0)
            p += 0.5 * (0.8 * x ** 1.5 / 0.35355 + 0.2 * x / 0.5)
        self.t1 += s.dt / 0.7 * (p - self.t1)
        self.t2 += s.dt / 5.0 * (p - self.t2)
        t1, t2 = self.t1 - 1.0, self.t2 - 1.0
        t = 0.6 * t1 + 0.4 * t2
        c.gyro[a] = self.k * (0.36 * t + 0.5 * t * t + 0.4 * (t1 - t2))
        return c


EFFECTS = {
    'stranded_cable': (StrandedCable, True),
    'cable_echo': (CableEcho, True),
    'winch_tether': (WinchTether, False),
    'flexible_boom': (FlexibleBoom, False),
    'foam_mounted_gyro': (FoamMountedGyro, True),
    'rattling_gear': (RattlingGear, False),
    'sloshing_tank': (SloshingTank, True),
    'communicating_tanks': (CommunicatingTanks, True),
    'spreader_disc': (SpreaderDisc, False),
    'weak_battery': (WeakBattery, False),
    'corroded_plug': (CorrodedPlug, True),
    'warm_gyro': (WarmGyro, False),
}

FAMILIES = {
    'cables, hoses and tethers': ('stranded_cable', 'cable_echo', 'winch_tether'),
    'structures': ('flexible_boom', 'foam_mounted_gyro', 'rattling_gear'),
    'carried loads, liquids and payloads': (
        'sloshing_tank', 'communicating_tanks', 'spreader_disc',
    ),
    'batteries, wiring and heat': ('weak_battery', 'corroded_plug', 'warm_gyro'),
}
MAY_BE = {
    'stranded_cable': ('coulomb_friction', 'pendulum_stiffness', 'cubic_stiffness'),
    'winch_tether': ('pendulum_stiffness',),
    'flexible_boom': ('resonance',),
    'foam_mounted_gyro': ('resonance',),
    'sloshing_tank': ('pendulum_stiffness', 'resonance'),
    'communicating_tanks': ('pendulum_stiffness',),
    'spreader_disc': ('gyroscopic_coupling', 'periodic_disturbance'),
    'weak_battery': ('battery_sag', 'thrust_curve'),
    'corroded_plug': ('thrust_curve',),
}
"""Names of the table that are no lie: what the effect contains, or cannot be told from."""
