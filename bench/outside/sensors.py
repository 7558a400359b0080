"""Gyros and their boards, and the clocks by which samples and commands travel."""

from __future__ import annotations

import math

import numpy as np

from .simulator import HOVER, SIDE, Change, Plant, Situation


class RectifiedVibration:
    """MEMS gyro turns vibration into bias: as a rotor's speed nears the frame's resonance, the
    zero of the gyro wanders.

        A_i^2 = r^4/((1 - r^2)^2 + (2 zeta r)^2),   r^2 = s_i/0.64 (rotor speed squared over
        resonance squared)
        bias = k sum(m_i A_i^2) - (its value in hover), through the 0.08 s of the sensor's and the
        structure's response
    m_i are the rotors' unequal imbalances. Rectification goes with the square of the amplitude.
    Sources: Den Hartog, 'Mechanical Vibrations' (rotating imbalance); IEEE Std 1431 (Coriolis
    gyros, vibration rectification); application notes of MEMS makers on vibration rectification.
    Felt: gyros on a stiff plate shaken by unbalanced propellers show offsets of several degrees
    per second with throttle.
    """

    def __init__(self, strength):
        self.k = strength
        self.y = 0.0

    def step(self, s: Situation) -> Change:
        total = -6.75
        for m, v in zip((0.42, 0.20, 0.28, 0.10), s.speed.tolist()):
            q = v / 0.64
            total += m * q * q / ((1.0 - q) ** 2 + 0.0784 * q)
        self.y += s.dt * (total - self.y) / 0.08
        out = Change()
        out.gyro[s.axis] = 0.035 * self.k * self.y
        return out


class SkewedDroopingBoard:
    """Flight controller stuck on askew, on pads that yield under the load of thrust: other axes'
    rates enter this one.

        shown = Rx(phi)Ry(theta) Rz(psi) rate,   psi = 0.26 rad fixed,  d(theta)/dt = (0.16 T/0.5
        - theta)/T_creep, T_creep 0.4 s
    The skew psi mixes roll and pitch, the droop mixes yaw into roll (theta) and into pitch (phi =
    0.6 theta), more at more throttle; and cosines lose a few percent of the own axis.
    Sources: Titterton & Weston, 'Strapdown Inertial Navigation Technology' (misalignment, ch.
    8-12); standard linear solid (creep) in Lakes, 'Viscoelastic Materials'.
    Felt: a board turned by 15 degrees and standing on soft double-sided tape; everyday in hobby
    and laboratory builds.
    """

    def __init__(self, strength):
        self.k = strength
        self.tilt = 0.16
        self.c, self.d = math.cos(0.26 * strength), math.sin(0.26 * strength)

    def step(self, s: Situation) -> Change:
        a, b, c, d = s.speed.tolist()
        self.tilt += s.dt * (0.08 * (a + b + c + d) - self.tilt) / 0.4
        p, q, r = s.rate.tolist()
        x, y = self.c * p + self.d * q, self.c * q - self.d * p
        e = self.k * self.tilt
        f = 0.6 * e
        ce, se, cf, sf = math.cos(e), math.sin(e), math.cos(f), math.sin(f)
        x, z = ce * x - se * r, ce * r + se * x
        y, z = cf * y + sf * z, cf * z - sf * y
        return Change(gyro=np.array((x - p, y - q, z - r)))


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
        near = [n for n in range(4) if SIDE[a][n] > 0.0]
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


class UnsynchronisedLoops:
    """Two tasks of almost equal period hand the command on through a buffer without being
    synchronised.

    The sender latches at k·P, the driver at k·P·(1+e): its command is as old as the beat phase
    says, from 0 to P, a saw of the period P/e, besides the hold's own P/2. Source: Åström &
    Wittenmark, Computer-Controlled Systems (sample and hold); Wittenmark, Nilsson, Törngren,
    "Timing problems in real-time control systems" (ACC 1995).
    Felt: I²C or CAN motor drivers with a clock of their own.
    """

    def __init__(self, strength):
        self.p = 0.012 * strength
        self.q = self.p * (1.0 + 0.012 / 2.9)
        self.send = self.take = 0.0
        self.buffer = self.out = None

    def step(self, s: Situation) -> Change:
        if self.out is None:
            self.buffer = self.out = s.command.copy()
        if s.t >= self.take - 1e-9:
            self.take += self.q
            self.out = self.buffer
        if s.t >= self.send - 1e-9:
            self.send += self.p
            self.buffer = s.command.copy()
        return Change(command=self.out.copy())


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
        b = 1 - a
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


