"""Twelve physical effects on the attitude axis of a quadrotor, three in each of four families:
friction and play of a rig, electric motors and their controllers, aerodynamics, sensing.

Torques are angular accelerations in rad/s² (divided by the inertia of the axis). Where a speed of a
motor is meant, it is sqrt(thrust), so that 1.0 is the speed at full command and 0.707 that in hover.
Every effect is deterministic and holds its state in its object.
"""
import math

import numpy as np
from outside_simulator import Change, Situation

G = 9.81
LAG = 0.042
FADE = math.exp(-0.001 / LAG)
SIGNS = ((1.0, -1.0, -1.0, 1.0), (1.0, 1.0, -1.0, -1.0))
"""Side of the roll and of the pitch axis on which each motor sits."""


def _command_for(wanted, speed):
    """The commands (4,) that make the simulator's lag deliver `wanted` at the end of this millisecond."""
    k = 1.0 / (1.0 - FADE)
    return np.array([(w - FADE * v) * k for w, v in zip(wanted, speed)])


# ---------------------------------------------------------------- friction and play of a rig


class LoadedBearing:
    """Rolling bearings of the gimbal axis: LuGre friction with a Stribeck dip and a load.

    z' = w - s0 |w| z / g(w),  g(w) = N [Fc + (Fs - Fc) exp(-(w/ws)²)],
    torque = -(s0 z + s1 exp(-(w/wd)²) z'),  N = (W - T) / (W - T_hover).
    z is the mean deflection of the asperities; N is the radial load of the bearing, weight of the
    rig's moving part less the lift of the rotors, so that the friction falls as the throttle rises.
    Canudas de Wit, Olsson, Åström, Lischinsky, "A new model for control of systems with friction",
    IEEE Trans. Autom. Control 40 (1995); Armstrong-Hélouvry, Dupont, Canudas de Wit, Automatica 30
    (1994), for Stribeck curve and load. A rig's bearings are greased, sealed and turn to and fro at less
    than a rad/s: they spend the flight about the reversal, where friction is not viscous.
    """

    def __init__(self, strength):
        self.fc, self.fs = 0.78 * strength, 1.25 * strength
        self.s0, self.s1 = 170.0 * strength, 3.0 * strength
        self.z = 0.0

    def step(self, s: Situation) -> Change:
        change = Change()
        w = float(s.rate[s.axis])
        lift = float(s.speed.sum()) * 0.5  # in units of the weight of the aircraft, 1 in hover
        load = max((1.6 - lift) / 0.6, 0.15)
        g = load * (self.fc + (self.fs - self.fc) * math.exp(-((w / 0.12) ** 2)))
        pace = abs(w) * self.s0 / g
        end = math.copysign(g / self.s0, w)
        z = end + (self.z - end) * math.exp(-pace * s.dt)
        slope = (z - self.z) / s.dt
        self.z = z
        change.torque[s.axis] = -(self.s0 * z + self.s1 * math.exp(-((w / 0.25) ** 2)) * slope)
        return change


class GearPlay:
    """Backlash of the gear to the angle sensor's drum (with its trim weight) on the rig.

    The drum (inertia m relative to the axis) is driven through teeth with a play of ±a:
    contact torque F = k dz(D) + c D' where teeth touch, zero in the gap and never pulling,
    D = angle - drum angle, dz(D) = D -+ a outside ±a;  m w2' = F - b w2 - f tanh(w2/w0);
    the axis feels -F. Nordin & Gutman, "Controlling mechanical systems with backlash - a survey",
    Automatica 38 (2002), eq. of the dead zone with damping. At each reversal the axis
    runs free for a moment, then picks up the drum with its inertia and its drag.
    """

    def __init__(self, strength):
        self.m = 0.13 * strength
        self.k, self.c = 250.0 * strength, 3.0 * strength
        self.b, self.f = 0.5 * strength, 0.4 * strength
        self.half = 0.035
        self.angle, self.rate = 0.0, 0.0

    def step(self, s: Situation) -> Change:
        change = Change()
        a = s.axis
        d = float(s.angle[a]) - self.angle
        slip = float(s.rate[a]) - self.rate
        force = 0.0
        if d > self.half:
            force = max(self.k * (d - self.half) + self.c * slip, 0.0)
        elif d < -self.half:
            force = min(self.k * (d + self.half) + self.c * slip, 0.0)
        drag = self.b * self.rate + self.f * math.tanh(self.rate / 0.03)
        self.rate += s.dt * (force - drag) / self.m
        self.angle += s.dt * self.rate
        change.torque[a] = -force
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


# ---------------------------------------------------------------- motors and their controllers


