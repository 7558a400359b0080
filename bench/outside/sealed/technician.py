"""Twelve everyday faults of multirotor craft and of a one-axis test rig, after textbooks."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import simulator
from simulator import Change, Plant, Situation

SET = 'sealed_16'
G = simulator.G
INERTIA = simulator.INERTIA
SIDE = simulator.SIDE


def about(axis: int, value: float) -> np.ndarray:
    """A vector with the value about one axis."""
    out = np.zeros(3)
    out[axis] = value
    return out


class DraggingCable:
    """A power and data cable hangs from the arm of the rig and drags over the bench.

    Before it slides it bends: presliding hysteresis after P. R. Dahl, "A solid friction model"
    (Aerospace Corp. TOR-0158, 1968), dF/dx = sigma (1 - F/Fc sgn v)^i, here with i = 1; also
    Armstrong-Helouvry, "Control of Machines with Friction" (Kluwer 1991), ch. 2. The friction is
    greater where more cable lies on the bench (capstan and normal force, Meriam & Kraige,
    "Statics", ch. 6: F = mu N), so Fc grows on the side to which the arm goes down.
    """

    def __init__(self, strength: float) -> None:
        self.level = 2.2 * strength
        """rad/s²; 0.026 N m."""
        self.bend = 0.035
        """rad of bending before it slides."""
        self.held = 0.0

    def step(self, s: Situation) -> Change:
        rate, angle = float(s.rate[s.axis]), float(s.angle[s.axis])
        limit = self.level * min(max(1.0 + 1.5 * angle, 0.4), 1.6)
        moved = rate * s.dt
        way = 1.0 if moved >= 0.0 else -1.0
        # exact over the millisecond for i = 1
        self.held = way * limit + (self.held - way * limit) * math.exp(-abs(moved) / self.bend)
        return Change(torque=about(s.axis, -self.held))


class DentedBearing:
    """The ball bearing of the pivot has been knocked: brinell marks in which the balls settle.

    True brinelling: T. A. Harris, "Rolling Bearing Analysis" (4th ed., Wiley 2001), ch. on bearing
    failure, and its friction torque, ch. 14 (load-dependent torque M1 = f1 F dm, of Coulomb type).
    A ball that climbs out of a mark of depth d(x) gives the torque -W dd/dtheta (virtual work,
    Meriam & Kraige, "Statics", ch. 7).
    """

    def __init__(self, strength: float) -> None:
        self.level = 3.0 * strength
        self.rub = 0.5 * strength
        self.pitch = 0.17
        """rad between marks"""
        self.width = 0.03
        """rad, from the middle of a mark to its steepest flank."""

    def step(self, s: Situation) -> Change:
        angle, rate = float(s.angle[s.axis]), float(s.rate[s.axis])
        x = (angle - 0.04) - self.pitch * round((angle - 0.04) / self.pitch)
        slope = x / self.width * math.exp(0.5 - 0.5 * (x / self.width) ** 2)
        return Change(torque=about(
            s.axis, -self.level * slope - self.rub * math.tanh(rate / 0.02)))


class SlidingBattery:
    """The strap of the battery is loose, so that the battery slides on its plate as the rig tilts.

    Block on a plane with static and kinetic friction and stops with a coefficient of restitution:
    Meriam & Kraige, "Dynamics", ch. 3 (friction) and 3/12 (impact), in the frame of the plate with
    the inertia force of the plate's own angular acceleration (5/7). Its weight then acts off the
    pivot: torque m g x cos(theta).
    """

    def __init__(self, strength: float) -> None:
        self.mass = 0.25 * strength
        self.reach = 0.012
        """m to each stop"""
        self.grip, self.slip = 0.10, 0.07
        self.height = 0.03
        self.x, self.v = 0.0, 0.0

    def step(self, s: Situation) -> Change:
        angle = float(s.angle[s.axis])
        pull = G * math.sin(angle) - self.height * float(s.acceleration[s.axis])
        press = G * math.cos(angle)
        if self.v == 0.0 and abs(pull) <= self.grip * press:
            pass
        else:
            way = math.copysign(1.0, self.v if self.v != 0.0 else pull)
            new = self.v + s.dt * (pull - way * self.slip * press)
            if new * way < 0.0 and abs(pull) <= self.grip * press:
                new = 0.0
            self.v = new
            self.x += s.dt * self.v
            if abs(self.x) > self.reach:
                self.x = math.copysign(self.reach, self.x)
                self.v *= -0.2
                if abs(self.v) < 0.01:
                    self.v = 0.0
        return Change(torque=about(s.axis, self.mass * press * self.x / INERTIA))


class NearFloor:
    """The rig stands too low: the propellers blow against the floor.

    Ground effect of a rotor: Cheeseman & Bennett, ARC R&M 3021 (1955), T/T0 = 1/(1 - (R/4z)^2);
    Leishman, "Principles of Helicopter Aerodynamics" (2nd ed., Cambridge 2006), 5.8.3. The lower
    rotor gains more thrust than the higher one. The inflow needs time to build up (Pitt-Peters, Leishman 10.9;
    time constant of some tens of ms for a small rotor).
    """

    def __init__(self, strength: float) -> None:
        self.strength = strength
        self.radius, self.arm, self.height = 0.127, 0.16, 0.18
        self.build = 0.08
        self.extra = np.zeros(4)

    def step(self, s: Situation) -> Change:
        up = math.sin(float(s.angle[s.axis]))
        z = np.maximum(self.height + self.arm * up * np.array(SIDE[s.axis]), 0.06)
        steady = 1.0 / (1.0 - (self.radius / (4.0 * z)) ** 2) - 1.0
        self.extra = self.extra + s.dt / self.build * (steady - self.extra)
        return Change(thrust=1.0 + self.strength * self.extra)


class BentPropeller:
    """A propeller is bent: its unbalance shakes the frame, and the gyro rectifies the vibration.

    Rotating unbalance: Rao, "Mechanical Vibrations" (5th ed.), 3.7, eq. 3.79-3.81: amplitude over the
    frequency ratio r, r^2/sqrt((1-r^2)^2 + (2 zeta r)^2), so that it is strongest where the propeller turns
    at the natural frequency of the frame. Bias of an inertial sensor that is proportional to the
    square of the vibration (vibration rectification, anisoinertia): Titterton & Weston, "Strapdown Inertial
    Navigation Technology" (2nd ed., 2004), 4.4 and 12.3; IEEE Std 1431. The vibration builds up within some cycles.
    """

    def __init__(self, strength: float) -> None:
        self.motor = 1
        self.bias = 0.55 * strength
        """rad/s at resonance"""
        self.critical = math.sqrt(0.53)
        """speed of the propeller at the resonance, root of its thrust"""
        self.zeta = 0.02
        self.build = 0.025
        self.power = 0.0

    def step(self, s: Situation) -> Change:
        r = math.sqrt(max(float(s.speed[self.motor]), 0.0)) / self.critical
        steady = r**4 / ((1.0 - r * r) ** 2 + (2.0 * self.zeta * r) ** 2) * 4.0 * self.zeta**2
        self.power += s.dt / self.build * (steady - self.power)
        return Change(gyro=np.array([self.bias, -self.bias, 0.1 * self.bias]) * self.power)


class LosingStep:
    """The timing of one speed controller is set wrongly: it loses commutation when spun up quickly.

    Sensorless commutation from the back-EMF fails where the current of a quick acceleration
    prolongs the demagnetisation beyond the zero crossing: J. R. Hendershot & T. J. E. Miller, "Design of
    Brushless Permanent-Magnet Machines" (2010), chapter on drives; Krishnan, "Permanent Magnet Synchronous and
    Brushless DC Motor Drives" (2010), ch. 14. The current is about proportional to command less speed;
    until it is caught again, some commutations are missed and the torque is partly lost.
    """

    def __init__(self, strength: float) -> None:
        self.motor = 0
        self.lost = 0.16 * strength
        self.above = 0.022
        self.stays, self.rest = 0.09, 0.12
        self.since = 9.0
        self.caught = 0.0

    def step(self, s: Situation) -> Change:
        lead = float(s.command[self.motor] - s.speed[self.motor])
        self.since += s.dt
        if lead > self.above and self.since > self.stays + self.rest:
            self.since = 0.0
        wanted = self.lost if self.since < self.stays else 0.0
        self.caught += s.dt / 0.012 * (wanted - self.caught)
        thrust = np.ones(4)
        thrust[self.motor] -= self.caught
        return Change(thrust=thrust)


class WideDeadBand:
    """The dead band of the speed controllers' input is set far too wide.

    They take over a new command only where it differs from the last by more than the band; it is play
    (hysteresis of the backlash kind) in the actuator: Slotine & Li, "Applied Nonlinear Control" (1991), 5.2
    (dead zone, backlash), and Gelb & Vander Velde, "Multiple-Input Describing Functions" (1968), ch. 2.
    """

    def __init__(self, strength: float) -> None:
        self.band = 0.022 * strength * np.array([1.0, 0.8, 1.2, 0.9])
        self.kept: Any = None

    def step(self, s: Situation) -> Change:
        if self.kept is None:
            self.kept = np.array(s.command)
        far = np.abs(s.command - self.kept) > self.band
        self.kept = np.where(far, s.command, self.kept)
        return Change(command=self.kept.copy())


class CrackedBlade:
    """A blade of one propeller is cracked at its root: above some load it opens and untwists.

    Loss of thrust with the blade angle: dT ~ a dtheta (blade-element theory, Leishman, "Principles of
    Helicopter Aerodynamics", 3.2). The crack opens and closes at different loads (elastic-plastic closure:
    Anderson, "Fracture Mechanics" (3rd ed.), 10.2).
    """

    def __init__(self, strength: float) -> None:
        self.motor = 1
        self.loss = 0.05 * strength
        self.opens, self.closes = 0.53, 0.49
        self.open = False
        self.now = 0.0

    def step(self, s: Situation) -> Change:
        load = float(s.speed[self.motor])
        if load > self.opens:
            self.open = True
        elif load < self.closes:
            self.open = False
        self.now += s.dt / 0.02 * ((self.loss if self.open else 0.0) - self.now)
        thrust = np.ones(4)
        thrust[self.motor] -= self.now
        return Change(thrust=thrust)


class SwingingCamera:
    """A rubber damper of the camera is torn: the camera swings to and fro below the craft.

    A pendulum whose hinge lies below the centre of mass. In free flight the apparent gravity is the
    thrust over the mass and stays along the craft's own vertical (Quan, "Introduction to Multicopter
    Design and Control", Springer 2017, ch. 6), so that it swings relative to the craft:
    phi'' = -(g/l) phi - (1 + h/l) alpha - c phi' (Meriam & Kraige, "Dynamics", ch. 8 and 5/7). The pull
    of the hinge turns the craft by m g h phi / I. The remaining dampers stop it (restitution, 3/12).
    """

    def __init__(self, strength: float) -> None:
        self.mass = 0.22 * strength
        self.length, self.below = 0.10, 0.055
        self.damping = 0.8
        self.stop = 0.32
        self.phi, self.speed = 0.0, 0.0

    def step(self, s: Situation) -> Change:
        lift = G * s.throttle / simulator.HOVER
        got = (-lift / self.length * self.phi
               - (1.0 + self.below / self.length) * float(s.acceleration[s.axis])
               - self.damping * self.speed)
        self.speed += s.dt * got
        self.phi += s.dt * self.speed
        if abs(self.phi) > self.stop and self.speed * self.phi > 0.0:
            self.phi = math.copysign(self.stop, self.phi)
            self.speed *= -0.3
        return Change(torque=about(s.axis, self.mass * lift * self.below * self.phi / INERTIA))


class ColdJoint:
    """A wire of one motor is badly soldered: the joint opens as it gets hot and closes as it cools.

    Contact resistance: Holm, "Electric Contacts" (4th ed., Springer 1967), part I and II; heating by I^2 R with
    Newton's cooling, lumped capacity (Incropera & DeWitt, "Fundamentals of Heat and Mass Transfer", 5.1).
    The current follows the load of the propeller. With the joint partly open the motor lacks torque.
    """

    def __init__(self, strength: float) -> None:
        self.motor = 3
        self.loss = 0.06 * strength
        self.heat = 0.9
        self.cool = 0.8
        """s"""
        self.off, self.on = 1.0, 0.75
        self.open = False
        self.now = 0.0

    def step(self, s: Situation) -> Change:
        load = (float(s.speed[self.motor]) / 0.5) ** 2 * (0.45 if self.open else 1.35)
        self.heat += s.dt / self.cool * (load - self.heat)
        if self.heat > self.off:
            self.open = True
        elif self.heat < self.on:
            self.open = False
        self.now += s.dt / 0.042 * ((self.loss if self.open else 0.0) - self.now)
        thrust = np.ones(4)
        thrust[self.motor] -= self.now
        return Change(thrust=thrust)


class SlippingPropeller:
    """The nut of one propeller is not tight: the hub slips on the shaft when it must be driven harder.

    A cone or disc clutch transmits at most mu N r (Shigley, "Mechanical Engineering Design", ch. 16, clutches); the
    propeller's torque is k w^2 + J dw/dt (Leishman, ch. 2, and Newton). It slips on spinning up, and
    grips again when the speeds are equal; on slowing down the air brakes the propeller itself.
    """

    def __init__(self, strength: float) -> None:
        self.motor = 2
        self.inertia = 0.13
        """s, of J w/(k w^2) at unit speed"""
        self.slide = 0.625 - 0.05 * strength
        self.grip = self.slide + 0.06
        self.w = math.sqrt(0.5)
        self.before = math.sqrt(0.5)
        self.slips = False

    def step(self, s: Situation) -> Change:
        shaft = math.sqrt(max(float(s.speed[self.motor]), 1e-4))
        wanted = (shaft - self.before) / s.dt
        self.before = shaft
        if not self.slips and wanted * self.inertia + shaft**2 > self.grip:
            self.slips = True
        if self.slips:
            self.w += s.dt * (self.slide - self.w**2) / self.inertia
            if self.w >= shaft:
                self.slips = False
        if not self.slips:
            self.w = shaft
        thrust = np.ones(4)
        thrust[self.motor] = (self.w / shaft) ** 2
        return Change(thrust=thrust)


class StallingLoop:
    """The log is written to a slow memory card: the loop of the controller stops while it is written.

    Sampled control with a delayed and held output: Astrom & Wittenmark, "Computer-Controlled Systems"
    (3rd ed.), ch. 3 (zero-order hold), and jitter of real-time tasks, Buttazzo, "Hard Real-Time Computing
    Systems" (3rd ed.), ch. 1 and 8. The motors keep their last command during the stop.
    """

    def __init__(self, strength: float) -> None:
        self.every, self.lasts = 0.36, 0.07 * strength
        self.kept: Any = None

    def step(self, s: Situation) -> Change:
        n = int(s.t / self.every)
        lasts = self.lasts * (1.35 if n % 4 == 3 else 1.0)
        if s.t - n * self.every >= lasts or self.kept is None:
            self.kept = np.array(s.command)
        return Change(command=self.kept.copy())


PLANTS = (
    Plant('cable dragging on the bench', DraggingCable, SET, 700, True),
    Plant('dented pivot bearing', DentedBearing, SET, 701, True),
    Plant('battery sliding under a loose strap', SlidingBattery, SET, 702, True),
    Plant('rig too close to the floor', NearFloor, SET, 703, True),
    Plant('bent propeller shaking the gyro', BentPropeller, SET, 704, True),
    Plant('speed controller losing step', LosingStep, SET, 705, True),
    Plant('speed controllers with too wide a dead band', WideDeadBand, SET, 706, False),
    Plant('cracked propeller blade', CrackedBlade, SET, 707, False),
    Plant('camera swinging on a torn damper', SwingingCamera, SET, 708, False),
    Plant('badly soldered motor wire', ColdJoint, SET, 709, False),
    Plant('propeller slipping on its shaft', SlippingPropeller, SET, 710, False),
    Plant('control loop stalled by a slow memory card', StallingLoop, SET, 711, False),
)
