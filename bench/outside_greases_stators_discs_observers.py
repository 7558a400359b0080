"""Twelve everyday effects on a quadrotor's attitude axis: three each of rig joints, motors and
their controllers, aerodynamics, and sensing. Torques are angular accelerations, rad/s²."""

import math

import numpy as np
from outside_simulator import Change, Situation

SIGNS = ((1.0, -1.0, -1.0, 1.0), (1.0, 1.0, -1.0, -1.0))
"""Of the four motors' thrusts in the torque about roll and pitch."""
GAINS = (450.0, 400.0)
"""rad/s² per unit of differential command, roll and pitch (the data sheet of this aircraft)."""
G = 9.81


# ---------------------------------------------------------------- joints of the rig


class SludgyGreaseGel:
    """A rig's pivot packed with a soap-thickened grease: a thixotropic yield-stress fluid.

    The soap fibres form a gel (structure q, 0..1) that shearing breaks and that builds up again at
    rest within a second. Houška's model: a Herschel-Bulkley law whose yield and consistency depend
    on the structure,
        torque = -[ q·Y·sat(w) + (K0 + K1·q)·|w|^n·sgn(w) ],   n = 0.6 (shear thinning)
        dq/dt = a·(1 - q) - b·q·|w|
    Source: Houška (1981), Engineering aspects of the rheology of thixotropic liquids; Mewis &
    Wagner, Thixotropy, Adv. Colloid Interface Sci. 147 (2009); Lugt, Grease Lubrication in Rolling
    Bearings (2013), ch. 5. Felt here: a rig pivot swings at below 2 rad/s, so the gel breaks and
    heals within each manoeuvre: it holds after a pause and lets go once it has been moving.
    """

    def __init__(self, strength: float) -> None:
        self.yielding, self.base, self.extra = 1.5 * strength, 0.25 * strength, 0.9 * strength
        self.q = 1.0

    def step(self, s: Situation) -> Change:
        w = float(s.rate[s.axis])
        pace = abs(w)
        self.q += s.dt * (1.2 * (1.0 - self.q) - 6.0 * self.q * pace)
        soft = math.tanh(w / 0.06)
        change = Change()
        change.torque[s.axis] = -soft * (
            self.q * self.yielding + (self.base + self.extra * self.q) * pace**0.6)
        return change


class DentedRaceValleys:
    """A ball bearing of the rig with false-brinelling dents: the balls lie in valleys.

    Balls that shook on the spot during transport have worn shallow dents into the race, here three
    places within the working range. Each is a potential well, U_k = -D_k·exp(-x²/(2·b²)), x the
    angle from the dent, so the shaft feels -dU/dx: pulled in within the valley, free between them.
    The closely conforming contact in a dent also slips (Heathcote slip), which adds friction there:
        torque = -Σ [ A_k·(x/b)·exp(½ - x²/(2b²)) + F·exp(-x²/(2b²))·sat(w) ]
    Source: Harris & Kotzalas, Rolling Bearing Analysis (Heathcote slip; indentations); Godfrey,
    Fretting corrosion or false brinelling?, Tribology & Lubrication Technology (2003). Felt here:
    a torque of the angle, alternating within a few degrees, in a range of ±0.25 rad that covers all
    three valleys.
    """

    DENTS = ((0.02, 1.0), (0.17, 0.75), (-0.14, 0.9))

    def __init__(self, strength: float) -> None:
        self.pull, self.slip = 1.55 * strength, 0.35 * strength

    def step(self, s: Situation) -> Change:
        angle, soft = float(s.angle[s.axis]), math.tanh(float(s.rate[s.axis]) / 0.08)
        torque = 0.0
        for place, depth in self.DENTS:
            x = (angle - place) / 0.045
            bell = depth * math.exp(-0.5 * x * x)
            torque -= self.pull * 1.6487 * x * bell + self.slip * bell * soft
        change = Change()
        change.torque[s.axis] = torque
        return change


