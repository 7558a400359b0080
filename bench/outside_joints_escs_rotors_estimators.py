"""Twelve physical effects in four families, for a quadrotor's attitude axis or a one-axis rig.

Torques are angular accelerations (rad/s²) of the excited axis. "Thrust" T is the simulator's
`speed` (thrust is proportional to it), so the rotor's angular velocity goes as sqrt(T).
Everything is deterministic; state is in the objects.
"""

from __future__ import annotations

import math

import numpy as np
from outside_simulator import Change, Situation

SIGN = ((1.0, -1.0, -1.0, 1.0), (1.0, 1.0, -1.0, -1.0))
"""Side of each motor for roll and pitch: + lifts with a positive torque."""
HOVER = 0.5
G = 9.81
LAG_S = 0.042


# ------------------------------------------------------------------ tribology


class BallBearingPrerolling:
    """Rolling hysteresis of the rig's preloaded ball bearings on a race that is not round.

    A preloaded ball bearing that only swings to and fro does not slide: at each reversal the balls
    creep through micro-slip in their contacts, and the torque follows a hysteresis loop over ANGLE
    with non-local memory, nearly independent of rate. It is modelled by Maxwell-slip elements:
        dz_j = dθ, |z_j| <= Z_j;    M = -P(θ) Σ W_j z_j / Z_j
    Second term: the preload P is not constant; race waviness and a tilted outer ring make it
    vary with the ball pitch, P = P0 (1 + a cos(n θ + φ)).
    Source: Todd & Johnson, "A model for Coulomb torque hysteresis in ball bearings", Int. J. Mech.
    Sci. 29 (1987); Al-Bender, Lampaert & Swevers, "The generalized Maxwell-slip model", IEEE TAC
    50 (2005); Harris, Rolling Bearing Analysis (waviness).
    Felt: every rig on angular contact bearings swings by fractions of a ball pitch, so it is in
    the pre-rolling range half of the time.
    """

    REACH = (0.008, 0.03, 0.08, 0.18)
    WEIGHT = (0.25, 0.30, 0.25, 0.20)

    def __init__(self, strength: float) -> None:
        self.level = 1.25 * strength
        self.z = [0.0, 0.0, 0.0, 0.0]

    def step(self, s: Situation) -> Change:
        a = s.axis
        move = float(s.rate[a]) * s.dt
        z, m = self.z, 0.0
        for j in range(4):
            reach = self.REACH[j]
            x = z[j] + move
            x = reach if x > reach else max(x, -reach)
            z[j] = x
            m += self.WEIGHT[j] * x / reach
        preload = 1.0 + 0.4 * math.cos(9.0 * float(s.angle[a]) + 0.7)
        change = Change()
        change.torque[a] = -self.level * preload * m
        return change


class GreaseThixotropy:
    """Grease in the rig's joint: shear thinning, with a yield stress, and thixotropic.

    The soap structure λ (1 whole, 0 broken) heals at rest and is broken by shear:
        dλ/dt = a (1 - λ) - b |ω| λ
        M = -λ My (1 - exp(-m |ω|)) sgn ω  -  (c0 + c1 λ) |ω|^n sgn ω,   n = 0.55
    (Moore's kinetics, Herschel-Bulkley flow with Papanastasiou's regularised yield). So the friction
    depends on how much the joint has been moved in the last second.
    Source: Moore, Trans. Brit. Ceramic Soc. 58 (1959); Papanastasiou, J. Rheology 31 (1987);
    Lugt, Grease Lubrication in Rolling Bearings (Wiley 2013), ch. 5; Mewis & Wagner (2009).
    Felt: small rigs use sealed bearings filled with stiff grease; its drag is far more than that of
    the balls, and is not linear damping.
    """

    def __init__(self, strength: float) -> None:
        self.k = 0.8 * strength
        self.whole = 0.7

    def step(self, s: Situation) -> Change:
        w = float(s.rate[s.axis])
        size = abs(w)
        self.whole += s.dt * (1.0 * (1.0 - self.whole) - 5.0 * size * self.whole)
        lam = self.whole
        flow = w / (w * w + 4e-4) ** 0.225
        yielded = math.copysign(1.0 - math.exp(-25.0 * size), w)
        change = Change()
        change.torque[s.axis] = -self.k * (1.7 * lam * yielded + (0.6 + 1.8 * lam) * flow)
        return change


