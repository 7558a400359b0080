"""Twelve everyday faults of multirotors, as met in hangars, workshops and clubs.

Six in free flight, six on a rig of one axis. Each is small physics with a state of its own;
`strength` scales the size (1 = the usual case).
"""

from __future__ import annotations

import math

import numpy as np
import simulator
from simulator import Change, Plant, Situation

SET = 'hangar'

THRUST_PER_SPEED = simulator.MASS * simulator.G / 4.0 / simulator.HOVER
"""N of one motor per unit of speed."""
ARM = simulator.GAIN_OF[0] * simulator.INERTIA / (4.0 * THRUST_PER_SPEED)
"""m, lever of a motor about roll."""
HOVER_TORQUE = 0.05
"""Nm, air drag torque of one propeller in hover."""
HOVER_OMEGA = 550.0
"""rad/s of a propeller in hover."""
ROTOR_INERTIA = 9.0e-5
"""kg m², ten-inch propeller and motor bell."""


def about(axis: int, newton_metres: float) -> np.ndarray:
    """Angular acceleration vector of a torque about roll or pitch."""
    out = np.zeros(3)
    out[axis] = newton_metres / simulator.INERTIA
    return out


# ------------------------------------------------------------------------------- free flight


class BottleOnCord:
    """A parcel on a cord, hooked below the centre of gravity; it swings as the aircraft moves.

    Plane pendulum on an accelerated support; the cord's tension pulls at a hook with a lever.
    Meriam & Kraige, Engineering Mechanics: Dynamics, ch. 6 and 8; Thomson & Dahleh, Theory of
    Vibration, ch. 5 (two degrees of freedom).
    """

    CORD = 0.7
    """m"""
    HOOK = 0.055
    """m below the centre of gravity"""
    AIR = 0.35
    """1/s, drag of the aircraft's sideways speed"""
    SWING_LOSS = 0.25
    """1/s"""

    def __init__(self, strength: float) -> None:
        self.load = 0.22 * strength
        """kg"""
        self.swing, self.swing_rate, self.speed = np.zeros(2), np.zeros(2), np.zeros(2)

    def step(self, s: Situation) -> Change:
        m, g, h = simulator.MASS, simulator.G, self.HOOK
        tilt = np.sin(s.angle[:2])
        pull = self.load * g * np.sin(self.swing)
        a = ((m + self.load) * g * tilt + pull) / m - self.AIR * self.speed
        hook = a - h * s.acceleration[:2]
        bend = -(g * np.sin(self.swing) + hook * np.cos(self.swing)) / self.CORD
        self.swing_rate = self.swing_rate + s.dt * (bend - self.SWING_LOSS * self.swing_rate)
        self.swing = self.swing + s.dt * self.swing_rate
        self.speed = self.speed + s.dt * a
        tension = self.load * (g * np.cos(self.swing) + self.CORD * self.swing_rate**2)
        torque = np.zeros(3)
        torque[:2] = -tension * h * np.sin(s.angle[:2] + self.swing) / simulator.INERTIA
        return Change(torque=torque)


class CoastingMotors:
    """Speed controllers with the active brake ('damped light') off: motors only coast down.

    Speeding up is as usual; slowing down, the air drag alone brakes: J dw/dt = -Q(w), Q ~ w².
    Hughes & Drury, Electric Motors and Drives, ch. 3 (braking and four-quadrant operation);
    Leishman, Principles of Helicopter Aerodynamics, ch. 2 (power and torque of a rotor).
    """

    def __init__(self, strength: float) -> None:
        self.inertia = 1.3 * ROTOR_INERTIA * strength
        """kg m²: heavier propellers coast longer"""

    def step(self, s: Situation) -> Change:
        speed = np.maximum(s.speed, 0.02)
        # thrust ~ w², so that d(thrust)/dt = 2 w dw/dt, in units of speed per second
        omega = HOVER_OMEGA * np.sqrt(speed / simulator.HOVER)
        drag = HOVER_TORQUE * speed / simulator.HOVER
        steepest = 2.0 * speed / omega * drag / self.inertia
        fall = (s.speed - s.command) / simulator.LAG_S
        return Change(lag=np.maximum(1.0, fall / steepest))


