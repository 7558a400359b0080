"""A craft: where its motors are and which way they turn, and the mixer that follows. Pure.

Read from a URDF (`/robot_description`), from an autopilot's parameters, or by a layout's name. The
bridge has this file, and quad_sysid has it by a link (`quad_sysid/craft.py`); it imports neither.
Body frame FLU: x forward, y left, z up. Files and topics are opened by others.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from xml.etree import ElementTree as ET

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

AXES = ('roll', 'pitch', 'yaw')
ARM_M = 0.2
"""Length of the longest arm where only the arms' directions are known."""
MOST_TILT = 0.5
"""Least share of a propeller's axis that must point up or down; it lifts, else it is a tail's."""
RANGE_US = (1000.0, 2000.0)
"""Pulses of the commands 0 and 1 of a speed controller as it is sold."""
BODY = 'base_link'
JOINT = 'motor_'
ON_AXIS = 0.05
"""A motor off the centre line by less than this share of the longest arm is on it."""


@dataclass(frozen=True)
class Motor:
    """A motor with its propeller."""

    x: float
    """Forward of the body frame's origin, m."""
    y: float
    """To the left of the body frame's origin, m."""
    spin: int
    """1 where the propeller turns counter-clockwise seen from above, -1 where clockwise."""
    z: float = 0.0
    """Above the body frame's origin, m."""


