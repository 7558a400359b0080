"""Twelve effects on a quadrotor's attitude axis, in their everyday form: three each of cables and
hanging loads, of structures and fasteners, of propulsion and power, and of flight-control software.

Every class is deterministic, keeps its state in itself and is called once per millisecond. Torques
are angular accelerations (rad/s²), i.e. already divided by the moment of inertia. The numbers belong to an
aircraft of about 1.2 kg with 0.012 kg m² about roll or pitch; `strength` 1.0 is the ordinary case.
"""
import math

import numpy as np
from outside_simulator import Change, Situation

G = 9.81
MASS = 1.2
INERTIA = 0.012


# ------------------------------------------------------------------ cables, tethers, slings, loads
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


# --------------------------------------------------------------------------- structures, fasteners
class SlidingBattery:
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


class ShockDamper:
    """A small oil and gas shock absorber between the rig's arm and its base, as sold for model cars.

    Oil passes a laminar leak beside the piston and sharp-edged holes in it, in parallel; the flap valve closes
    part of the holes on rebound. The rod end is a rubber bushing of stiffness k in series:
        F' = k (φ' − v),     v = F/c + C± √|F| sgn F          (C+ for bump, C− for rebound)
        torque = −F − F_g [ (1 − φ/φ_0)^(−1.3) − 1 ]           (gas behind the oil, polytropic)
    so that it is weak and quadratic when slow, linear when fast, uneven to both sides, and a little late. Taken by
    backward Euler, which has a closed form here.
    Source: Dixon, The Shock Absorber Handbook (2nd ed., ch. 6-7); Segel & Lang, Vehicle System Dynamics 10 (1981).
    Felt: it is there to be felt, and never gives the viscous damping on its label.
    """

    BUSH, LEAK, BUMP, REBOUND = 60.0, 6.0, 0.60, 0.12
    GAS, STROKE = 0.9, 0.8

    def __init__(self, strength):
        self.strength = strength
        self.force = 0.0

    def step(self, s: Situation) -> Change:
        c = Change()
        i = s.axis
        phi, p = float(s.angle[i]), float(s.rate[i])
        dk = s.dt * self.BUSH
        right = self.force + dk * p
        hole = dk * (self.BUMP if right > 0.0 else self.REBOUND)
        lead = 1.0 + dk / self.LEAK
        root = (math.sqrt(hole * hole + 4.0 * lead * abs(right)) - hole) / (2.0 * lead)
        self.force = root * root if right > 0.0 else -root * root
        left = max(1.0 - phi / self.STROKE, 0.1)
        c.torque[i] = -self.strength * (self.force + self.GAS * (left ** -1.3 - 1.0))
        return c


class GelPad:
    """The flight controller stands on soft gel dampers: the board rocks on them, and the gyro turns with the board.

        δ'' = −φ'' − ω² δ κ(δ) − ω² z − 2 ζ ω δ'
        z'  = e δ' − z/τ,        κ = 0.6 + 0.4/(1 + |δ|/δ_0) + c (δ/δ_0)²   (softer when moved more, hard when squeezed)
        gyro = δ'
    A resonance at some 8 Hz which falls with amplitude (Payne effect) with the loss of rubber (relaxing branch) rather
    than of oil.
    Source: Harris & Piersol, Shock and Vibration Handbook (isolators, base excitation); Lakes, Viscoelastic Materials
    (standard linear solid); Payne, J. Appl. Polymer Sci. 6 (1962).
    Felt: pads against the propellers' vibration are chosen too soft as a rule; the rate that the board shows overshoots
    that of the frame in each quick manoeuvre, by more than a tenth. Strength is the pads' softness: ω² ~ 1/strength.
    """

    HZ, ZETA, EXTRA, TAU = 8.5, 0.13, 0.35, 0.03
    SOFT, HARD = 0.02, 0.05

    def __init__(self, strength):
        self.w2 = (2.0 * math.pi * self.HZ) ** 2 / strength
        self.loss = 2.0 * self.ZETA * math.sqrt(self.w2)
        self.d = self.slope = self.z = 0.0

    def step(self, s: Situation) -> Change:
        c = Change()
        i, dt = s.axis, s.dt
        d = self.d
        x = abs(d) / self.SOFT
        stiff = 0.6 + 0.4 / (1.0 + x) + self.HARD * x * x
        a = -float(s.acceleration[i]) - self.w2 * (stiff * d + self.z)
        self.slope = (self.slope + dt * a) / (1.0 + dt * self.loss)
        self.d = d + dt * self.slope
        self.z = (self.z + self.EXTRA * dt * self.slope) / (1.0 + dt / self.TAU)
        c.gyro[i] = self.slope
        return c