class BlowBack:
    """Blow-back: the discs flap away from the wind of the aircraft's own travel, and pitch it up.

    Sideways speed is the tilt's acceleration, gathered and bled by drag; the moment is against the
    travel and grows with airspeed. Leishman, Principles of Helicopter Aerodynamics, ch. 4 (blade
    flapping); Bramwell's Helicopter Dynamics, ch. 3 and 5.
    """

    DRAG = 0.4
    """1/s, rotor drag per mass"""
    WIND = 1.0
    """m/s, steady"""

    def __init__(self, strength: float) -> None:
        self.moment = 0.019 * strength
        """Nm per m/s in hover"""
        self.speed = np.zeros(2)

    def step(self, s: Situation) -> Change:
        air = self.speed + self.WIND
        lift = s.throttle / simulator.HOVER
        self.speed = self.speed + s.dt * (
            simulator.G * lift * np.sin(s.angle[:2]) - self.DRAG * air)
        torque = np.zeros(3)
        torque[:2] = -self.moment * math.sqrt(max(lift, 0.0)) * air / simulator.INERTIA
        return Change(torque=torque)


class BurntPlug:
    """A scorched battery plug behind the voltage sensor: it drops volts and heats itself.

    Ohm's law with a contact that grows with temperature, one heat capacity; thrust ~ volts².
    The logged voltage is on the battery's side and does not show it. Holm, Electric Contacts,
    part I; Incropera, Fundamentals of Heat and Mass Transfer, ch. 5 (lumped capacitance).
    """

    COPPER = 0.0039
    """1/K"""
    HEAT = 3.5
    """J/K"""
    COOLING = 0.16
    """W/K"""
    HOVER_CURRENT = 16.0
    """A, all motors"""

    def __init__(self, strength: float) -> None:
        self.cold = 0.050 * strength
        """ohm at room temperature"""
        self.warmth = 0.0
        """K above the room"""

    def step(self, s: Situation) -> Change:
        # power of a motor ~ thrust^1.5
        load = float(np.mean((np.maximum(s.speed, 0.0) / simulator.HOVER) ** 1.5))
        ohms = self.cold * (1.0 + self.COPPER * self.warmth)
        amps = self.HOVER_CURRENT * load
        # a motor at a given duty is a load of resistance, about
        left = 1.0 / (1.0 + ohms * amps / s.battery_v)
        amps *= left
        self.warmth += s.dt * (amps**2 * ohms - self.COOLING * self.warmth) / self.HEAT
        return Change(thrust=np.full(4, left**2))


class LoosePropeller:
    """The nut of one propeller has come loose: the propeller slips on its shaft when pushed hard.

    A friction clutch: it sticks while drag and inertia stay below the grip, else it is driven with
    the smaller sliding grip until it has caught up. Shigley's Mechanical Engineering Design, ch. 8
    (fasteners) and 16 (clutches).
    """

    INERTIA = 3.0e-5
    """kg m² of the propeller alone, a light one"""

    def __init__(self, strength: float) -> None:
        self.sliding = HOVER_TORQUE * (1.70 - 0.25 * strength)
        """Nm"""
        self.sticking = 1.12 * self.sliding
        self.omega = HOVER_OMEGA
        """rad/s of the propeller"""
        self.slips = False

    def step(self, s: Situation) -> Change:
        speed = max(float(s.speed[0]), 1e-3)
        shaft = HOVER_OMEGA * math.sqrt(speed / simulator.HOVER)
        drag = HOVER_TORQUE * (self.omega / HOVER_OMEGA) ** 2
        if not self.slips:
            needed = drag + self.INERTIA * (shaft - self.omega) / s.dt
            self.slips = abs(needed) > self.sticking
        if self.slips:
            way = math.copysign(1.0, shaft - self.omega)
            after = self.omega + s.dt * (way * self.sliding - drag) / self.INERTIA
            if (shaft - after) * way <= 0.0:
                after, self.slips = shaft, False
            self.omega = after
        else:
            self.omega = shaft
        factor = np.ones(4)
        factor[0] = (self.omega / shaft) ** 2
        return Change(thrust=factor)


class BoardOnFoam:
    """The flight controller sits on foam that is too soft; the board turns against the frame.

    A base-excited mass on spring and damper, about each axis; the gyro shows board, not frame.
    Thomson & Dahleh, Theory of Vibration, ch. 3 (support motion, vibration isolation).
    """

    DAMPING = 0.22

    def __init__(self, strength: float) -> None:
        self.natural = 2.0 * math.pi * 9.5 / math.sqrt(strength)
        """rad/s: the foam's stiffness over the board's inertia"""
        self.turn, self.turn_rate = np.zeros(3), np.zeros(3)

    def step(self, s: Situation) -> Change:
        w = self.natural
        self.turn_rate = self.turn_rate + s.dt * (
            -s.acceleration - 2.0 * self.DAMPING * w * self.turn_rate - w * w * self.turn)
        self.turn = self.turn + s.dt * self.turn_rate
        return Change(gyro=self.turn_rate.copy())


# ------------------------------------------------------------------------------------ the rig