class ForkDraggedPot:
    """The rig's angle potentiometer, taken along by a fork with play, and stiff to turn.

    The pin has a free way of ±b in the fork; at its ends it bends elastically (stiffness k) and
    takes the wiper (angle y) along, which holds with its Coulomb friction F and then turns against
    the damping paste c:
        P = k·dz(θ - y, b);   dy/dt = (P - F·sgn P)/c  if |P| > F, else 0;   torque = -P
    (dz: dead zone). After a reversal there is no friction until the play has been crossed.
    Source: Nordin & Gutman, Controlling mechanical systems with backlash - a survey, Automatica 38
    (2002); Olsson et al., Friction models and friction compensation (1998). Felt here: most
    one-axis rigs measure their angle so, and the play is a tenth of the swing of ±0.25 rad.
    """

    def __init__(self, strength: float) -> None:
        self.k, self.hold, self.paste = 130.0 * strength, 1.1 * strength, 0.7 * strength
        self.y = 0.0

    def step(self, s: Situation) -> Change:
        x = float(s.angle[s.axis]) - self.y
        bent = x - 0.025 if x > 0.025 else (x + 0.025 if x < -0.025 else 0.0)
        push = self.k * bent
        if abs(push) > self.hold:
            self.y += s.dt * (push - math.copysign(self.hold, push)) / self.paste
        change = Change()
        change.torque[s.axis] = -push
        return change


# ---------------------------------------------------------------- motors and controllers


class ShadedStatorHeat:
    """The windings of two motors warm up more than the others' (they sit in the canopy's lee).

    The copper loss I²R heats the winding, which gives its heat to the stator and this to the air:
        dT1/dt = P/C1 - (T1 - T2)/τ1,   dT2/dt = (T1 - T2)/τ12 - T2/τ2,   P ∝ thrust²·(1 + α·T1)
    (current is proportional to the torque and so to the thrust; copper's α = 0.39 %/K, T in units of 41 K). The higher
    resistance makes the motor turn more slowly at the same duty: thrust·(1 - β·T1). Only the motors
    of one side are cooled badly, so their loss is a torque that follows the throttle's and their
    own load of the last seconds.
    Source: Hughes & Drury, Electric Motors and Drives, ch. on ratings and thermal time constants;
    Mellor, Roberts & Turner, Lumped parameter thermal model for electrical machines, IEE Proc. B
    138 (1991). Felt here: a per cent of the hover thrust on one side is 1 rad/s² about the axis.
    """

    def __init__(self, strength: float) -> None:
        self.loss = 0.034 * strength
        self.cooling = {0: np.array([1.0, 0.15, 0.1, 0.9]), 1: np.array([1.0, 0.9, 0.1, 0.15])}
        self.hot, self.core = np.full(4, 0.6), np.full(4, 0.25)

    def step(self, s: Situation) -> Change:
        load = 4.0 * s.speed * s.speed * (1.0 + 0.16 * self.hot)
        flow = self.hot - self.core
        self.hot = self.hot + s.dt * (load / 1.6 - flow / 0.7)
        self.core = self.core + s.dt * (flow / 3.0 - self.core / 3.0)
        return Change(thrust=1.0 - self.loss * self.cooling[s.axis] * self.hot)


class TardySectorTiming:
    """A sensorless six-step ESC commutates late while the rotor accelerates.

    It waits half of the *last* sector's duration after each zero crossing; if the speed changes,
    that is wrong by an angle that grows with the relative acceleration, and the freewheeling
    (demagnetisation) spike, which is longer at a high current, hides the crossing besides:
        δ = δ0 + a·(u - n)/n + d·(1 + tanh((u - n)/0.04)),
        torque per ampere ∝ cos δ, so the lag of the speed is τ·cos δ0 / cos δ
    with n the speed, u the command. Spinning up is slowed down, braking (early commutation, which
    acts as timing advance) is not: the lag depends on the direction and on the speed.
    Source: Krishnan, Permanent Magnet Synchronous and Brushless DC Motor Drives, ch. 9-10 (phase
    advance, sensorless commutation); Kim et al., commutation delay in sensorless BLDC drives, IEEE
    Trans. Ind. Electron. Felt here: the attitude loop lives of speed changes within 0.1 s.
    """

    def __init__(self, strength: float) -> None:
        self.a, self.d = 2.2 * strength, 0.45 * strength

    def step(self, s: Situation) -> Change:
        lag = np.empty(4)
        for i in range(4):
            n = float(s.speed[i])
            ahead = float(s.command[i]) - n
            late = self.a * ahead / max(n, 0.15) + self.d * (1.0 + math.tanh(ahead / 0.04))
            late = 1.25 * math.tanh((0.25 + late) / 1.25)
            lag[i] = 0.9689 / math.cos(late)
        return Change(lag=lag)