@dataclass(frozen=True)
class Craft:
    """The motors in the order of `/motors/command`, and the body where it is known."""

    name: str
    """Name in messages, such as `the project's X frame`."""
    motors: tuple[Motor, ...]
    mass_kg: float | None = None
    inertia: tuple[float, float, float] | None = None
    """Ixx, Iyy, Izz of the body, kg m²."""
    nominal: bool = False
    """Whether only the directions of the arms are known, so that their length is ARM_M."""

    @cached_property
    def inverse(self) -> FloatArray:
        """(4, n): U1..U4 = inverse @ motors.

        Roll goes with y, pitch with -x, yaw against the spin; each row has a sum of magnitudes
        of 1. A row of zeros belongs to an axis that the motors cannot turn.
        """
        x, y, spin = (np.array([getattr(m, name) for m in self.motors], dtype=float)
                      for name in ('x', 'y', 'spin'))
        rows = np.stack([np.ones(x.size), y, -x, -spin])
        size = np.abs(rows).sum(axis=1, keepdims=True)
        return _exact(rows / np.where(size > 1e-9 * x.size, size, np.inf))

    @cached_property
    def mixer(self) -> FloatArray:
        """(n, 4): motors = mixer @ (U1, U2, U3, U4), the smallest commands that give a control."""
        return _exact(np.linalg.pinv(self.inverse))

    def control(self, motors: FloatArray) -> FloatArray:
        """The plant's input U1..U4 (k, 4) of motor commands (k, n), normalised."""
        return np.asarray(motors @ self.inverse.T, dtype=np.float64)

    def commands(
        self, control: FloatArray, desaturation: str = 'clip', idle: float = 0.0
    ) -> FloatArray:
        """Motor commands (k, n) in idle..1 of a control U1..U4 (k, 4).

        By `clip` each motor is limited by itself. By `yaw_first` yaw is what the motors have left,
        then the throttle moves, and only where roll and pitch alone need more than the motors have
        are both made smaller by one factor: the firmware's quad_mix, for any number of motors.
        """
        if desaturation == 'yaw_first':
            control = self._fitted(control, idle)
        limited: FloatArray = np.clip(control @ self.mixer.T, idle, 1.0)
        return limited

    def _fitted(self, control: FloatArray, idle: float) -> FloatArray:
        """The control that the motors can give, roll and pitch first."""
        lift, spin = self.mixer[:, 0], self.mixer[:, 3]
        turning = control[:, 1:3] @ self.mixer[:, 1:3].T
        span = turning.max(axis=1) - turning.min(axis=1)
        share = np.minimum(1.0, (1.0 - idle) / np.maximum(span, 1e-300))[:, None]
        lowest = ((idle - share * turning) / lift).max(axis=1)
        throttle = np.maximum(lowest, np.minimum(
            ((1.0 - share * turning) / lift).min(axis=1), control[:, 0]))
        here = throttle[:, None] * lift + share * turning
        turns = np.abs(spin) > 0.0
        ends = np.stack([np.minimum(0.0, idle - here[:, turns]) / spin[turns],
                         np.maximum(0.0, 1.0 - here[:, turns]) / spin[turns]])
        yaw = np.maximum(ends.min(axis=0).max(axis=1, initial=-np.inf),
                         np.minimum(ends.max(axis=0).min(axis=1, initial=np.inf), control[:, 3]))
        return np.column_stack([throttle, share * control[:, 1:3], yaw])

    @property
    def count(self) -> int:
        """Number of motors."""
        return len(self.motors)

    @cached_property
    def signs(self) -> tuple[tuple[int, ...], ...]:
        """(motors, 3) signs with which more of a motor turns roll, pitch and yaw; 0 for none."""
        size = np.abs(self.inverse[1:]).max(axis=1, keepdims=True)
        clear = np.where(np.abs(self.inverse[1:]) > ON_AXIS * size, self.inverse[1:], 0.0)
        return tuple(tuple(int(s) for s in np.sign(column)) for column in clear.T)

    @cached_property
    def places(self) -> tuple[str, ...]:
        """Each motor's place in words: `rear left`, `front`."""
        reach = max(math.hypot(m.x, m.y) for m in self.motors)

        def word(value: float, ahead: str, behind: str) -> str:
            return '' if abs(value) <= ON_AXIS * reach else ahead if value > 0.0 else behind

        return tuple(' '.join(filter(None, (word(m.x, 'front', 'rear'),
                                            word(m.y, 'left', 'right')))) or 'centre'
                     for m in self.motors)

    def where_motors_are(
        self, signs: Mapping[str, Mapping[str, int]]
    ) -> tuple[dict[str, str], list[str]]:
        """Motor channel to what is known of its place, in words, and the faults.

        `signs` gives 1, -1 or 0 for each of `motor_1` to `motor_n` and each axis that is known.
        """
        words, faults = {}, []
        for k, (name, expected) in enumerate(zip(self.places, self.signs, strict=True), 1):
            known = signs.get(f'{JOINT}{k}', {})
            level = [axis for axis in known if axis != 'yaw']
            fits = dict.fromkeys(
                place for place, row in zip(self.places, self.signs, strict=True)
                if all(known[axis] == row[AXES.index(axis)] for axis in level)
            )
            here = words[f'{JOINT}{k}'] = ' or '.join(fits) if known else 'unknown'
            bad = [axis for axis, sign in known.items() if sign != expected[AXES.index(axis)]]
            if set(bad) & set(level):
                faults.append(f'{JOINT}{k} drives the {here or "wrong place"}, must be the {name}')
            elif bad:
                faults.append(f'{JOINT}{k} turns the wrong way')
        return words, faults

    def to_urdf(self) -> str:
        """The craft as `/robot_description` carries it."""
        robot = ET.Element('robot', name='craft')
        comment = self.name + ('; lengths of arms are nominal, their directions true'
                               if self.nominal else '')
        robot.append(ET.Comment(f' {comment.replace("--", "- ")} '))
        body = ET.SubElement(robot, 'link', name=BODY)
        if self.mass_kg is not None and self.inertia is not None:
            inertial = ET.SubElement(body, 'inertial')
            ET.SubElement(inertial, 'mass', value=f'{self.mass_kg:.9g}')
            ixx, iyy, izz = (f'{value:.9g}' for value in self.inertia)
            ET.SubElement(inertial, 'inertia', ixx=ixx, iyy=iyy, izz=izz,
                                   ixy='0', ixz='0', iyz='0')
        for k, motor in enumerate(self.motors, 1):
            ET.SubElement(robot, 'link', name=f'propeller_{k}')
            joint = ET.SubElement(robot, 'joint', name=f'{JOINT}{k}', type='continuous')
            ET.SubElement(joint, 'parent', link=BODY)
            ET.SubElement(joint, 'child', link=f'propeller_{k}')
            ET.SubElement(joint, 'origin',
                                   xyz=' '.join(f'{v:.9g}' for v in (motor.x, motor.y, motor.z)))
            ET.SubElement(joint, 'axis', xyz=f'0 0 {motor.spin}')
        ET.indent(robot)
        return ET.tostring(robot, encoding='unicode') + '\n'


