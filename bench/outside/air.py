"""The air around: ground, walls, wind, and the drag and lift of the body."""

from __future__ import annotations

import math

import numpy as np

from .simulator import GAIN_OF, HOVER, INERTIA, MASS, SIDE, Change, G, Plant, Situation


class GuardDragInOwnWake:
    """Propeller guards and arms beat the air as they turn: quadratic drag on the motion relative
    to air they have dragged along.

        d = w - w_air,   dw_air/dt = (w - w_air)/T_w,   T_w = 0.3 s
        torque = -c d sqrt(d^2 + w_s^2),   w_s = 0.25 sqrt(T/0.5)
    (normal force ~ normal speed times total speed: the slipstream's speed along the plates adds
    to it, in rad/s at the guards' radius.) Returning before the wake has decayed meets air coming
    the other way.
    Sources: Hoerner, 'Fluid-Dynamic Drag' ch. 3 (cross-flow principle); Sarpkaya & Isaacson,
    'Mechanics of Wave Forces on Offshore Structures' (wake encounter of oscillating bodies).
    Felt: with shrouds or foam guards on a light frame, rates of 1-2 rad/s meet several rad/s2 of
    drag.
    """

    def __init__(self, strength):
        self.k = strength
        self.air = 0.0

    def step(self, s: Situation) -> Change:
        a, b, c, d = s.speed.tolist()
        w = float(s.rate[s.axis])
        r = w - self.air
        self.air += s.dt * r / 0.3
        stream = 0.0625 * max(0.5 * (a + b + c + d), 0.0)
        out = Change()
        out.torque[s.axis] = -self.k * 4.2 * r * math.sqrt(r * r + stream)
        return out


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
        return Change(thrust=np.array([up if m > 0 else down for m in SIDE[s.axis]]))


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
        m = SIDE[s.axis]
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
        sign = SIDE[a]
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
            z = max(self.HEIGHT + SIDE[0][i] * roll + SIDE[1][i] * pitch, 0.07)
            self.gain[i] += part * (self._steady(z) - self.gain[i])
        change.thrust = np.array([1.0 + v for v in self.gain])
        return change


class RoomWashEcho:
    """A rig in a small room: each rotor's wash comes back over floor and wall into its own inflow.

    The wash runs down, along the floor, up the near wall and down again; it arrives after the way
    divided by its speed (which goes with the root of the disc loading), spread by turbulent
    mixing, and raises the inflow of the rotors on that side:
        thrust_i · (1 - κ·m_i),   τ_m·dm_i/dt = thrust_i(t - D)/0.5 - m_i,   D = D0/√(mean/0.5)
    Source: Leishman, Principles of Helicopter Aerodynamics (thrust with axial inflow, recirculation
    near obstructions); Robinson, Chung & Ryan, Computational investigation of micro rotorcraft
    near-wall hovering aerodynamics, ICUAS 2014. Felt here: whoever tests a drone on a stand indoors
    sees thrust fall by a tenth once the air of the room turns over; of a torque an echo comes back.
    """

    SIZE = 1024

    def __init__(self, strength: float) -> None:
        self.share = 0.21 * strength
        self.past = np.full((self.SIZE, 4), 0.5)
        self.k = 0
        self.mixed, self.mean = np.ones(4), 0.5

    def step(self, s: Situation) -> Change:
        self.past[self.k % self.SIZE] = s.speed
        self.mean += s.dt / 0.3 * (s.throttle - self.mean)
        way = 280.0 / math.sqrt(max(self.mean, 0.1) / 0.5)
        whole = int(way)
        part = way - whole
        a = self.past[(self.k - whole) % self.SIZE]
        b = self.past[(self.k - whole - 1) % self.SIZE]
        self.mixed = self.mixed + s.dt / 0.06 * (2.0 * (a + part * (b - a)) - self.mixed)
        self.k += 1
        return Change(thrust=1.0 - self.share * (self.mixed - 0.5))