class GroundShiftGyro:
    """The motors' return currents flow through the ground of an analogue gyro and pull down its
    supply.

        i_i = u_i^1.5 + a·(command_i − u_i)   (propeller's load and acceleration of the rotor),
        e = Σ side_i·i_i  (current that flows across the board),  d = Σ i_i − hover,
        g' = (e − g)/τg (input filter),  r'' = ω²·(d − r) − 2·ζ·ω·r' (rail: converter with its LC
        filter),
        shown = rate·(1 − s·r) + b·g + c·r.
    Source: Ott, Electromagnetic Compatibility Engineering (2009), ch. 3 (common-impedance
    coupling); Erickson & Maksimović, Fundamentals of Power Electronics, ch. 10 (input filter).
    Rigs with an analogue gyro and one shared ground wire: 10 mΩ at 10 A shift the reading by 100
    mV, some 0.2 rad/s. Strength: the resistance of ground.
    """

    def __init__(self, strength):
        self.b, self.c, self.s = 0.45 * strength, 0.10 * strength, 0.22 * strength
        self.a = 2.2
        self.g = self.r = self.slope = 0.0

    def step(self, s: Situation) -> Change:
        u, c, side = s.speed.tolist(), s.command.tolist(), SIDE[s.axis]
        e = d = 0.0
        for k in range(4):
            i = max(u[k], 0.0) ** 1.5 + self.a * (c[k] - u[k])
            e += side[k] * i
            d += i
        d -= 4.0 * 0.5 ** 1.5
        self.g += s.dt / 0.012 * (e - self.g)
        self.slope += s.dt * (900.0 * (d - self.r) - 2.0 * 0.35 * 30.0 * self.slope)
        self.r += s.dt * self.slope
        change = Change()
        change.gyro[s.axis] = -self.s * self.r * float(s.rate[s.axis]) + self.b * self.g + self.c * self.r
        return change


class LoggerBlocksControl:
    """The logger writes a block to the SD card now and then, and the motors' task waits behind it
    (priority inversion).

    Every 0.45 s the bus is held for B = B0 + B1·(what was logged: sum of a command's changes
    since the last block; the log is compressed); new commands queue up meanwhile, and then leave
    the queue in order, two for each that arrives: the delay D obeys
        D' = 1 while the bus is held, D' = −1 afterwards until D = 0;   command out(t) = command
        in(t − D).
    A sawtooth of delay, some 30 to 50 ms high, twice a second and more.
    Source: Liu & Layland, J. ACM 20 (1973) 46; Sha, Rajkumar & Lehoczky, IEEE Trans. Comput. 39
    (1990) 1175 (priority inversion); Buttazzo, Hard Real-Time Computing Systems, ch. 7; Cervin et
    al., IEEE Control Systems 23 (2003) 16 (jitter and control). Cards hold their bus for 20 to
    200 ms; known from every flight controller that logs. Strength: the time the bus is held.
    """

    N = 512

    def __init__(self, strength):
        self.b0, self.b1 = 0.029 * strength, 0.02 * strength
        self.queue = [None] * self.N
        self.n = 0
        self.delay = self.left = self.logged = 0.0
        self.next = 300
        self.last = 0.0

    def step(self, s: Situation) -> Change:
        n, command = self.n, tuple(s.command.tolist())
        self.queue[n % self.N] = command
        if n:
            self.logged += abs(command[0] - self.last)
        self.last = command[0]
        if n == self.next:
            self.left = min(0.09, self.b0 + self.b1 * self.logged)
            self.logged, self.next = 0.0, n + 450
        if self.left > 0.0:
            self.left -= s.dt
            self.delay += s.dt
        else:
            self.delay = max(0.0, self.delay - s.dt)
        self.n = n + 1
        change = Change()
        late = min(int(self.delay / s.dt + 0.5), n)
        if late:
            change.command = np.array(self.queue[(n - late) % self.N])
        return change


class RectifiedUnbalance:
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


class StaleMailboxBeat:
    """The output processor fetches the motor commands from a mailbox in its own slow rhythm.

    command_j(t) = command(t_k), t_k = k P + phase_j: two boards of two motors each, a third of
    a period apart, and not synchronous with the control loop, so that the age of a command beats between zero
    and P: sample and hold without agreement of clocks.
    Source: Åström & Wittenmark, Computer-Controlled Systems (hold, latency P/2); Kopetz, Real-Time Systems.
    Felt here: with P = 26 ms the commands come in stairs, 13 ms late on average, and half of the
    motors before the others, which couples the axes.
    """

    PERIOD, SHIFT = 0.0263, 0.37

    def __init__(self, strength):
        self.period = strength * self.PERIOD
        self.due = [0.0, self.SHIFT * self.period]
        self.held = [0.5, 0.5, 0.5, 0.5]

    def step(self, s: Situation) -> Change:
        for board in (0, 1):
            if s.t >= self.due[board]:
                self.due[board] += self.period
                self.held[2 * board] = float(s.command[2 * board])
                self.held[2 * board + 1] = float(s.command[2 * board + 1])
        out = Change()
        out.command = np.array(self.held)
        return out