class CoastingController:
    """Speed controllers without active braking: the bridge drives, but its diodes never let current flow back.

    w' = e max(u - w, 0) - q w²,  u = sqrt(c) + (q/e) c,  thrust = w².
    (J w' = Kt i - kQ w², i = (d V - Ke w)/R, i >= 0; u is the voltage that holds the speed for the command c.)
    Upwards the motor follows with its electromechanical time constant 1/(e + 2 q w), downwards not faster than
    the drag of its propeller slows it: 2 q w³. Hughes & Drury, "Electric Motors and Drives" (chopper in the first
    quadrant); BLHeli manual, "damped light". Felt whenever a motor must give up more than a few per cent of thrust:
    one side rises at once, the other sinks late, so the torque also depends on the sign of the change.
    """

    def __init__(self, strength):
        self.q = 0.75 / strength
        self.e = 1.0 / LAG - 2.0 * self.q * math.sqrt(0.5)
        self.w = [math.sqrt(0.5)] * 4

    def step(self, s: Situation) -> Change:
        change = Change()
        q, e, h = self.q, self.e, s.dt
        w = self.w
        for i, c in enumerate(s.command.tolist()):
            c = max(c, 0.0)
            over = math.sqrt(c) + q / e * c - w[i]
            drive = e * over if over > 0.0 else 0.0
            w[i] = max(w[i] + h * (drive - q * w[i] * w[i]), 0.02)
        change.command = _command_for([v * v for v in w], s.speed.tolist())
        return change


class SpeedGovernor:
    """Controllers that hold the speed by PI, with a limited current: overshoot of the thrust.

    e = sqrt(c) - w,  i = imax tanh[(kp e + x)/imax],  x' = ki e - kb (kp e + x - i),
    w' = i - q w²,  thrust = w².
    Linear about hover: s² + (kp + 2 q w) s + ki, well damped, but its zero at -ki/kp lies before its poles, so it overshoots. Åström & Hägglund,
    "PID Controllers" (PI of a lag, anti-windup by back-calculation); Krishnan, "Electric Motor Drives" (speed loop
    about a current loop). The governor is tuned for a steady speed with its integral in front, as in helicopter
    mode; a change of command comes out as an overshoot that is paid back, instead of as a lag.
    """

    def __init__(self, strength):
        self.ki, self.kp = 320.0 * strength, 26.0
        self.q, self.imax = 3.0, 6.0
        self.w = [math.sqrt(0.5)] * 4
        self.x = [self._needed()] * 4

    def _needed(self):
        """Integral that holds hover."""
        return self.imax * math.atanh(self.q * 0.5 / self.imax)

    def step(self, s: Situation) -> Change:
        change = Change()
        h, w, x, top = s.dt, self.w, self.x, self.imax
        for k, c in enumerate(s.command.tolist()):
            e = math.sqrt(max(c, 0.0)) - w[k]
            asked = self.kp * e + x[k]
            i = top * math.tanh(asked / top)
            x[k] += h * (self.ki * e - 10.0 * (asked - i))
            w[k] = max(w[k] + h * (i - self.q * w[k] * w[k]), 0.02)
        change.command = _command_for([v * v for v in w], s.speed.tolist())
        return change


class HotWinding:
    """Copper that grows hot and resists: one motor with a blocked vent loses thrust as it has just worked.

    C D' = P (i/i0)² (1 + al D) - (w/w0)^0.8 D / Rth   (D: rise of the winding's temperature, per motor; i ~ thrust),
    u = w + r (1 + al D) w²  with u the voltage that would give the commanded speed when cold, thrust = w².
    al = 0.0039 1/K. The heat goes with the square of the current and of the resistance that it raised itself, the
    cooling with the air of the propeller. Krishnan, "Electric Motor Drives", ch. thermal; Incropera, "Heat and Mass
    Transfer" (h ~ Re^0.8). A winding of some grams follows in about 3 s; the motors differ in their ventilation, so
    that each change of throttle comes back seconds later as a torque about roll and pitch.
    """

    RISE = (62.0, 18.0, 22.0, 14.0)
    """K in hover at strength 1."""

    def __init__(self, strength):
        self.hover = [v * strength for v in self.RISE]
        self.d = [0.3 * v for v in self.hover]
        self.tau, self.r, self.al = 2.6, 0.34, 0.0039

    def step(self, s: Situation) -> Change:
        change = Change()
        factors = []
        for k, thrust in enumerate(s.speed.tolist()):
            thrust = max(thrust, 0.01)
            w = math.sqrt(thrust)
            d, al = self.d[k], self.al
            rise = self.hover[k] * 4.0 * thrust * thrust * (1.0 + al * d) / (1.0 + al * self.hover[k])
            self.d[k] = d + s.dt / self.tau * (rise - (w / 0.7071) ** 0.8 * d)
            u = w + self.r * thrust
            r = self.r * (1.0 + al * self.d[k])
            real = 2.0 * u / (1.0 + math.sqrt(1.0 + 4.0 * r * u))
            factors.append(real * real / thrust)
        change.thrust = np.array(factors)
        return change


