"""Twelve effects in four families, for outside_simulator.py."""
from __future__ import annotations

import math

import numpy as np
from outside_simulator import Change, Situation

G = 9.81
LAG = 0.042
SIGNS = ((1.0, -1.0, -1.0, 1.0), (1.0, 1.0, -1.0, -1.0), (1.0, -1.0, 1.0, -1.0))
"""Per axis: the sign with which each of the four motors acts on it (as in MIX)."""
OTHER = (1, 0)
"""The other horizontal axis."""


# ---------------------------------------------------------------------- bearings, gimbals, hinges

class PlainBearingLuGre:
    """Dry plain bush of the rig's axle: LuGre friction with Stribeck dip, under a load that the
    lift relieves.

    z' = w - s0 |w| z / g(w),  g(w) = N [Mc + (Ms - Mc) exp(-(w/ws)^2)], M = -(s0 z + s1
    exp(-(w/wd)^2) z' + c w),  N = (W_frame + W - T)/(W_frame) with the thrust T ~ throttle.
    Source: Canudas de Wit, Olsson, Astrom, Lischinsky, "A new model for control of systems with
    friction", IEEE TAC 40 (1995); normal load as in Armstrong-Helouvry, Dupont, Canudas de Wit,
    Automatica 30 (1994). On a one-axis rig the bush carries frame and aircraft minus lift; its
    friction holds the small angles fast, gives way at the start of each move and is smaller when
    the throttle is high.
    """

    def __init__(self, strength):
        self.k = strength
        self.z = 0.0

    def step(self, s: Situation) -> Change:
        a = s.axis
        w = float(s.rate[a])
        load = max(0.25, (1.6 - s.throttle / 0.5) / 0.6)
        g = self.k * load * (0.9 + 0.5 * math.exp(-(w / 0.12) ** 2))
        s0 = 220.0 * self.k
        r = s0 * abs(w) / g
        h = s.dt
        # exact for constant w, g
        new = self.z + w * h if r * h < 1e-6 else w / r + (self.z - w / r) * math.exp(-r * h)
        zdot = (new - self.z) / h
        self.z = new
        c = Change()
        c.torque[a] = -(s0 * new + 5.0 * self.k * math.exp(-(w / 0.15) ** 2) * zdot + 0.15 * self.k * w)
        return c


class ElastomerHinge:
    """Rubber torsion hinge between rig and aircraft: relaxing (Zener) spring that hardens.

    M = -(k0 th + k3 th^3 + F),  F' = k1 w - F/tau   (standard linear solid, cubic static spring).
    Source: Lakes, "Viscoelastic Materials", ch. 2; Ferry, "Viscoelastic Properties of Polymers";
    cubic shear stiffness of rubber bushes: Nashif, Jones, Henderson, "Vibration Damping".
    Bonded-rubber pivots and wrapped cable looms across the axle are used on rigs because they
    need no bearing: stiff to a quick motion, soft half a second later, stiffer at large angles.
    """

    def __init__(self, strength):
        self.k = strength
        self.f = 0.0

    def step(self, s: Situation) -> Change:
        a = s.axis
        th, w = float(s.angle[a]), float(s.rate[a])
        self.f += s.dt * (5.0 * w - self.f / 0.45)
        c = Change()
        c.torque[a] = -1.5 * self.k * (1.6 * th + 45.0 * th ** 3 + self.f)
        return c


class PayloadHingePlay:
    """Payload (camera) on a hinge with free play beneath the aircraft.

    Relative angle q, play +-d:  q'' = -w' - wp^2 sin(th + q) - M/Jp, M/Jp = wc^2 dz(q) + [2 zc wc
    in contact] q' + 2 z0 wc q',  dz(q) = q - clip(q, -d, d); torque on the aircraft + mu M/Jp, mu
    = Jp/J.
    Source: dead-zone compliance of Nordin and Gutman, "Controlling mechanical systems with
    backlash - a survey", Automatica 38 (2002); pendulum with mount: Den Hartog, "Mechanical
    Vibrations". A worn camera gimbal hangs freely within its play and is carried along only in
    contact: the aircraft's inertia changes between with and without payload, with a knock that is
    softened by the hinge's rubber.
    """

    def __init__(self, strength):
        self.mu = 0.18 * strength
        self.q = self.v = 0.0

    def step(self, s: Situation) -> Change:
        a = s.axis
        wc, d = 2.0 * math.pi * 6.0, 0.02
        q, v = self.q, self.v
        dz = q - d if q > d else (q + d if q < -d else 0.0)
        moment = wc * wc * dz + (2.0 * (0.22 if dz else 0.0) + 2.0 * 0.03) * wc * v
        swing = 3.5 ** 2 * math.sin(float(s.angle[a]) + q)
        self.v = v + s.dt * (-float(s.acceleration[a]) - swing - moment)
        self.q = q + s.dt * self.v
        c = Change()
        c.torque[a] = self.mu * moment
        return c