def _exact(matrix: npt.NDArray[np.floating]) -> FloatArray:
    """Read-only, without the rounding of the algebra: an X frame's entries are whole quarters."""
    out = np.asarray(np.round(matrix, 12) + 0.0, dtype=np.float64)
    out.setflags(write=False)
    return out


# ------------------------------------------------------------------------------------ the URDF


def from_urdf(text: str) -> Craft | None:
    """The craft of a URDF; None where it has no joint `motor_i` (a model made for drawing).

    Raises ValueError, one sentence that names the joint, where it is not whole.
    """
    try:
        robot = ET.fromstring(text)  # noqa: S314 - expat limits what entities expand to
    except ET.ParseError as error:
        raise ValueError(f'is no XML: {error}') from error
    joints = [*robot.iter('joint')]
    numbered = {int(match[1]): joint for joint in joints
                if (match := re.fullmatch(f'{JOINT}([0-9]+)', joint.get('name', '')))}
    numbers = sorted(numbered)
    if not numbers:
        return None
    if numbers != list(range(1, len(numbers) + 1)):
        raise ValueError(f'has the joints {", ".join(f"{JOINT}{k}" for k in numbers)}: number '
                         f'them from {JOINT}1 without a gap')
    above = {_link(joint, 'child'): joint for joint in joints}
    motors = tuple(_motor(f'{JOINT}{k}', numbered[k], above) for k in numbers)
    if len({(m.x, m.y, m.z, m.spin) for m in motors}) == 1 < len(motors):
        raise ValueError('has all motors in one place: give each joint its origin')
    mass, inertia = _body(robot)
    return Craft('its description', motors, mass, inertia)


def _motor(name: str, joint: ET.Element, above: Mapping[str, ET.Element]) -> Motor:
    if joint.get('type') != 'continuous':
        raise ValueError(f'{name} is of type {joint.get("type")}: a motor is continuous')
    axis, place = _numbers(name, joint, 'axis', 'xyz', (1.0, 0.0, 0.0)), np.zeros(3)
    size, link = float(np.linalg.norm(axis)), joint
    if not size > 0.0:
        raise ValueError(f'{name} has an axis of length 0')
    axis = axis / size
    for _ in range(len(above) + 1):  # up to the body, through what carries the motor
        turn = rotation_of(_numbers(name, link, 'origin', 'rpy', (0.0, 0.0, 0.0)))
        axis, place = turn @ axis, turn @ place + _numbers(name, link, 'origin', 'xyz',
                                                           (0.0, 0.0, 0.0))
        parent = _link(link, 'parent')
        if parent == BODY or parent not in above:
            break
        link = above[parent]
    if abs(axis[2]) < MOST_TILT:
        raise ValueError(f'{name} has the axis {axis.round(3).tolist()} in the body: a propeller '
                         'that lifts has 0 0 1 (counter-clockwise) or 0 0 -1')
    return Motor(float(place[0]), float(place[1]), int(np.sign(axis[2])), float(place[2]))


def _link(joint: ET.Element, end: str) -> str:
    element = joint.find(end)
    return '' if element is None else element.get('link', '')