class BoardTwistedOnItsPads:
    """The flight controller was glued in turned about the vertical: its axes are not the frame's.

    A mechanic says: crooked flight controller, board alignment yaw is wrong.
    Source: misalignment of a triad, a direction cosine matrix (Titterton & Weston, Strapdown
    Inertial Navigation Technology, ch. 3): shown = C(psi) rate.
    Felt: a pure roll comes out with some pitch; it moves off the line of the stick.
    """

    def __init__(self, strength: float) -> None:
        psi = math.radians(14.0 * strength)
        self.off = np.array([[math.cos(psi) - 1.0, math.sin(psi), 0.0],
                             [-math.sin(psi), math.cos(psi) - 1.0, 0.0], [0.0, 0.0, 0.0]])

    def step(self, s: Situation) -> Change:
        return Change(gyro=self.off @ s.rate)


class CrookedBoard:
    """A crash has turned the flight controller on its plate: its roll axis is not the frame's.

    A mechanic says: flight controller mounted crooked, turned on its plate.

    Misalignment of a triad of gyros (Titterton & Weston, Strapdown Inertial Navigation): the
    shown rates are C(psi)·rate, turned about the yaw axis: cross-axis sensitivity sin psi and
    scale cos psi. Felt: a pure roll drags the nose along, square corners become skewed.
    """

    TURN = math.radians(15.0)

    def __init__(self, strength):
        self.c, self.s = math.cos(self.TURN * strength), math.sin(self.TURN * strength)

    def step(self, s: Situation) -> Change:
        roll, pitch = float(s.rate[0]), float(s.rate[1])
        return Change(gyro=np.array([
            (self.c - 1.0) * roll + self.s * pitch, (self.c - 1.0) * pitch - self.s * roll, 0.0]))


class RadioDropouts:
    """The motors' set-points come by radio, and frames are lost in bursts: the last one is held.

    A mechanic says: radio link drops out, the commands freeze for moments.

    Burst losses of a link with two states (Gilbert 1960, Elliott 1963), and a receiver that holds
    the last frame (zero-order hold; Franklin, Powell & Workman, Digital Control). Fixed sequence
    of pseudo-random numbers. Felt: it obeys, then goes on for a moment with what it was told,
    then jumps to where it should be.
    """

    FRAME = 10
    """ms"""
    LOST, FOUND = 0.06, 0.30
    """Chances per frame of losing the link and of having it back."""

    def __init__(self, strength):
        self.lose = self.LOST * strength
        self.find = self.FOUND / math.sqrt(strength)
        self.seed = 20240
        self.count = 0
        self.up = True
        self.held = np.full(4, HOVER)

    def step(self, s: Situation) -> Change:
        if self.count % self.FRAME == 0:
            self.seed = (1664525 * self.seed + 1013904223) % 2**32
            chance = self.seed / 2**32
            self.up = chance >= self.lose if self.up else chance < self.find
        self.count += 1
        if self.up:
            self.held = np.array(s.command, dtype=float)
        return Change(command=self.held.copy())


PLANTS = (
    Plant('rectified_vibration', RectifiedVibration, 'bearings', 9, rig=True),
    Plant('skewed_drooping_board', SkewedDroopingBoard, 'bearings', 10, rig=False,
          may_be=('cross_axis_input', 'gyroscopic_coupling')),
    Plant('warm_gyro', WarmGyro, 'cables', 11, rig=False),
    Plant('unsynchronised_loops', UnsynchronisedLoops, 'rigs', 8, rig=True),
    Plant('turned_sensor_board', TurnedSensorBoard, 'hinges', 9, rig=False,
          may_be=('cross_axis_input', 'gyroscopic_coupling')),
    Plant('vibration_rectification', VibrationRectification, 'hinges', 10, rig=True),
    Plant('ground_shift_gyro', GroundShiftGyro, 'arms', 8, rig=True),
    Plant('logger_blocks_control', LoggerBlocksControl, 'arms', 10, rig=False),
    Plant('rectified_unbalance', RectifiedUnbalance, 'joints', 10, rig=False),
    Plant('staggered_frames', StaggeredFrames, 'hoses', 11, rig=False),
    Plant('vibration_rectified', VibrationRectified, 'gears', 11, rig=True, may_be=('resonance',)),
    Plant('rectified_shake_bias', RectifiedShakeBias, 'greases', 9, rig=False,
          may_be=('resonance', 'cross_axis_input')),
    Plant('stale_mailbox_beat', StaleMailboxBeat, 'chains', 10, rig=False,
          may_be=('motor_lag', 'cross_axis_input')),
    Plant('gyro_board_twisted', BoardTwistedOnItsPads, 'workshop', 9, rig=False,
          may_be=('cross_axis_input', 'gyroscopic_coupling')),
    Plant('crooked_board', CrookedBoard, 'field', 10, rig=False,
          may_be=('cross_axis_input', 'gyroscopic_coupling')),
    Plant('radio_dropouts', RadioDropouts, 'field', 11, rig=True),
)