# ---------------------------------------------------------------- aerodynamics


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


class GroundCushion:
    """Rig low over its table: each rotor gains lift by the table, the lower ones more, all with a lag.

    T/T0 = 1/(1 - (R/4z)² - R² z/(d² + 4z²)^1.5 - (R²/2) z/(2d² + 4z²)^1.5 - 2 Kb R² z/(b² + 4z²)^1.5),
    z = h + l sin(angle) for each rotor; the gain follows with 0.1 s, as the cushion builds up.
    First term by Cheeseman & Bennett, ARC R&M 3021 (1955); the neighbours' and the body's fountain by Sanchez-Cuevas,
    Heredia, Ollero, "Characterization of the aerodynamic ground effect and its influence in multirotor control",
    Int. J. Aerosp. Eng. 2017. Restoring, not linear in the angle, proportional to thrust; on a table or in landing every
    quadrotor has it.
    """

    R, HEIGHT, ARM, D, B, KB = 0.127, 0.26, 0.16, 0.226, 0.32, 0.6

    def __init__(self, strength):
        self.strength = strength
        self.gain = [self._steady(self.HEIGHT)] * 4

    def _steady(self, z):
        r2 = self.R * self.R
        z2 = 4.0 * z * z
        loss = (r2 / (4.0 * z2) + r2 * z / (self.D**2 + z2) ** 1.5
                + 0.5 * r2 * z / (2.0 * self.D**2 + z2) ** 1.5
                + 2.0 * self.KB * r2 * z / (self.B**2 + z2) ** 1.5)
        return self.strength * (1.0 / (1.0 - min(loss, 0.5)) - 1.0)

    def step(self, s: Situation) -> Change:
        change = Change()
        roll, pitch = math.sin(s.angle[0]) * self.ARM * 0.7071, math.sin(s.angle[1]) * self.ARM * 0.7071
        part = s.dt / 0.1
        for i in range(4):
            z = max(self.HEIGHT + SIGNS[0][i] * roll + SIGNS[1][i] * pitch, 0.07)
            self.gain[i] += part * (self._steady(z) - self.gain[i])
        change.thrust = np.array([1.0 + v for v in self.gain])
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
            through = v + climb + SIGNS[0][i] * p + SIGNS[1][i] * q
            f = 1.0 - self.x * (through / (vh * math.sqrt(rel)) - 1.0)
            f = max(min(f, 1.6), 0.4)
            self.v[i] = max(v + h / self.MASS * (vh * vh * rel * f - v * abs(through)), 0.2)
            factors.append(f)
            total += rel * f
        level = math.cos(s.angle[0]) * math.cos(s.angle[1])
        self.climb = climb + h * (G * (0.25 * total * level - 1.0) - 0.06 * abs(climb) * climb)
        change.thrust = np.array(factors)
        return change


# ---------------------------------------------------------------- sensing


class SoftMount:
    """Sensor board on foam: it swings against the frame, and the gyro tells of the board.

    y'' = -2 z w0 y' - w0² (y + n y³) - frame's acceleration;  gyro error = y'   (y: angle of board against frame).
    Foam of a board with its cables: some 8 Hz, a damping of 0.2, stiffer when it is squeezed. Den Hartog, "Mechanical
    Vibrations", ch. 2 (base excitation); Harris' Shock and Vibration Handbook (foam isolators). Below its resonance the
    board overshoots each change of rate, at the resonance it rings on.
    """

    def __init__(self, strength):
        self.w0 = 2.0 * math.pi * 8.5 / math.sqrt(strength)
        self.z, self.n = 0.22, 600.0
        self.y, self.u = 0.0, 0.0

    def step(self, s: Situation) -> Change:
        change = Change()
        y, w0 = self.y, self.w0
        pull = w0 * w0 * y * (1.0 + self.n * y * y) + float(s.acceleration[s.axis])
        self.u = (self.u - s.dt * pull) / (1.0 + 2.0 * self.z * w0 * s.dt)
        self.y = y + s.dt * self.u
        change.gyro[s.axis] = self.u
        return change