def _numbers(
    name: str, joint: ET.Element, tag: str, field: str, otherwise: Iterable[float]
) -> FloatArray:
    element = joint.find(tag)
    text = None if element is None else element.get(field)
    if text is None:
        return np.array([*otherwise])
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.zeros(0)
    if values.size != 3 or not np.isfinite(values).all():
        raise ValueError(f'{name} has the {tag} {field} "{text}": three numbers are needed')
    return values


def rotation_of(rpy: FloatArray) -> FloatArray:
    """(3, 3) to the outer frame from one turned by roll, pitch, yaw in it (ZYX)."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    return np.array([
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ])


def _body(robot: ET.Element) -> tuple[float | None, tuple[float, float, float] | None]:
    for link in robot.iter('link'):
        mass, inertia = link.find('inertial/mass'), link.find('inertial/inertia')
        if link.get('name') == BODY and mass is not None and inertia is not None:
            try:
                kg = float(mass.get('value', ''))
                ixx, iyy, izz = (float(inertia.get(name, '')) for name in ('ixx', 'iyy', 'izz'))
            except ValueError:
                raise ValueError(f'{BODY} has an inertial without numbers') from None
            if min(kg, ixx, iyy, izz) > 0.0 and math.isfinite(kg + ixx + iyy + izz):
                return kg, (ixx, iyy, izz)
    return None, None


# ---------------------------------------------------------------------------- named layouts


def _ring(text: str) -> tuple[Motor, ...]:
    """Motors on a circle: degrees clockwise from the nose, + where counter-clockwise."""
    motors = []
    for word in text.split():
        angle = math.radians(float(word[:-1]))
        motors.append(Motor(math.cos(angle), -math.sin(angle), 1 if word[-1] == '+' else -1))
    return _scaled(motors)


def _at(text: str) -> tuple[Motor, ...]:
    """Motors by `forward,left` in any unit, + where counter-clockwise."""
    motors = []
    for word in text.split():
        x, y = (float(number) for number in word[:-1].split(','))
        motors.append(Motor(x, y, 1 if word[-1] == '+' else -1))
    return _scaled(motors)


def craft_at(
    name: str, x: Iterable[float], y: Iterable[float], spins: Iterable[int]
) -> Craft:
    """A craft of motors whose places are known up to their scale."""
    motors = (Motor(float(a), float(b), spin) for a, b, spin in zip(x, y, spins, strict=True))
    return Craft(name, _scaled(motors), nominal=True)


def _scaled(motors: Iterable[Motor]) -> tuple[Motor, ...]:
    motors = tuple(motors)
    unit = ARM_M / max(math.hypot(m.x, m.y) for m in motors)
    return tuple(replace(m, x=round(unit * m.x, 6), y=round(unit * m.y, 6)) for m in motors)


X = Craft("the project's X frame", _at('-1,1- -1,-1+ 1,-1- 1,1+'), nominal=True)
"""Rear left, rear right, front right, front left; what holds without a description."""
X_ORDERS = {
    'X': '45+ -135+ -45- 135-', 'H': '45- -135- -45+ 135+', 'V': '45+ -135+ -45- 135-',
    'BF_X': '135- 45+ -135+ -45-', 'BF_X_REV': '135+ 45- -135- -45+',
    'DJI_X': '45+ -45- -135+ 135-', 'CW_X': '45+ 135- -135+ -45-',
}
ARDUPILOT_CLASSES = {1: 'quad', 2: 'hexa', 3: 'octa', 4: 'octaquad', 5: 'y6', 12: 'dodecahexa',
                     14: 'deca'}
ARDUPILOT_TYPES = {0: 'PLUS', 1: 'X', 2: 'V', 3: 'H', 6: 'PLUSREV', 10: 'Y6B', 11: 'Y6F',
                   12: 'BF_X', 13: 'DJI_X', 14: 'CW_X', 15: 'I', 18: 'BF_X_REV', 19: 'Y4'}
ARDUPILOT: dict[tuple[str, str], tuple[Motor, ...]] = {
    **{('quad', kind): _ring(text) for kind, text in X_ORDERS.items()},
    ('quad', 'PLUS'): _ring('90+ -90+ 0- 180-'), ('quad', 'PLUSREV'): _ring('90- -90- 0+ 180+'),
    ('quad', 'Y4'): _at('1,-1+ -1,0- -1,0+ 1,1-'),
    ('hexa', 'PLUS'): _ring('0- 180+ -120- 60+ -60+ 120-'),
    ('hexa', 'X'): _ring('90- -90+ -30- 150+ 30+ -150-'),
    ('hexa', 'H'): _at('0,-1- 0,1+ 1,1- -1,-1+ 1,-1+ -1,1-'),
    ('hexa', 'DJI_X'): _ring('30+ -30- -90+ -150- 150+ 90-'),
    ('hexa', 'CW_X'): _ring('30+ 90- 150+ -150- -90+ -30-'),
    ('octa', 'PLUS'): _ring('0- 180- 45+ 135+ -45+ -135+ -90- 90-'),
    ('octa', 'X'): _ring('22.5- -157.5- 67.5+ 157.5+ -22.5+ -112.5+ -67.5- 112.5-'),
    ('octa', 'V'): _at('.34,.83- -.32,-.67- -.32,.67+ -1,-.5+ 1,1+ .34,-.83+ 1,-1- -1,.5-'),
    ('octa', 'H'): _at('1,-1- -1,1- .333,-1+ -1,-1+ 1,1+ -.333,1+ .333,1- -.333,-1-'),
    ('octa', 'I'): _at('-1,.333- 1,-.333- -1,1+ 1,.333+ -1,-.333+ 1,-1+ -1,-1- 1,1-'),
    ('octa', 'DJI_X'): _ring('22.5+ -22.5- -67.5+ -112.5- -157.5+ 157.5- 112.5+ 67.5-'),
    ('octa', 'CW_X'): _ring('22.5+ 67.5- 112.5+ 157.5- -157.5+ -112.5- -67.5+ -22.5-'),
    ('octaquad', 'PLUS'): _ring('0+ -90- 180+ 90- -90+ 0- 90+ 180-'),
    ('octaquad', 'X'): _ring('45+ -45- -135+ 135- -45+ 45- 135+ -135-'),
    ('octaquad', 'V'): _ring('45+ -45- -135+ 135- -45+ 45- 135+ -135-'),
    ('octaquad', 'H'): _ring('45- -45+ -135- 135+ -45- 45+ 135- -135+'),
    ('octaquad', 'CW_X'): _ring('45+ 45- 135- 135+ -135+ -135- -45- -45+'),
    ('octaquad', 'BF_X'): _ring('135- 45+ -135+ -45- 135+ 45- -135- -45+'),
    ('octaquad', 'BF_X_REV'): _ring('135+ 45- -135- -45+ 135- 45+ -135+ -45-'),
    ('y6', 'Y6B'): _at('.5,-1- .5,-1+ -1,0- -1,0+ .5,1- .5,1+'),
    ('y6', 'Y6F'): _at('-1,0+ .5,-1+ .5,1+ -1,0- .5,-1- .5,1-'),
    ('y6', ''): _at('.666,-1+ .666,1- .666,1+ -1.333,0- .666,-1- -1.333,0+'),
    ('dodecahexa', 'PLUS'): _ring('0+ 0- 60- 60+ 120+ 120- 180- 180+ -120+ -120- -60- -60+'),
    ('dodecahexa', 'X'): _ring('30+ 30- 90- 90+ 150+ 150- -150- -150+ -90+ -90- -30- -30+'),
    ('deca', 'PLUS'): _ring('0+ 36- 72+ 108- 144+ 180- -144+ -108- -72+ -36-'),
    **{('deca', kind): _ring('18+ 54- 90+ 126- 162+ -162- -126+ -90- -54+ -18-')
       for kind in ('X', 'CW_X')},
}
"""By FRAME_CLASS and FRAME_TYPE (ArduPilot's AP_MotorsMatrix)."""
BETAFLIGHT_MIXERS = (
    '', 'TRI', 'QUADP', 'QUADX', 'BICOPTER', 'GIMBAL', 'Y6', 'HEX6', 'FLYING_WING', 'Y4', 'HEX6X',
    'OCTOX8', 'OCTOFLATP', 'OCTOFLATX', 'AIRPLANE', 'HELI_120_CCPM', 'HELI_90_DEG', 'VTAIL4',
    'HEX6H', 'PPM_TO_SERVO', 'DUALCOPTER', 'SINGLECOPTER', 'ATAIL4', 'CUSTOM', 'CUSTOMAIRPLANE',
    'CUSTOMTRI', 'QUADX1234',
)
"""Names of Betaflight's mixers by their number."""
BETAFLIGHT: dict[str, tuple[Motor, ...]] = {
    'QUADX': _ring('135- 45+ -135+ -45-'), 'QUADX1234': _ring('-45- 45+ 135- -135+'),
    'QUADP': _ring('180- 90+ -90+ 0-'),
    'HEX6': _ring('120+ 60- -120+ -60- 0+ 180-'), 'HEX6X': _ring('150+ 30+ -150- -30- 90- -90+'),
    'Y6': _at('-1.333,0+ .666,-1- .666,1- -1.333,0- .666,-1+ .666,1+'),
    'Y4': _at('-1,0- 1,-1+ -1,0+ 1,1-'),
    'OCTOX8': _ring('135- 45+ -135+ -45- 135+ 45- -135- -45+'),
    'OCTOFLATP': _ring('-45+ 45+ 135+ -135+ 0- 90- 180- -90-'),
    'OCTOFLATX': _ring('-67.5+ 22.5+ 112.5+ -157.5+ -22.5- 67.5- 157.5- -112.5-'),
}
"""With propellers "in" (yaw_motors_reversed = OFF), by the mixer's name."""
LAYOUTS: dict[str, Craft] = {
    'x': X,
    'plus': Craft('the plus frame front, right, rear, left', _ring('0- 90+ 180- -90+'),
                  nominal=True),
    'crazyflie': Craft('the Crazyflie', _ring('45+ 135- -135+ -45-'), nominal=True),
    'px4_quad_x': Craft("PX4's Quad X", _ring(X_ORDERS['X']), nominal=True),
    **{f'ardupilot_{kind}_{of}'.lower().rstrip('_'): Craft(
        f"ArduPilot's {kind} {of}".rstrip(), motors, nominal=True)
       for (kind, of), motors in ARDUPILOT.items()},
    **{f'betaflight_{name}'.lower(): Craft(f"Betaflight's {name}", motors, nominal=True)
       for name, motors in BETAFLIGHT.items()},
    **{f'betaflight_{name}_out'.lower(): Craft(
        f"Betaflight's {name}, propellers out",
        tuple(replace(m, spin=-m.spin) for m in motors), nominal=True)
       for name, motors in BETAFLIGHT.items()},
}
"""Crafts by a name that a user can type."""


# --------------------------------------------------------------------- autopilots' parameters


def of_px4(parameters: Mapping[str, float]) -> Craft | str:
    """The craft of PX4's CA_ROTOR parameters, or why they do not describe one.

    Before PX4 1.13 there were none, and no other parameter says where the motors are.
    """
    count = int(parameters.get('CA_ROTOR_COUNT', 0))
    if count < 2:
        return 'PX4 has no CA_ROTOR_COUNT'
    motors = []
    for i in range(count):
        x, y, z, up, km = (
            float(parameters.get(f'CA_ROTOR{i}_{name}', otherwise)) for name, otherwise in
            (('PX', 0.0), ('PY', 0.0), ('PZ', 0.0), ('AZ', -1.0), ('KM', 0.05))
        )
        if abs(up) < MOST_TILT or not km:
            return f'rotor {i + 1} of CA_ROTOR{i} does not lift, or has no CA_ROTOR{i}_KM'
        motors.append(Motor(x, -y, 1 if km > 0.0 else -1, -z))
    if len({(m.x, m.y) for m in motors}) < 2:
        return 'the CA_ROTOR parameters have all motors in one place'
    return Craft("PX4's CA_ROTOR parameters", tuple(motors))


def of_ardupilot(parameters: Mapping[str, float]) -> Craft | str:
    """The craft of ArduPilot's FRAME_CLASS and FRAME_TYPE (before 3.5 FRAME), or why not."""
    number = int(parameters.get('FRAME_CLASS', 1))
    kind = int(parameters.get('FRAME_TYPE', parameters.get('FRAME', 1)))
    frame = ARDUPILOT_CLASSES.get(number, ''), ARDUPILOT_TYPES.get(kind, '')
    if frame[0] == 'y6' and frame not in ARDUPILOT:
        frame = 'y6', ''
    motors = ARDUPILOT.get(frame)
    if motors is None:
        return f'FRAME_CLASS {number} with FRAME_TYPE {kind} is not one whose motors are known'
    return Craft(f"ArduPilot's {frame[0]} {frame[1]}".rstrip(), motors, nominal=True)


def ardupilot_channels(parameters: Mapping[str, float], count: int = 0) -> tuple[int, ...]:
    """The output channel (from 1) of each motor by SERVOn_FUNCTION; in order where that is silent.

    Functions 33 to 40 are motors 1 to 8, from 82 on the ninth and later. count: of the motors; 0:
    8, 6 or else 4, as many as have an output.
    """
    channels = {int(parameters[f'SERVO{n}_FUNCTION']): n for n in range(32, 0, -1)
                if f'SERVO{n}_FUNCTION' in parameters}
    count = count or next((n for n in (8, 6) if {*range(33, 33 + n)} <= channels.keys()), 4)
    named = tuple(channels.get(33 + k if k < 8 else 82 + k - 8, 0) for k in range(count))
    return named if all(named) else tuple(range(1, count + 1))


def ardupilot_range_us(parameters: Mapping[str, float]) -> tuple[float, float]:
    """Pulses of the commands 0 and 1: MOT_PWM_*, without both those of the throttle's stick.

    Up to Copter 4.0 that was the default; RANGE_US where neither is known.
    """
    stick = int(parameters.get('RCMAP_THROTTLE', 3.0))
    for name in ('MOT_PWM', f'RC{stick}'):
        low, high = (parameters.get(f'{name}_{end}', 0.0) for end in ('MIN', 'MAX'))
        if 0.0 < low < high:
            return low, high
    return RANGE_US


def of_betaflight(parameters: Mapping[str, float | str]) -> Craft | str:
    """The craft of Betaflight's `mixer` (name or number) and `yaw_motors_reversed`, or why not."""
    mixer = str(parameters.get('mixer', 'QUADX')).strip().upper()
    if mixer.replace('.0', '').isdecimal() and int(float(mixer)) < len(BETAFLIGHT_MIXERS):
        mixer = BETAFLIGHT_MIXERS[int(float(mixer))]
    motors = BETAFLIGHT.get(mixer)
    if motors is None:
        return f'the motors of the mixer {mixer} are not known'
    out = str(parameters.get('yaw_motors_reversed', 0)).strip().upper() in {'1', '1.0', 'ON'}
    reversed_motors = tuple(replace(m, spin=-m.spin) for m in motors) if out else motors
    return Craft(f"Betaflight's {mixer}, propellers {'out' if out else 'in'}", reversed_motors,
                 nominal=True)