class LidPlateIncidence:
    """The flat top plate (lid, battery) is a wing in the wind: its lift acts ahead of the middle.

    The normal force on a plate at small incidence acts at the quarter chord, so it turns the
    windward edge further the way it is tilted; towards 90° the centre of pressure moves back:
        torque = ½ρV²·S·c·C_m/J,  C_m ∝ sinα·cosα  (the moment of a plate, also Munk's)
    The incidence is the tilt and the suction of the rotors w_r (∝ √throttle), and the rate adds
    the damping of pitching: V²·sinα·cosα → K·[V²·sin(a)·cos(a) + w_r·v - c·|V|·w]. v is the
    airspeed along the axis' arm from tilt and wind, V its amount together with the breeze across.
    Source: Hoerner, Fluid-Dynamic Lift, ch. XVII (small aspect ratios); Munk, NACA TR 184 (1924);
    Etkin, Dynamics of Flight (pitch damping). Felt here: light hulls of 20 cm in winds of 4-6 m/s;
    an instability that breathes with the wind's square.
    """

    def __init__(self, strength: float) -> None:
        self.k = 0.75 * strength
        self.v = 0.0

    def step(self, s: Situation) -> Change:
        wind = -3.2 + 1.1 * math.sin(0.7 * s.t) + 0.9 * math.sin(1.9 * s.t + 0.7)
        angle = float(s.angle[s.axis])
        self.v += s.dt * (G * math.sin(angle) - (self.v - wind) / 2.0)
        along = self.v - wind
        square = along * along + 4.0
        suction = 0.5 * math.sqrt(max(s.throttle, 0.05) / 0.5)
        change = Change()
        change.torque[s.axis] = self.k * (
            square * math.sin(angle) * math.cos(angle) + suction * along
            - 0.12 * math.sqrt(square) * float(s.rate[s.axis]))
        return change


class RoomWashReturn:
    """In a small laboratory the propellers' wash comes back: tilted jets run along floor and wall
    and arrive, later, from above at the rotors of the side to which they were thrown.

    torque = -c n w,   τ w' = q (1 + β |q|) - w,   q = sin(angle(t - d)),
    d = d0 / √n (jet velocity ~ √thrust), n = thrust / hover's thrust; the plume's share that comes
    back grows with its deflection (β).
    Source: Abramovich, The Theory of Turbulent Jets; transport lag as in Åström & Hägglund.
    Felt here: the rig is in a closed room; a torque follows the angle of a third of a second ago,
    sooner and stronger at high throttle.
    """

    PUSH, DELAY, MIXING, BETA, SIZE = 7.5, 0.24, 0.08, 2.0, 700

    def __init__(self, strength):
        self.push = strength * self.PUSH
        self.past = [0.0] * self.SIZE
        self.k = 0
        self.w = 0.0
        self.n = 1.0

    def step(self, s: Situation) -> Change:
        i = s.axis
        v = s.speed
        n = 0.5 * float(v[0] + v[1] + v[2] + v[3])
        self.n += s.dt / 0.1 * (n - self.n)
        self.past[self.k] = math.sin(float(s.angle[i]))
        back = min(self.SIZE - 3.0, 1000.0 * self.DELAY / math.sqrt(max(0.2, self.n)))
        whole = int(back)
        part = back - whole
        a = self.past[(self.k - whole) % self.SIZE]
        a += part * (self.past[(self.k - whole - 1) % self.SIZE] - a)
        self.k = (self.k + 1) % self.SIZE
        self.w += s.dt / self.MIXING * (a * (1.0 + self.BETA * abs(a)) - self.w)
        out = Change()
        out.torque[i] = -self.push * self.n * self.w
        return out