# ---------------------------------------------------------------------- speed controllers and motors

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
        sign = SIGNS[s.axis]
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
        yaw = SIGNS[2]
        drag = react = 0.0
        for i in range(4):
            u = spd[i]
            drag += yaw[i] * u * (1.0 + 0.5 * (u - 0.5) / 0.5)
            react += yaw[i] * (cmd[i] - u) / LAG
        c = Change()
        c.torque[s.axis] = self.k * (9.0 * drag + 0.35 * react)
        return c


# ---------------------------------------------------------------------- wake, ground, wall, body

class GroundEffectTilt:
    """Rig low above its table: each rotor has its own height, the low side lifts more; fountain
    on the belly.

    T_i/T = 1 + s [1/(1 - (R/4 z_i)^2) - 1],  z_i = z0 + y_i L sin(th); fountain of the four wakes
    under the belly, of lift K T (R/z0)^2, which a tilt th shifts to the high side by f L sin(th).
    Source: Cheeseman, Bennett, ARC R&M 3021 (1955); body fountain: Sanchez-Cuenca, Perez, Ollero,
    Heredia, "Characterization of the aerodynamic ground effect and its influence in multirotor
    control", Int. J. Aerospace Eng. 2017. At 1.5 radii above a table, common on desk rigs, a tilt
    by a quarter of a radian makes a percent of lift between sides, in proportion to the motors'
    own thrust, stiffer than linear.
    """

    def __init__(self, strength):
        self.k = strength

    def step(self, s: Situation) -> Change:
        a = s.axis
        sign = SIGNS[a]
        sine = math.sin(float(s.angle[a]))
        rise = 0.125 * sine
        factor = [1.0] * 4
        for i in range(4):
            z = max(0.05, 0.185 + sign[i] * rise)
            factor[i] = 1.0 + self.k * (1.0 / (1.0 - (0.127 / (4.0 * z)) ** 2) - 1.0)
        c = Change()
        c.thrust = np.array(factor)
        c.torque[a] = self.k * 1.5 * (s.throttle / 0.5) * sine
        return c


class DynamicInflow:
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
        sign = SIGNS[s.axis]
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


# ---------------------------------------------------------------------- inertial sensing and estimation

class TurnedSensorBoard:
    """Sensor board turned about the vertical on its foam pad, and gyro scale that is unlike in
    the two senses.

    shown = R(psi) w (1 + e sign(w))  for the horizontal pair; psi yields a little with the
    throttle (foam squeezed and sheared by the propellers' vibration and lift).
    Source: Titterton, Weston, "Strapdown Inertial Navigation Technology", ch. 4 and 12
    (misalignment, scale-factor asymmetry); Groves, "Principles of GNSS, Inertial, and Multisensor
    Navigation Systems", ch. 4. A board that is stuck on by hand is off by degrees to a dozen:
    pitching is shown as rolling.
    """

    def __init__(self, strength):
        self.k = strength

    def step(self, s: Situation) -> Change:
        a = s.axis
        b = OTHER[a]
        p, q = float(s.rate[a]), float(s.rate[b])
        psi = self.k * 0.26 * (1.0 + 0.8 * (s.throttle - 0.5))
        cos, sin = math.cos(psi), math.sin(psi)
        x, y = cos * p + sin * q, cos * q - sin * p
        c = Change()
        c.gyro[a] = x - p + self.k * 0.06 * abs(x)
        c.gyro[b] = y - q
        return c