class BridgeBlankingLoss:
    """Blanking (dead) time and diode drops of the ESC's half bridges eat voltage.

    During the blanking time the diodes decide, so the mean voltage is wrong by Δ = t_d·f_pwm (plus
    the drops) against the current's direction; with a ripple in the current the jump is a smooth
    S around zero current:
        u_eff = u - Δ·tanh(i/i_r) - R_on·i,   i = k·(u - n) + i_load·(n/0.5)²
    Above hover load the loss is constant (a trim); when a motor shall slow down, its current passes
    zero and Δ changes sign, so that the motor brakes less than was asked: a dead zone on one side.
    Source: Mohan, Undeland & Robbins, Power Electronics, §8-5 (effect of blanking time); Jeong &
    Park, The analysis and compensation of dead-time effects in PWM inverters, IEEE Trans. Ind.
    Electron. 38 (1991). Felt here: with 1 µs at 24-48 kHz and small motors Δ is some per cent of
    full duty, and the commands only move by ±5 %.
    """

    def __init__(self, strength: float) -> None:
        self.drop, self.resist = 0.019 * strength, 0.04 * strength

    def step(self, s: Situation) -> Change:
        command = np.empty(4)
        for i in range(4):
            u, n = float(s.command[i]), float(s.speed[i])
            current = (u - n) + 0.035 * (2.0 * n) ** 2
            command[i] = u - self.drop * (math.tanh(current / 0.03) - 0.8) - self.resist * current
        return Change(command=command)


# ---------------------------------------------------------------- aerodynamics


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
        signs = SIGNS[s.axis]
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


# ---------------------------------------------------------------- sensing and estimation


class RectifiedShakeBias:
    """Vibration rectification: the gyro turns the rotors' shaking into a shift of its zero.

    Each rotor's imbalance shakes the board at its turning frequency with a force ∝ speed² (that is
    ∝ thrust); the board on its standoffs has a resonance just above hover speed. The sensor's
    second-order nonlinearity makes of an oscillation of amplitude A a constant ∝ A²:
        bias = k·Σ e_i·(n_i²)·1/((1 - r_i²)² + (2ζr_i)²),  r_i² = n_i/n_res
    and the running mean of A² follows within 40 ms. The standstill zero is calibrated in hover.
    Source: IEEE Std 1293/528 (vibration rectification); Den Hartog, Mechanical Vibrations, ch. 2
    (rotating imbalance); Analog Devices MS-2158 (Weinberg), Gyro mechanical performance. Felt
    here: rotors that are not balanced perfectly, and throttle and attitude commands that move the
    rotors' speeds through the flank of the resonance.
    """

    IMBALANCE = (1.0, 0.45, 0.75, 0.3)

    def __init__(self, strength: float) -> None:
        self.k = 0.014 * strength
        self.mean = 18.4

    def step(self, s: Situation) -> Change:
        total = 0.0
        for i in range(4):
            n = float(s.speed[i])
            r2 = n / 0.68
            n *= 2.0
            total += self.IMBALANCE[i] * n * n / ((1.0 - r2) ** 2 + 0.09 * r2)  # ζ = 0.15
        self.mean += s.dt / 0.04 * (total - self.mean)
        change = Change()
        change.gyro[s.axis] = self.k * (self.mean - 21.0)
        return change


class RpmChasingNotch:
    """A notch filter on the gyro that follows the rotors' frequency by the throttle.

    To keep the rotors' shaking out of the loop the flight controller notches the gyro at
    f = f_h·√(throttle/0.5), wide enough for a crude estimate of f. Below its centre a notch lags:
        H(s) = (s² + ω²)/(s² + (ω/Q)·s + ω²) = 1 - (ω/Q)·s/(s² + (ω/Q)·s + ω²),
    phase ≈ -(f/f_c)/Q, which grows when the throttle goes down (state-variable form, so that moving
    the centre makes no bump). A second one of half the depth sits at the next harmonic.
    Source: Zölzer, Digital Audio Signal Processing (state-variable notch); Zavalishin, The Art of
    VA Filter Design; ArduPilot's documentation, Throttle-based dynamic notch. Felt here: large slow
    propellers (25 turns a second) put the notch within a few octaves of the attitude loop.
    """

    def __init__(self, strength: float) -> None:
        self.width = 1.25 * strength
        self.throttle = 0.5
        self.state = [0.0, 0.0, 0.0, 0.0]

    def step(self, s: Situation) -> Change:
        self.throttle += s.dt / 0.1 * (s.throttle - self.throttle)
        centre = 22.0 * math.sqrt(max(self.throttle, 0.1) / 0.5)
        value = true = float(s.rate[s.axis])
        for j, harmonic, depth in ((0, 1.0, 1.0), (2, 2.0, 0.5)):
            g = math.tan(math.pi * centre * harmonic * s.dt)
            low, band = self.state[j], self.state[j + 1]
            new = (band + g * (value - low)) / (1.0 + g * (g + self.width))
            self.state[j + 1] = 2.0 * new - band
            self.state[j] = low + 2.0 * g * new
            value -= depth * self.width * new
        change = Change()
        change.gyro[s.axis] = value - true
        return change