class GroundCushionAgain:
    """A rig low over the floor: each rotor in its own ground effect, with the fountain between
    them.

    Cheeseman-Bennett per rotor T = T0 / (1 - (R/4z)^2), z = h - r sin(angle): the low side is
    carried more;
    the cushion follows through tau = 0.08 s; the fountain under the hull pushes up
    the risen side, +kf lift^2 sin(angle)/(1 + (sin(angle)/w)^2), and so fights the cushion.
    Cheeseman & Bennett ARC R&M 3021 (1955); Sanchez-Cuevas, Heredia,
    Ollero, Int. J. Aerosp. Eng. 2017.  Felt: a stiffening spring, with delay, soft near level,
    that grows with thrust.
    """

    def __init__(self, strength):
        self.k, self.y = strength, None

    def step(self, s: Situation) -> Change:
        c, i = Change(), s.axis
        lean = math.sin(float(s.angle[i]))
        if self.y is None:
            self.y = [0.0] * 4
        total, sp = 0.0, s.speed.tolist()
        for m in range(4):
            sign = SIDE[i][m]
            z = max(0.125 + 0.16 * sign * lean, 0.06)
            q = (0.125 / (4.0 * z)) ** 2
            self.y[m] += s.dt / 0.08 * (q / (1.0 - q) - self.y[m])
            total += sign * sp[m] * self.y[m]
        lift = 0.5 * sum(sp)
        fountain = 2.0 * lift * lift * 2.0 * lean / (1.0 + (lean / 0.12) ** 2)
        c.torque[i] = self.k * (0.28 * (450.0, 400.0, 60.0)[i] * total / 4.0 + 0.35 * fountain)
        return c


class BenchTopGroundEffect:
    """The rig stands too low: the side that dips has its propellers on a cushion of air.

    A mechanic says: too close to the bench, ground cushion.
    Source: Cheeseman & Bennett, ARC R&M 3021 (1955): T/T0 = 1 / (1 - (R/4z)²), with the height z
    of each propeller at its own place on the tilted frame; the factor of the fountain flow between
    rotors after Sanchez-Cuenca et al., Int. J. Aerosp. Eng. (2017).
    Felt: it floats back to level by itself, as if on a spring.
    """

    FULL_THRUST = MASS * G / (4.0 * HOVER)
    """N of one motor at command 1."""
    ARM = INERTIA * GAIN_OF[0] / (4.0 * FULL_THRUST)
    """m, lateral distance of a motor from the axis, 0.23: a unit of roll command is four motors at
    full thrust on it, and INERTIA * 450 rad/s² of torque."""
    TILT = np.array(SIDE[:2])
    """(axis, motor): +1 where a motor rises with the angle."""

    def __init__(self, strength: float) -> None:
        self.radius = 0.12  # m
        self.height = 0.19  # m of the rotor plane over the bench
        self.fountain = 1.05 * strength

    def step(self, s: Situation) -> Change:
        z = self.height + self.ARM * (np.sin(s.angle[:2]) @ self.TILT)
        z = np.maximum(z, 0.6 * self.radius)
        gain = 1.0 / (1.0 - (self.radius / (4.0 * z)) ** 2) - 1.0
        return Change(thrust=1.0 + self.fountain * gain)


class GroundCushionOfLowRig:
    """The rig stands low over the ground: the rotor that comes down gets more thrust.

    A mechanic says: too close to the ground, it floats on its air cushion.

    Ground effect (Cheeseman & Bennett 1955, ARC R&M 3021): T/T∞ = 1/(1 - (R/4z)²), at the height
    z of each rotor's own disc; strength 1 is a height of 15 cm under 10-inch propellers. Felt:
    the low arm is pushed up by itself, more lift at the same throttle.
    """

    ARM = 0.16
    """m, from the axis to a motor."""
    PROP_R = 0.127
    """m, a ten-inch propeller."""
    HEIGHT = 0.15
    """m at strength 1."""

    def __init__(self, strength):
        self.height = self.HEIGHT / math.sqrt(strength)

    def step(self, s: Situation) -> Change:
        z = self.height + self.ARM * math.sin(s.angle[s.axis]) * np.array(SIDE[s.axis])
        z = np.maximum(z, 0.5 * self.PROP_R)
        return Change(thrust=1.0 / (1.0 - (self.PROP_R / (4.0 * z)) ** 2))