class BushingUnderThrust:
    """Plain bushing of the rig, whose load is what the rotors do not lift; mixed lubrication.

    Bearing load (in weights of the aircraft), with W the weight of aircraft and cradle:
        N = sqrt(P² + (W - t cos θ)² + (t sin θ)²),   t = ΣT / ΣT_hover
    Friction M = -N r μ, with bristles before sliding (LuGre):
        dz/dt = ω - σ |ω| z / g,   g = N [μc + (μs - μc) exp(-(ω/ωs)²)],   ωs = ω0 N
    The Stribeck speed grows with load (constant Hersey number η ω / p), and M = -(σ z + σ1 dz/dt).
    Source: Canudas de Wit, Olsson, Åström & Lischinsky, IEEE TAC 40 (1995); Armstrong-Hélouvry, Dupont
    & Canudas de Wit, Automatica 30 (1994); Hamrock, Fundamentals of Fluid Film Lubrication (Hersey).
    Felt: the throttle relieves the bearing; at 0.42 the axis sticks, at 0.6 it is nearly free.
    """

    STIFF = 450.0

    def __init__(self, strength: float) -> None:
        self.k = 3.6 * strength
        self.z = 0.0

    def step(self, s: Situation) -> Change:
        a = s.axis
        w, angle = float(s.rate[a]), float(s.angle[a])
        m1, m2, m3, m4 = s.speed.tolist()
        t = (m1 + m2 + m3 + m4) / (4.0 * HOVER)
        up, side = 1.30 - t * math.cos(angle), t * math.sin(angle)
        load = math.sqrt(0.01 + up * up + side * side)
        x = w / (0.35 * load)
        g = self.k * load * (0.75 + 0.6 * math.exp(-x * x))
        before = self.z
        self.z = (before + s.dt * w) / (1.0 + s.dt * self.STIFF * abs(w) / max(g, 1e-6))
        change = Change()
        change.torque[a] = -(self.STIFF * self.z + 3.0 * (self.z - before) / s.dt)
        return change


# ------------------------------------------------------------------ motors and controllers


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


# ------------------------------------------------------------------ aerodynamics


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


class DynamicInflow:
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
        roll, pitch = SIGN
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


class SeparatingPlate:
    """A flat fairing (battery tray, fin) in the fan's wind on the rig, whose flow separates and reattaches.

    State x = point of separation (1 attached, 0 at the leading edge), after Goman and Khrabrov:
        α = θ + α0 + ω ℓ/V
        τ1 dx/dt + x = x0(α - τ2 dα/dt),   x0 = 1 / (1 + exp((|α| - α*)/δ))
        C_N = (π/2) sin α (1 + sqrt x)²,     M = -q(θ) S ℓ C_N
    The fan's jet is narrow, thus q(θ) = q0 exp(-((θ - θj)/b)²) (gradient of the wind).
    Source: Goman & Khrabrov, J. Aircraft 31 (1994); Hoerner, Fluid-Dynamic Lift (plates at low Re stall
    at 8 to 12°); Rajaratnam, Turbulent Jets.
    Felt: rigs are tested in front of fans; fairings at Re 3·10⁴ stall within the angles flown here, with
    hysteresis.
    """

    def __init__(self, strength: float) -> None:
        self.k = 2.0 * strength
        self.x = 0.9
        self.smooth = 0.05
        """α behind 12 ms, for its slope"""

    def step(self, s: Situation) -> Change:
        a = s.axis
        angle = float(s.angle[a])
        alpha = angle + 0.05 + 0.025 * float(s.rate[a])
        slope = (alpha - self.smooth) / 0.012
        self.smooth += s.dt * slope
        late = abs(alpha - 0.06 * slope)
        still = 1.0 / (1.0 + math.exp(min((late - 0.15) / 0.025, 60.0)))
        self.x += s.dt * (still - self.x) / 0.13
        wake = 1.0 + math.sqrt(max(self.x, 0.0))
        jet = math.exp(-(((angle - 0.08) / 0.40) ** 2))
        change = Change()
        change.torque[a] = -self.k * jet * 0.5 * math.pi * math.sin(alpha) * wake * wake
        return change