class RubbingBearing:
    """The rig's bearings rub: bristles bend before they slip, and sticking is more than sliding.

    LuGre friction with the Stribeck curve. Armstrong-Hélouvry, Control of Machines with Friction,
    ch. 2; Olsson et al. as in Åström & Canudas de Wit.
    """

    BEND = 0.004
    """rad, deflection of the bristles at break-away"""
    STRIBECK = 0.06
    """rad/s"""

    def __init__(self, strength: float) -> None:
        self.sliding = 0.020 * strength
        """Nm"""
        self.sticking = 0.028 * strength
        """Nm"""
        self.stiffness = self.sticking / self.BEND
        """Nm/rad"""
        self.inner = 2.0 * 0.3 * math.sqrt(self.stiffness * simulator.INERTIA)
        """Nm s/rad of the bristles"""
        self.z = 0.0

    def step(self, s: Situation) -> Change:
        v = float(s.rate[s.axis])
        grip = self.sliding + (self.sticking - self.sliding) * math.exp(-(v / self.STRIBECK) ** 2)
        longest = grip / self.stiffness
        before = self.z
        if abs(v) > 1e-9:
            end = math.copysign(longest, v)
            self.z = end + (before - end) * math.exp(-abs(v) * s.dt / longest)
        slope = (self.z - before) / s.dt
        fade = math.exp(-((v / self.STRIBECK) ** 2))
        return Change(torque=about(
            s.axis, -self.stiffness * self.z - self.inner * fade * slope))


class StiffSupplyCable:
    """A thick supply cable at the rig: it springs back, creeps, and its strands rub.

    Standard linear solid (spring beside spring and damper in series), a slipping Jenkins element,
    and the cable's weight on one side. Lakes, Viscoelastic Materials, ch. 2; Findley, Lai & Onaran,
    Creep and Relaxation of Nonlinear Viscoelastic Materials, ch. 5.
    """

    CREEP = 1.3
    """s"""
    STRANDS = 0.25
    """Nm/rad, strands before they slip"""

    def __init__(self, strength: float) -> None:
        self.lasting = 0.045 * strength
        """Nm/rad"""
        self.passing = 0.085 * strength
        """Nm/rad"""
        self.rub = 0.005 * strength
        """Nm"""
        self.weight = 0.010 * strength
        """Nm, hanging on one side"""
        self.crept, self.slid = 0.0, 0.0

    def step(self, s: Situation) -> Change:
        a = float(s.angle[s.axis])
        self.crept += s.dt * (a - self.crept) / self.CREEP
        reach = self.rub / self.STRANDS
        self.slid = min(max(self.slid, a - reach), a + reach)
        torque = (self.lasting * a + self.passing * (a - self.crept)
                  + self.STRANDS * (a - self.slid) + self.weight * math.cos(a))
        return Change(torque=about(s.axis, -torque))


class SlidingBattery:
    """On the rig the battery slides in its loose strap towards the lower side, up to the stops.

    A block on an inclined plane with sticking and sliding friction (low: the motors shake it);
    where it rests, its weight has a lever. Meriam & Kraige, Statics, ch. 6 (dry friction), and
    Dynamics, ch. 3.
    """

    BATTERY = 0.20
    """kg"""
    BELOW = 0.03
    """m under the pivot"""
    STICKING, SLIDING = 0.10, 0.065
    REBOUND = 0.2

    def __init__(self, strength: float) -> None:
        self.travel = 0.014 * strength
        """m to either stop"""
        self.place, self.speed = 0.0, 0.0

    def step(self, s: Situation) -> Change:
        g = simulator.G
        tilt = float(s.angle[s.axis])
        # along the floor of the bay, towards the side that goes down
        push = g * math.sin(tilt) + self.BELOW * float(s.acceleration[s.axis])
        press = g * math.cos(tilt)
        if self.speed == 0.0:
            held = abs(push) <= self.STICKING * press
            held = held or (abs(self.place) >= self.travel and push * self.place > 0.0)
            if not held:
                self.speed = s.dt * (push - math.copysign(self.SLIDING * press, push))
        else:
            way = math.copysign(1.0, self.speed)
            after = self.speed + s.dt * (push - way * self.SLIDING * press)
            self.speed = after if after * way > 0.0 else 0.0
        self.place += s.dt * self.speed
        if abs(self.place) > self.travel:
            self.place = math.copysign(self.travel, self.place)
            self.speed *= -self.REBOUND
            if abs(self.speed) < 0.01:
                self.speed = 0.0
        return Change(torque=about(
            s.axis, self.BATTERY * g * self.place * math.cos(tilt)))