class WindOnMast:
    """A tall box on the top plate catches the wind and the air stream of the own drift.

    A mechanic says: top-heavy sail, a box on a mast in the wind; it rears up when it gets speed.

    Drag 1/2·rho·Cd·A·V·|V| (Hoerner, Fluid-Dynamic Drag) with its centre of pressure above the
    centre of mass, moment h·D: the speed stability derivative, as a dihedral effect (Etkin).
    The drift follows the tilt: v' = g·a - v/tau, V = v - wind. Felt: a step of tilt is fine at
    first, and as the speed comes the nose is pushed back; upwind it needs constant trim.
    """

    AIR = 1.2
    """kg/m³"""
    AREA, HEIGHT = 0.06, 0.12
    """m² with Cd at strength 1, m."""
    DRIFT_S = 2.0
    WIND, GUST, GUST_S = (-2.5, -2.0), 0.8, 6.5
    """m/s, m/s and s."""

    def __init__(self, strength):
        self.gain = 0.5 * self.AIR * self.AREA * strength * self.HEIGHT / INERTIA
        self.v = np.zeros(2)

    def step(self, s: Situation) -> Change:
        wind = np.array(self.WIND) * (
            1.0 + self.GUST / 2.5 * math.sin(2.0 * math.pi * s.t / self.GUST_S))
        self.v = self.v + s.dt * (G * np.sin(s.angle[:2]) - self.v / self.DRIFT_S)
        air = self.v - wind
        change = Change()
        change.torque[:2] = -self.gain * math.hypot(air[0], air[1]) * air
        return change


PLANTS = (
    Plant('guard_drag_in_own_wake', GuardDragInOwnWake, 'bearings', 8, rig=True,
          may_be=('quadratic_drag',)),
    Plant('table_under_rotors', TableUnderRotors, 'rigs', 3, rig=True),
    Plant('wall_recirculation', WallRecirculation, 'rigs', 4, rig=False),
    Plant('side_wind_airspeed', SideWindAirspeed, 'rigs', 5, rig=False,
          may_be=('periodic_disturbance',)),
    Plant('ground_effect_tilt', GroundEffectTilt, 'hinges', 6, rig=True),
    Plant('separating_plate', SeparatingPlate, 'joints', 8, rig=True,
          may_be=('pendulum_stiffness',)),
    Plant('ground_cushion', GroundCushion, 'gears', 7, rig=True,
          may_be=('pendulum_stiffness', 'cubic_stiffness')),
    Plant('room_wash_echo', RoomWashEcho, 'greases', 6, rig=True),
    Plant('lid_plate_incidence', LidPlateIncidence, 'greases', 8, rig=False,
          may_be=('pendulum_stiffness', 'periodic_disturbance')),
    Plant('room_wash_return', RoomWashReturn, 'chains', 8, rig=True,
          may_be=('pendulum_stiffness',)),
    Plant('ground_cushion_again', GroundCushionAgain, 'governors', 8, rig=True,
          may_be=('pendulum_stiffness', 'cubic_stiffness')),
    Plant('bench_ground_effect', BenchTopGroundEffect, 'workshop', 7, rig=True,
          may_be=('pendulum_stiffness', 'cubic_stiffness', 'ground_effect')),
    Plant('ground_cushion_of_low_rig', GroundCushionOfLowRig, 'field', 3, rig=True,
          may_be=('pendulum_stiffness', 'ground_effect')),
    Plant('wind_on_mast', WindOnMast, 'field', 4, rig=False,
          may_be=('pendulum_stiffness', 'periodic_disturbance')),
)