# ------------------------------------------------------------------ sensing


class GelMount:
    """The gyro's board swings on its gel pads and its cable.

    Relative angle φ of the board (viscoelastic gel as standard linear solid, stiffening when pressed):
        φ'' = -dω/dt - ω0² (φ + r z + β φ³) - 2 ζ ω0 φ',    z' = φ' - z/τ
    The gyro shows ω + φ'.
    Source: Rivin, Passive Vibration Isolation (ASME 2003); Lakes, Viscoelastic Materials (Zener
    model); Harris & Piersol, Shock and Vibration Handbook, ch. 30.
    Felt: with pads chosen soft against the propellers' vibration, and a heavy autopilot on them, the
    resonance comes down near the bandwidth of the rate loop: the rates are shown too large and late.
    """

    def __init__(self, strength: float) -> None:
        self.w2 = 43.0**2 / strength
        self.damp = 2.0 * 0.16 * math.sqrt(self.w2)
        self.phi = [0.0, 0.0]
        self.slope = [0.0, 0.0]
        self.z = [0.0, 0.0]

    def step(self, s: Situation) -> Change:
        change = Change()
        for i in range(2):
            phi, slope, z = self.phi[i], self.slope[i], self.z[i]
            pull = self.w2 * (phi + 0.5 * z + 1.5e4 * phi * phi * phi)
            slope = (slope - s.dt * (float(s.acceleration[i]) + pull)) / (1.0 + s.dt * self.damp)
            self.slope[i] = slope
            self.phi[i] = phi + s.dt * slope
            self.z[i] = (z + s.dt * slope) / (1.0 + s.dt / 0.025)
            change.gyro[i] = slope
        return change


class VibrationRectification:
    """Vibration of the rotors, amplified by the board's resonance, turns into a bias of the MEMS gyro.

    Unbalance of rotor i shakes the board with e_i Ω_i²; the board answers with its resonance, and the
    gyro rectifies the square (vibration rectification error):
        A² = (Ω/Ωr)⁴ / ((1 - (Ω/Ωr)²)² + (2 ζ Ω/Ωr)²),   dP_i/dt = (A² - P_i) 2 ζ Ωr
        b = K Σ c_i (P_i - P_hover),    (Ω/Ωr)² = T/T_r
    The rotors are not alike (c_i: balance and distance from the board), so the bias depends on the throttle
    and on each torque; the autopilot's own offset was trimmed in hover.
    Source: Den Hartog, Mechanical Vibrations (unbalance response); IEEE Std 1431-2004 and Weinberg,
    Analog Devices AN (gyro vibration rectification); Capriglione et al., IEEE TIM 2019 (MEMS gyros under vibration).
    Felt: 0.05 to 0.15 rad/s of bias at certain speeds is what logs of badly balanced propellers show.
    """

    HOVERING = 19.8
    """P at T = 0.5"""

    def __init__(self, strength: float) -> None:
        self.k = 0.0045 * strength
        self.p = [self.HOVERING] * 4

    def step(self, s: Situation) -> Change:
        c = (1.0, 0.3, 0.45, 0.8) if s.axis == 0 else (1.0, 0.8, 0.3, 0.45)
        b = -2.55 * self.HOVERING
        for i, v in enumerate(s.speed.tolist()):
            q = v / 0.56
            d = 1.0 - q
            answer = q * q / (d * d + 0.0324 * q)
            self.p[i] += s.dt * (answer - self.p[i]) * 100.0
            b += c[i] * self.p[i]
        change = Change()
        change.gyro[s.axis] = self.k * b
        return change