class VibrationRectification:
    """Gyro bias from the propellers' vibration (rectification), through the resonance of the
    sensor's mount.

    b' = (B [sum_i e_i A_i^2 - its value in hover, calibrated away] - b)/tau,  A_i = (W_i/W0)^2 /
    sqrt((1 - r^2)^2 + (2 zeta r)^2),  r = W_i/W_n, W^2 ~ u.
    Source: IEEE Std 1431 and 952 (vibration rectification error); amplification: Den Hartog,
    "Mechanical Vibrations"; MEMS: Weinberg, Kourepenis, "Error sources in in-plane silicon
    tuning-fork MEMS gyroscopes", J. MEMS 15 (2006). The unbalance force grows with W^2, and the
    pad's resonance lies a little above the hover's revolutions, so the zero of the gyro wanders
    with the throttle, and with the one motor whose propeller is the worst.
    """

    def __init__(self, strength):
        self.k = strength
        self.b = 0.0

    def step(self, s: Situation) -> Change:
        total = 0.0
        for u, e in zip(s.speed.tolist(), (0.5, 0.1, 0.15, 0.25)):
            u = max(u, 0.0)
            r2 = u / 0.75
            total += e * (u / 0.5) ** 2 / ((1.0 - r2) ** 2 + 0.16 * r2)
        self.b += s.dt / 0.03 * (0.26 * (total / 4.59 - 1.0) - self.b)
        c = Change()
        c.gyro[s.axis] = self.k * self.b
        return c


class ComplementaryFilterFeedback:
    """The rate that is shown is the corrected one of a Mahony filter, whose accelerometer does
    not see the tilt.

    e = th_acc - th^,  b' = kI e,  shown = w + kP e + b,  th^' = shown; accelerometer of a
    multirotor: th_acc = (D/m)/g with v' = g tan(th) - D/m, D/m = c v + c2 v|v|.
    Source: Mahony, Hamel, Pflimlin, "Nonlinear complementary filters on the special orthogonal
    group", IEEE TAC 53 (2008); Leishman, Saunders, McLain, Beard, "Quadrotors and
    accelerometers", IEEE CSM 34 (2014). In free flight the accelerometer shows drag only: soon
    after tilting it says 'level', and the filter draws the rate towards that error, then the
    other way when speed and drag have grown.
    """

    def __init__(self, strength):
        self.kp, self.ki = 1.0 * strength, 0.12 * strength
        self.th = self.b = self.v = 0.0

    def step(self, s: Situation) -> Change:
        a = s.axis
        v = self.v
        drag = 0.5 * v + 0.08 * v * abs(v)
        e = drag / G - self.th
        self.b += s.dt * self.ki * e
        extra = self.kp * e + self.b
        self.th += s.dt * (float(s.rate[a]) + extra)
        self.v = v + s.dt * (G * math.tan(float(s.angle[a])) - drag)
        c = Change()
        c.gyro[a] = extra
        return c


EFFECTS = {
    'plain_bearing_lugre': (PlainBearingLuGre, True),
    'elastomer_hinge': (ElastomerHinge, True),
    'payload_hinge_play': (PayloadHingePlay, False),
    'mixed_esc_braking': (MixedEscBraking, False),
    'esc_anti_jitter': (EscAntiJitter, True),
    'twisted_motor_mounts': (TwistedMotorMounts, False),
    'ground_effect_tilt': (GroundEffectTilt, True),
    'inflow_overshoot': (DynamicInflow, True),
    'blowback_in_translation': (BlowbackInTranslation, False),
    'turned_sensor_board': (TurnedSensorBoard, False),
    'vibration_rectification': (VibrationRectification, True),
    'complementary_filter_feedback': (ComplementaryFilterFeedback, False),
}
FAMILIES = {
    'bearings, gimbals and hinges': ('plain_bearing_lugre', 'elastomer_hinge', 'payload_hinge_play'),
    'speed controllers and motors': ('mixed_esc_braking', 'esc_anti_jitter', 'twisted_motor_mounts'),
    'wake, ground, wall and body': ('ground_effect_tilt', 'inflow_overshoot', 'blowback_in_translation'),
    'inertial sensing and estimation': ('turned_sensor_board', 'vibration_rectification', 'complementary_filter_feedback'),
}
MAY_BE = {
    'plain_bearing_lugre': ('coulomb_friction',),
    'elastomer_hinge': ('pendulum_stiffness', 'cubic_stiffness'),
    'payload_hinge_play': ('pendulum_stiffness', 'resonance'),
    'mixed_esc_braking': ('motor_lag', 'thrust_curve'),
    'esc_anti_jitter': ('backlash',),
    'twisted_motor_mounts': ('cross_axis_input', 'thrust_curve'),
    'turned_sensor_board': ('cross_axis_input', 'gyroscopic_coupling'),
    'complementary_filter_feedback': ('pendulum_stiffness',),
}
"""Names of the table that are no lie: what the effect contains, or cannot be told from."""