# ----------------------------------------------------------------------------- propulsion and power
class TiredBattery:
    """An old or cold battery: its voltage sags with the current of all four motors, at once and over seconds; the
    motors' thrust goes with the square of the voltage (no compensation in the regulators).

        I  = I_h · mean( (u_j/0.5)^1.5 ),     V1' = (R1 I − V1)/τ1
        V  = V_rest − R0 I − V1,              thrust factor (of all) = (V/V_h)²
    Thevenin model with one RC branch (slow polarisation); current of a propeller ~ thrust^1.5 (momentum theory). The factor
    is 1 in hover at a rest voltage of 12 V.
    Source: Plett, Battery Management Systems vol. 1 (equivalent circuits); Chen & Rincón-Mora, IEEE Trans. Energy
    Conv. 21 (2006); Leishman, Principles of Helicopter Aerodynamics (power of hover).
    Felt: 25 A through 60 to 100 mΩ is 1.5 to 2.5 V of 12: the same command gives a quarter less torque at high throttle than at low.
    """

    HOVER, R0, R1, TAU = 25.0, 0.060, 0.040, 2.5

    def __init__(self, strength):
        self.r0, self.r1 = self.R0 * strength, self.R1 * strength
        self.ref = 12.0 - (self.r0 + self.r1) * self.HOVER
        self.v1 = self.r1 * self.HOVER

    def step(self, s: Situation) -> Change:
        a, b, c, d = s.speed.tolist()
        amps = 0.25 * self.HOVER * 2.0 ** 1.5 * (
            a * math.sqrt(a) + b * math.sqrt(b) + c * math.sqrt(c) + d * math.sqrt(d))
        self.v1 += s.dt * (self.r1 * amps - self.v1) / self.TAU
        volts = max(s.battery_v - self.r0 * amps - self.v1, 3.0)
        out = Change()
        out.thrust = np.full(4, (volts / self.ref) ** 2)
        return out


class FlapBack:
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


class BadJoint:
    """A poor solder joint or worn bullet connector in the supply of one regulator (motor 0): it drops voltage
    with that motor's own current, and it grows warm, so that its resistance rises within seconds.

        I = I_h (u_0/0.5)^1.5,   R = R_c (1 + α Θ),   Θ' = (R I² R_th − Θ)/τ,   τ = 5 s
        thrust factor of motor 0 = ((V − R I)/V)²
    so the axis gets a moment that goes with about the 2.5th power of that motor's thrust: throttle leaks into it, and
    one direction is weaker than the other.
    Source: Holm, Electric Contacts (constriction resistance, self-heating); Incropera, Fundamentals of Heat and Mass Transfer
    (lumped capacity); Leishman (power ~ thrust^1.5).
    Felt: the standard reason for "it drifts to one corner when I climb".
    """

    HOVER, R, ALPHA, R_TH, TAU = 9.0, 0.018, 0.004, 25.0, 5.0

    def __init__(self, strength):
        self.r = self.R * strength
        self.warm = 0.0

    def step(self, s: Situation) -> Change:
        u = max(float(s.speed[0]), 0.0) / 0.5
        amps = self.HOVER * u * math.sqrt(u)
        r = self.r * (1.0 + self.ALPHA * self.warm)
        self.warm += s.dt * (r * amps * amps * self.R_TH - self.warm) / self.TAU
        left = max(1.0 - r * amps / s.battery_v, 0.2)
        out = Change()
        out.thrust = np.array([left * left, 1.0, 1.0, 1.0])
        return out