class SwayingStand:
    """The rig's post is slender: the tilted thrust makes it sway, and the aircraft hangs a bit low.

    Post and aircraft as a mass on a weakly damped spring, driven by the thrust's sideways part; its
    acceleration acts at the centre of gravity below the pivot. Thomson & Dahleh, Theory of
    Vibration, ch. 2, 3 and 5; Den Hartog, Mechanical Vibrations, ch. 2.
    """

    MOVED = 2.0
    """kg, aircraft, cradle and the top of the post"""
    SWAY = 2.0 * math.pi * 2.3
    """rad/s"""
    DAMPING = 0.03

    def __init__(self, strength: float) -> None:
        self.below = 0.010 * strength
        """m, centre of gravity under the pivot"""
        self.x, self.v = 0.0, 0.0

    def step(self, s: Situation) -> Change:
        tilt = float(s.angle[s.axis])
        lift = 4.0 * THRUST_PER_SPEED * float(s.speed.mean())
        a = (lift * math.sin(tilt) / self.MOVED - self.SWAY**2 * self.x
             - 2.0 * self.DAMPING * self.SWAY * self.v)
        self.v += s.dt * a
        self.x += s.dt * self.v
        return Change(torque=about(s.axis, simulator.MASS * self.below * (
            a * math.cos(tilt) - simulator.G * math.sin(tilt))))


class LowOverTheBench:
    """The rig stands low over a bench: the rotor that goes down finds a cushion of air.

    Ground effect by Cheeseman and Bennett, per rotor, which follows the height with the lag of the
    inflow. Leishman, Principles of Helicopter Aerodynamics, ch. 5 (ground effect) and 10 (dynamic
    inflow).
    """

    RADIUS = 0.127
    """m"""
    HEIGHT = 0.19
    """m of the rotors over the bench, level"""
    INFLOW = 0.12
    """s"""

    def __init__(self, strength: float) -> None:
        self.strength = strength
        self.cushion = np.full(4, self.more(self.HEIGHT))

    def more(self, height):
        """Share of additional thrust."""
        return 1.0 / (1.0 - (self.RADIUS / (4.0 * height)) ** 2) - 1.0

    def step(self, s: Situation) -> Change:
        side = np.array(simulator.SIDE[s.axis])
        height = np.maximum(self.HEIGHT + ARM * side * math.sin(float(s.angle[s.axis])), 0.06)
        self.cushion = self.cushion + s.dt * (self.more(height) - self.cushion) / self.INFLOW
        return Change(thrust=1.0 + self.strength * self.cushion)


class SlowMemoryCard:
    """Writing the log to a slow memory card blocks the output to the motors for some tens of ms.

    A task holds the bus while the card erases; the motors keep the last command, and the control
    goes on. Buttazzo, Hard Real-Time Computing Systems, ch. 7 (blocking on shared resources);
    Åström & Wittenmark, Computer-Controlled Systems, ch. 3 and 9 (sampling, delays).
    """

    FILL = 0.45
    """s until a block of the log is full"""

    def __init__(self, strength: float) -> None:
        self.strength = strength
        self.fill, self.blocked, self.lot = 0.0, 0.0, 12345
        """s, s, state of the card's chance"""
        self.last = np.full(4, simulator.HOVER)

    def step(self, s: Situation) -> Change:
        if self.blocked > 0.0:
            self.blocked -= s.dt
            return Change(command=self.last.copy())
        self.last = np.array(s.command, dtype=float)
        self.fill += s.dt
        if self.fill >= self.FILL:
            self.fill = 0.0
            self.lot = (1103515245 * self.lot + 12345) % 2**31
            chance = self.lot / 2**31
            # mostly a plain write, now and then the card tidies up
            pause = 0.04 + 0.04 * chance if chance < 0.8 else 0.12
            self.blocked = pause * self.strength
        return Change()


PLANTS = (
    Plant('parcel swinging on a cord below', BottleOnCord, SET, 800, False),
    Plant('speed controllers without brake, motors coast down', CoastingMotors, SET, 801, False),
    Plant('rotors blow back against the travel', BlowBack, SET, 802, False),
    Plant('scorched battery plug drops volts and heats', BurntPlug, SET, 803, False),
    Plant('loose propeller slips on its shaft', LoosePropeller, SET, 804, False),
    Plant('flight controller on foam too soft', BoardOnFoam, SET, 805, False),
    Plant('rig bearing rubs and sticks', RubbingBearing, SET, 806, True),
    Plant('stiff supply cable at the rig', StiffSupplyCable, SET, 807, True),
    Plant('battery slides in its strap on the rig', SlidingBattery, SET, 808, True),
    Plant('slender post of the rig sways', SwayingStand, SET, 809, True),
    Plant('rig low over a bench, cushion of air', LowOverTheBench, SET, 810, True),
    Plant('slow memory card blocks the motor output', SlowMemoryCard, SET, 811, True),
)