class OverweightObserver:
    """The rate that is shown is an observer's, whose inertia is too large and whose motors too slow.

    A Luenberger (steady Kalman) observer predicts with the commands and is corrected by the gyro:
        dŵ/dt = b̂·m̂ - d̂·ŵ + L·(w - ŵ) + ẑ,   dẑ/dt = L_z·(w - ŵ),   τ̂·dm̂/dt = u - m̂
    with b̂ = b/(1 + ε) (calibrated with a heavier battery) and τ̂ > τ; ẑ learns a constant torque.
    The error obeys (s² + (L+d)s + L_z)·(ŵ - w) = s·(b̂m̂ - true acceleration - ...): it is felt where
    the loop works, and vanishes for slow motion.
    Source: Luenberger, An introduction to observers, IEEE TAC 16 (1971); Franklin, Powell &
    Emami-Naeini, Feedback Control of Dynamic Systems, §7.7; Simon, Optimal State Estimation, ch. 10
    (modelling errors). Felt here: rate estimators with a motor model are usual against gyro noise.
    """

    def __init__(self, strength: float) -> None:
        self.ratio, self.lag = 1.0 / (1.0 + 0.45 * strength), 0.042 * (1.0 + 0.35 * strength)
        self.motor = self.rate = self.trim = 0.0

    def step(self, s: Situation) -> Change:
        i = s.axis
        signs, u = SIGNS[i], s.command
        wanted = 0.25 * GAINS[i] * (signs[0] * float(u[0]) + signs[1] * float(u[1])
                                    + signs[2] * float(u[2]) + signs[3] * float(u[3]))
        self.motor += s.dt / self.lag * (wanted - self.motor)
        wrong = float(s.rate[i]) - self.rate
        self.trim += s.dt * 20.0 * wrong
        self.rate += s.dt * (
            self.ratio * self.motor - 0.5 * self.rate + 14.0 * wrong + self.trim)
        change = Change()
        change.gyro[i] = self.rate - float(s.rate[i])
        return change


EFFECTS = {
    'sludgy_grease_gel': (SludgyGreaseGel, True),
    'dented_race_valleys': (DentedRaceValleys, True),
    'fork_dragged_pot': (ForkDraggedPot, True),
    'shaded_stator_heat': (ShadedStatorHeat, False),
    'tardy_sector_timing': (TardySectorTiming, True),
    'bridge_blanking_loss': (BridgeBlankingLoss, False),
    'room_wash_echo': (RoomWashEcho, True),
    'leeward_disc_shadow': (LeewardDiscShadow, False),
    'lid_plate_incidence': (LidPlateIncidence, False),
    'rectified_shake_bias': (RectifiedShakeBias, False),
    'rpm_chasing_notch': (RpmChasingNotch, True),
    'overweight_observer': (OverweightObserver, False),
}
FAMILIES = {
    'friction and play': ('sludgy_grease_gel', 'dented_race_valleys', 'fork_dragged_pot'),
    'motors and controllers': ('shaded_stator_heat', 'tardy_sector_timing', 'bridge_blanking_loss'),
    'aerodynamics': ('room_wash_echo', 'leeward_disc_shadow', 'lid_plate_incidence'),
    'sensing and estimation': ('rectified_shake_bias', 'rpm_chasing_notch', 'overweight_observer'),
}

MAY_BE = {
    'sludgy_grease_gel': ('coulomb_friction',),
    'dented_race_valleys': ('coulomb_friction',),
    'fork_dragged_pot': ('coulomb_friction',),
    'tardy_sector_timing': ('motor_lag',),
    'bridge_blanking_loss': ('dead_zone', 'motor_lag', 'thrust_curve'),
    'leeward_disc_shadow': ('periodic_disturbance',),
    'lid_plate_incidence': ('pendulum_stiffness', 'periodic_disturbance'),
    'rectified_shake_bias': ('resonance', 'cross_axis_input'),
    'overweight_observer': ('motor_lag',),
}