# --------------------------------------------------------------------------- flight-control software
class SlewLimit:
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


class HastyBiasEstimator:
    """The attitude filter learns the gyro's bias too eagerly, and trusts an accelerometer that does not feel tilt.

    Mahony's filter; the rate which the software uses and logs is the one less the estimated bias:
        φ̂' = ω − b + k_P e,   b' = −k_I e,   e = f_y/g − φ̂,      gyro = −b
    In free flight the accelerometer shows the rotors' drag only, not the tilt: f_y = d v, v' = g sin φ − d v − d2|v|v; hence
    e is about −φ in quick manoeuvres, and true motion is taken for a bias. The correction fades as the measured
    acceleration departs from 1 g (the usual gate, here smooth): k → k / (1 + ((throttle/0.5 − 1)/0.2)²).
    Source: Mahony, Hamel & Pflimlin, IEEE Trans. Automatic Control 53 (2008); Martin & Salaün, ICRA 2010 (the true role of
    accelerometer feedback in quadrotor control).
    Felt: an integral gain turned up against drift: the rate that is shown sags in each lasting tilt.
    """

    KP, KI, D1, D2 = 0.8, 1.2, 0.35, 0.06

    def __init__(self, strength):
        self.ki = self.KI * strength
        self.phi = self.b = self.v = 0.0

    def step(self, s: Situation) -> Change:
        c = Change()
        i, dt = s.axis, s.dt
        v = self.v
        drag = self.D1 * v + self.D2 * abs(v) * v
        self.v = v + dt * (s.throttle / 0.5 * G * math.sin(float(s.angle[i])) - drag)
        off = (s.throttle / 0.5 - 1.0) / 0.2
        e = (drag / G - self.phi) / (1.0 + off * off)
        self.phi += dt * (float(s.rate[i]) - self.b + self.KP * e)
        self.b -= dt * self.ki * e
        c.gyro[i] = -self.b
        return c


EFFECTS = {
    'swinging_load': (SwingingLoad, False),
    'umbilical_cable': (UmbilicalCable, True),
    'safety_cords': (SafetyCords, True),
    'sliding_battery_again': (SlidingBattery, True),
    'shock_damper': (ShockDamper, True),
    'gel_pad': (GelPad, False),
    'tired_battery': (TiredBattery, False),
    'flap_back_again': (FlapBack, False),
    'bad_joint': (BadJoint, False),
    'slew_limit_again': (SlewLimit, True),
    'coarse_steps': (CoarseSteps, False),
    'hasty_bias_estimator': (HastyBiasEstimator, False),
}

FAMILIES = {
    'cables, tethers, slings and hanging loads': ('swinging_load', 'umbilical_cable', 'safety_cords'),
    'structures and fasteners': ('sliding_battery_again', 'shock_damper', 'gel_pad'),
    'propulsion and power': ('tired_battery', 'flap_back_again', 'bad_joint'),
    'flight-control software': ('slew_limit_again', 'coarse_steps', 'hasty_bias_estimator'),
}

MAY_BE = {
    'swinging_load': ('pendulum_stiffness', 'resonance'),
    'umbilical_cable': ('pendulum_stiffness', 'coulomb_friction'),
    'safety_cords': ('cubic_stiffness', 'pendulum_stiffness'),
    'sliding_battery_again': ('pendulum_stiffness', 'coulomb_friction'),
    'shock_damper': ('quadratic_drag', 'pendulum_stiffness'),
    'gel_pad': ('resonance', 'cubic_stiffness'),
    'tired_battery': ('battery_sag',),
    'bad_joint': ('cross_axis_input', 'battery_sag'),
    'slew_limit_again': ('motor_lag', 'saturation'),
    'coarse_steps': ('dead_zone', 'backlash'),
}