class BiasEstimator:
    """The estimator's bias of the gyro, learned from an accelerometer that does not see the tilt in flight.

    e = f/g - E,  E' = w - b + kp e,  b' = -ki e,  the rate handed on is w - b;
    f = D v + r w'   (specific force along the tilt: drag, and lever arm of the sensor),  v' = g sin(angle) - D v.
    Mahony, Hamel, Pflimlin, "Nonlinear complementary filters on SO(3)", IEEE TAC 53 (2008), in one axis;
    Martin & Salaün, "The true role of accelerometer feedback in quadrotor control", ICRA 2010: a flying
    quadrotor's accelerometer shows drag and not gravity's component. So each tilt is taken for a drift of
    the gyro; with the gains of a hobby filter set for quick convergence the bias wanders by 0.1 rad/s.
    """

    def __init__(self, strength):
        self.ki, self.kp = 0.95 * strength, 1.3
        self.lever, self.drag = 0.05, 0.4
        self.v, self.e, self.b = [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]

    def step(self, s: Situation) -> Change:
        change = Change()
        for a in (0, 1):
            pull = self.drag * self.v[a]
            self.v[a] += s.dt * (G * math.sin(s.angle[a]) - pull)
            wrong = (pull + self.lever * float(s.acceleration[a])) / G - self.e[a]
            self.e[a] += s.dt * (float(s.rate[a]) - self.b[a] + self.kp * wrong)
            self.b[a] -= s.dt * self.ki * wrong
            change.gyro[a] = -self.b[a]
        return change


class VibrationRectified:
    """Gyro whose zero shifts with the square of the vibration from unbalanced propellers.

    error = K sum A_i,  ta A_i' = (m_i n_i²)² / ((1 - (n_i/nr)²)² + (n_i/(Q nr))²) - A_i,
    n_i = sqrt(thrust_i / hover): speed of motor i; nr: resonance of the frame, above hover; A: squared amplitude at the
    sensor, which follows within ta = Q/(pi f).
    IEEE Std 1431 / 1554 (vibration rectification); Analog Devices, AN "MEMS gyro vibration rectification"; Den Hartog,
    ch. 2 (rotating unbalance). The sensing element is slightly asymmetric, so that a vibration of zero mean leaves a constant;
    it grows steeply as the propellers come near to the frame's resonance, hence with throttle and with each command of the worst motor.
    """

    UNBALANCE = (1.0, 0.35, 0.25, 0.4)

    def __init__(self, strength):
        self.k = 0.0085 * strength
        self.m2 = [m * m for m in self.UNBALANCE]
        self.nr, self.q, self.ta = 1.16, 4.0, 0.016
        self.a = [0.0] * 4

    def step(self, s: Situation) -> Change:
        change = Change()
        r2 = self.nr * self.nr
        total, part = 0.0, s.dt / self.ta
        for i, thrust in enumerate(s.speed.tolist()):
            n2 = 2.0 * max(thrust, 0.0)
            x = n2 / r2
            steady = self.m2[i] * n2 * n2 / ((1.0 - x) ** 2 + x / (self.q * self.q))
            self.a[i] += part * (steady - self.a[i])
            total += self.a[i]
        change.gyro[s.axis] = self.k * total
        return change


EFFECTS = {
    'loaded_bearing': (LoadedBearing, True),
    'gear_play': (GearPlay, True),
    'cable_twist': (CableTwist, True),
    'coasting_controller': (CoastingController, True),
    'speed_governor': (SpeedGovernor, False),
    'hot_winding': (HotWinding, False),
    'flap_back': (FlapBack, False),
    'ground_cushion': (GroundCushion, True),
    'climb_inflow': (ClimbInflow, False),
    'soft_mount': (SoftMount, True),
    'bias_estimator_again': (BiasEstimator, False),
    'vibration_rectified': (VibrationRectified, True),
}
FAMILIES = {
    'friction': ('loaded_bearing', 'gear_play', 'cable_twist'),
    'motors': ('coasting_controller', 'speed_governor', 'hot_winding'),
    'aerodynamics': ('flap_back', 'ground_cushion', 'climb_inflow'),
    'sensing': ('soft_mount', 'bias_estimator_again', 'vibration_rectified'),
}

MAY_BE = {
    'loaded_bearing': ('coulomb_friction',),
    'gear_play': ('backlash', 'coulomb_friction'),
    'cable_twist': ('pendulum_stiffness', 'coulomb_friction'),
    'coasting_controller': ('motor_lag', 'saturation'),
    'speed_governor': ('saturation',),
    'hot_winding': ('cross_axis_input',),
    'ground_cushion': ('pendulum_stiffness', 'cubic_stiffness'),
    'soft_mount': ('resonance', 'cubic_stiffness'),
    'vibration_rectified': ('resonance',),
}