class MahonyBiasLeak:
    """Attitude filter that takes the accelerometer for the vertical and puts its error into the gyro's bias.

    In free flight the accelerometer does not feel the tilt but only the drag: φ_a = atan(drag/(g t)).
        e = W (φ_a - φ̂),   dφ̂/dt = ω + b + kp e,   db/dt = ki e - b/τb
        dv/dt = g t sin θ - D,   D = v/τ + c v |v|
        W = 1 / (1 + ((|a| - g)/(σ g))²)    (trusts the accelerometer less when it is not 1 g)
    The rate handed on is that of the filter, ω + kp e + b.
    Source: Mahony, Hamel & Pflimlin, "Nonlinear complementary filters on the special orthogonal group", IEEE TAC
    53 (2008); Martin & Salaün, "The true role of accelerometer feedback in quadrotor control", ICRA 2010;
    PX4 attitude_estimator_q.
    Felt: any sustained tilt in hover leaks into the bias within a second, and the rate loop follows it.
    """

    def __init__(self, strength: float) -> None:
        self.k = strength
        self.v = self.tilt = self.bias = 0.0

    def step(self, s: Situation) -> Change:
        a = s.axis
        m1, m2, m3, m4 = s.speed.tolist()
        t = max((m1 + m2 + m3 + m4) / (4.0 * HOVER), 0.1)
        v = self.v
        drag = v / 1.6 + 0.15 * v * abs(v)
        self.v = v + s.dt * (G * t * math.sin(float(s.angle[a])) - drag)
        felt = math.atan(drag / (G * t))
        off = (math.sqrt(t * t + (drag / G) ** 2) - 1.0) / 0.15
        e = (felt - self.tilt) / (1.0 + off * off)
        self.tilt += s.dt * (float(s.rate[a]) + self.bias + 0.8 * self.k * e)
        self.bias += s.dt * (1.1 * self.k * e - self.bias / 6.0)
        change = Change()
        change.gyro[a] = self.bias + 0.8 * self.k * e
        return change


EFFECTS = {
    'ball_bearing_prerolling': (BallBearingPrerolling, True),
    'grease_thixotropy': (GreaseThixotropy, True),
    'bushing_under_thrust': (BushingUnderThrust, True),
    'coasting_esc': (CoastingEsc, False),
    'rpm_governor': (RpmGovernor, False),
    'current_foldback': (CurrentFoldback, False),
    'flapping_in_drift': (FlappingInDrift, False),
    'inflow_in_two_stages': (DynamicInflow, False),
    'separating_plate': (SeparatingPlate, True),
    'gel_mount': (GelMount, False),
    'rectified_unbalance': (VibrationRectification, False),
    'mahony_bias_leak': (MahonyBiasLeak, False),
}
FAMILIES = {
    'tribology': ('ball_bearing_prerolling', 'grease_thixotropy', 'bushing_under_thrust'),
    'motors': ('coasting_esc', 'rpm_governor', 'current_foldback'),
    'aerodynamics': ('flapping_in_drift', 'inflow_in_two_stages', 'separating_plate'),
    'sensing': ('gel_mount', 'rectified_unbalance', 'mahony_bias_leak'),
}
MAY_BE = {
    'ball_bearing_prerolling': ('coulomb_friction',),
    'grease_thixotropy': ('coulomb_friction',),
    'bushing_under_thrust': ('coulomb_friction',),
    'coasting_esc': ('motor_lag', 'saturation'),
    'rpm_governor': ('motor_lag',),
    'current_foldback': ('saturation', 'motor_lag'),
    'separating_plate': ('pendulum_stiffness',),
    'gel_mount': ('resonance',),
}
"""Names of the table that are no lie: what the effect contains, or cannot be told from."""
