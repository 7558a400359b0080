"""Stand-ins of PX4 and ArduPilot that fly: the virtual aircraft's physics, the autopilot's law.

One class for both; what differs in flight is written beside each other here, by their sources: the
rate loops and their filters, OFFBOARD, GUIDED_NOGPS and SYSTEM ID with their conditions, PARAM_SET
and what it refuses in silence, logs and LOG_REQUEST_*. ~/arm takes off and lands. Vectors are FRD.
As a program (`python flying_autopilot.py px4 --link tty --lockstep SOCKET`) it is a process on a
pseudo-terminal that owns simulated time.
"""

import argparse
import contextlib
import math
import signal
import sys
import tempfile
from collections import deque
from dataclasses import replace
from pathlib import Path

import numpy as np
from autopilot_logs import dataflash, quaternions, ulog
from autopilots import ACCEPTED, ARDUPILOT, ARM_DISARM, INERTIAL, PX4, Autopilot, mav
from flight_controller import Pty

from quad_bridge.craft import X
from quad_bridge.lockstep import START_NS, WIRE
from quad_bridge.virtual.aircraft import Aircraft
from quad_bridge.virtual.cycle import NORMALS_PER_STEP, move_cycle
from quad_bridge.virtual.line import Line
from quad_bridge.virtual.physics import POSITION, QUAT, RATES, VELOCITY
from quad_bridge.virtual.profile import load_profile
from quad_bridge.wire.axes import angles_of, quaternion

DT = 0.004
DO_SET_MODE, REQUEST_MESSAGE, DENIED = 176, 512, 2
DRAWN = 250  # cycles whose random numbers are drawn at once
MIXER = X.mixer.tolist()
OUTPUTS = (2, 0, 3, 1)
"""Motor of the contract's frame (rear left, rear right, front right, front left) at each output of
PX4's Quad X: front right, rear left, front left, rear right."""
OFFBOARD, POSITION_MODE, STABILIZED = 6 << 16, 3 << 16, 7 << 16
STABILIZE, LOITER, GUIDED_NOGPS, SYSTEM_ID = 0, 5, 20, 25
LIFT_OFF_S = 0.5
ASKED_STEPS = 55  # until ArduPilot answers a question for a parameter, about
PX4_GAINS = {
    **{f'MC_{a}_P': 6.5 for a in ('ROLL', 'PITCH')}, 'MC_YAW_P': 2.8,
    **{f'MC_{a}RATE_{n}': v for a in ('ROLL', 'PITCH')
       for n, v in {'P': 0.05, 'I': 0.05, 'D': 0.0008, 'FF': 0.0, 'K': 1.0, 'MAX': 220.0}.items()},
    **{f'MC_YAWRATE_{n}': v for n, v in {'P': 0.2, 'I': 0.1, 'D': 0.0, 'FF': 0.0, 'K': 1.0,
                                         'MAX': 200.0}.items()},
    **{f'MC_{a}R_INT_LIM': 0.3 for a in 'RPY'},
    'IMU_GYRO_CUTOFF': 40.0, 'IMU_DGYRO_CUTOFF': 30.0, 'IMU_GYRO_NF0_FRQ': 0.0,
    'IMU_GYRO_NF0_BW': 20.0, 'MC_YAW_TQ_CUTOFF': 0.0, 'SDLOG_PROFILE': 25, 'MC_AIRMODE': 0,
    'MAV_FWDEXTSP': 1, 'COM_RC_OVERRIDE': 1, 'COM_OF_LOSS_T': 1.0, 'COM_OBL_RC_ACT': 0,
    'IMU_INTEG_RATE': 200,
}  # fmt: skip
ARDUPILOT_GAINS = {
    **{f'ATC_ANG_{a}_P': 4.5 for a in ('RLL', 'PIT', 'YAW')},
    **{f'ATC_RAT_{a}_{n}': v for a in ('RLL', 'PIT')
       for n, v in {'P': 0.07, 'I': 0.07, 'D': 0.001, 'FF': 0.0, 'IMAX': 0.5, 'FLTT': 20.0,
                    'FLTE': 0.0, 'FLTD': 20.0}.items()},
    **{f'ATC_RAT_YAW_{n}': v for n, v in {'P': 0.3, 'I': 0.03, 'D': 0.0, 'FF': 0.0, 'IMAX': 0.5,
                                          'FLTT': 20.0, 'FLTE': 2.5, 'FLTD': 0.0}.items()},
    **{f'ATC_RATE_{a}_MAX': 0.0 for a in 'RPY'},
    'INS_GYRO_FILTER': 40.0, 'MOT_THST_EXPO': 0.0, 'MOT_THST_HOVER': 0.4, 'MOT_SPIN_MIN': 0.0,
    'MOT_SPIN_MAX': 1.0, 'LOG_BITMASK': 180223, 'FLTMODE_GCSBLOCK': 0, 'SCHED_LOOP_RATE': 400,
    'GUID_OPTIONS': 0, 'GUID_TIMEOUT': 3.0,
    'SID_AXIS': 0, 'SID_MAGNITUDE': 15.0, 'SID_F_START_HZ': 0.5, 'SID_F_STOP_HZ': 40.0,
    'SID_T_FADE_IN': 15.0, 'SID_T_REC': 70.0, 'SID_T_FADE_OUT': 2.0,
}  # fmt: skip
MORE_HZ = {'ATTITUDE_TARGET': 100.0, 'LOCAL_POSITION_NED': 50.0, 'EXTENDED_SYS_STATE': 10.0}
FLYING_PX4 = replace(PX4, most_hz={**PX4.most_hz, **MORE_HZ}, parameters={
    **PX4.parameters, **PX4_GAINS,
    **{f'CA_ROTOR{k}_{axis}': v for k, place in enumerate(((1, 1), (-1, -1), (1, -1), (-1, 1)))
       for axis, v in zip(('PX', 'PY'), (0.16 * place[0], 0.16 * place[1]), strict=True)},
    **{f'CA_ROTOR{k}_KM': -0.05 if k < 2 else 0.05 for k in range(4)},  # turned: the contract's X
})  # fmt: skip
FLYING_ARDUPILOT = replace(ARDUPILOT, most_hz={**ARDUPILOT.most_hz, **MORE_HZ}, gauss=1.0,
                           parameters={
    **ARDUPILOT.parameters, **ARDUPILOT_GAINS, 'FRAME_TYPE': 18,
})  # fmt: skip
ARDUPILOT_OUTPUTS = (1, 2, 0, 3)  # BetaflightX, reversed: rear right, front right, rear left …
PX4_LOOPS = [
    [f'MC_{a}_P', f'MC_{a}RATE_MAX', *(f'MC_{a}RATE_{n}' for n in ('K', 'P', 'I', 'D', 'FF')),
     f'MC_{a[0]}R_INT_LIM', 'IMU_DGYRO_CUTOFF'] for a in ('ROLL', 'PITCH', 'YAW')
]  # fmt: skip
ARDUPILOT_LOOPS = [
    [f'ATC_ANG_{a}_P', *(f'ATC_RAT_{a}_{n}' for n in
                         ('P', 'I', 'D', 'FF', 'IMAX', 'FLTT', 'FLTE', 'FLTD'))]
    for a in ('RLL', 'PIT', 'YAW')
]  # fmt: skip
"""The parameters of each axis, in the order in which the loops name them."""


class Low:
    """A first-order low pass; 0 Hz is none."""

    def __init__(self):
        self.y = None

    def __call__(self, x, hz):
        if hz <= 0.0 or self.y is None:
            self.y = x
        else:
            self.y = self.y + DT / (DT + 1.0 / (math.tau * hz)) * (x - self.y)
        return self.y


class Flying(Autopilot):
    """See the module. `armed`, `sticks`, `parameters` and the rest may be set by a test."""

    def __init__(self, kind, *, takes_off=True, uid=0x1234, **changed):
        super().__init__(kind, **changed)
        self.px4 = self.kind.autopilot == 12
        self.parameters = {n: v if isinstance(v, int) else float(np.float32(v))
                           for n, v in self.parameters.items()}  # fmt: skip
        profile = replace(load_profile('plain'), mount='hover')
        self.craft = Aircraft(profile, seed=1)
        self.rng, self.drawn = np.random.default_rng(1), iter(())
        self.uid = uid
        self.outputs = OUTPUTS if self.px4 else ARDUPILOT_OUTPUTS
        self.pilot_mode = POSITION_MODE if self.px4 else STABILIZE
        self.mode, self.armed, self.up_s = self.pilot_mode, False, -1.0
        self.sticks = [0.0, 0.0, 0.0, 0.0]  # roll, pitch, throttle, yaw, -1..1
        self.volts = 12.4
        self.target, self.targets = None, deque(maxlen=200)
        """The last SET_ATTITUDE_TARGET, and when they came."""
        self.written = []  # PARAM_SET as they were taken: name and value
        self.rows, self.said = [], []  # of its log: a row per cycle; SIDS
        self.filters = [[Low() for _ in range(3)] for _ in range(3)]
        self.gyro = [[Low() for _ in range(3)] for _ in range(2)]
        self.integral, self.before = [0.0] * 3, [0.0] * 3
        self.measured, self.torque, self.motors = [0.0] * 3, [0.0] * 3, [0.0] * 4
        self.rate_sp, self.att_sp, self.thrust = [0.0] * 3, [0.0] * 3, 0.0
        self.heading = None
        self.sid_s = None
        self.injected = 0.0
        self.log, self.log_number, self.landed_s = b'', 1, -math.inf
        self.turn()
        self.sending = deque()
        self.sends = 20  # LOG_DATA in a cycle
        self.timed_us = 0  # of the last message with rates or angles
        if takes_off:
            self.take_off()

    # Flight.

    @property
    def now_s(self):
        return 1e-6 * (self.now_us - self.boot_us)

    @property
    def in_air(self):
        return self.armed and self.up_s >= 0.0 and self.now_s - self.up_s > LIFT_OFF_S

    def take_off(self):
        self.armed, self.up_s, self.mode = True, self.now_s, self.pilot_mode
        state = self.craft.machine.state
        for first in (POSITION, VELOCITY, RATES):
            state[first : first + 3] = 0.0
        state[QUAT : QUAT + 4] = (1.0, 0.0, 0.0, 0.0)
        self.turn()
        self.rows, self.said = [], []

    def land(self):
        self.armed, self.up_s, self.mode = False, -1.0, self.pilot_mode
        self.motors = [0.0] * 4
        self.log, self.landed_s = self.finished_log(), self.now_s

    def cycle(self):
        if self.armed:
            self.step_physics()
        self.share = 0.25 if self.sending and not self.px4 else 1.0  # streams give way to its log
        out = super().cycle()
        for _ in range(min(self.sends, len(self.sending))):
            out += self.pack(self.sending.popleft())
        return out

    def turn(self):
        """Note the state, and roll, pitch, yaw, FRD in NED."""
        self.state = self.craft.machine.state.tolist()
        roll, pitch, yaw = angles_of(self.state[QUAT : QUAT + 4])
        self.angles = [roll, -pitch, math.remainder(0.5 * math.pi - yaw, math.tau)]

    def draw(self):
        """The random numbers of the next cycle: the physics', and noise of the rates."""
        drawn = next(self.drawn, None)
        if drawn is None:
            steps = self.craft.profile.firmware.physics_steps_per_cycle
            self.drawn = zip(self.rng.standard_normal((DRAWN, steps * NORMALS_PER_STEP)),
                             (0.004 * self.rng.standard_normal((DRAWN, 3))).tolist(), strict=True)
            drawn = next(self.drawn)
        return drawn

    def step_physics(self):
        normals, noise = self.draw()
        p, q, r = self.state[RATES : RATES + 3]
        cut = self.parameters['IMU_GYRO_CUTOFF' if self.px4 else 'INS_GYRO_FILTER']
        first, second = self.gyro
        self.measured = [second[i](first[i](rate + noise[i], 1.5 * cut), 1.5 * cut)
                         for i, rate in enumerate((p, -q, -r))]
        self.follow()
        self.control()
        self.note_log()
        flat, yaw = (math.sqrt(0.5), 1.0) if self.px4 else (0.5, 0.5)
        u1, u2, u3, u4 = (self.thrust, flat * self.torque[0], -flat * self.torque[1],
                          -yaw * self.torque[2])
        self.motors = [min(max(a * u1 + b * u2 + c * u3 + d * u4, 0.0), 1.0)
                       for a, b, c, d in MIXER]
        move_cycle(self.craft.machine, self.step, np.array(self.motors), normals)
        self.turn()

    def follow(self):
        """What the loops are to follow in this mode: attitude or rates, and thrust."""
        (x, y, z), (vx, vy, vz) = (self.state[at : at + 3] for at in (POSITION, VELOCITY))
        self.heading = self.angles[2] if self.heading is None else self.heading
        held = self.craft.hover_throttle - 0.05 * z - 0.06 * vz
        self.thrust, self.rate_only = min(max(held, 0.1), 0.9), None
        lean = [math.radians(30.0) * stick for stick in self.sticks[:2]]
        if self.mode in {POSITION_MODE, LOITER}:
            back = (0.05 * y + 0.1 * vy, 0.05 * x + 0.1 * vx)
            lean = [at + min(max(more, -0.2), 0.2) for at, more in zip(lean, back, strict=True)]
        self.att_sp = [*lean, self.heading]
        if self.mode in {OFFBOARD, GUIDED_NOGPS}:
            if self.target is None or self.now_s - self.targets[-1] >= 1.0:
                self.mode = self.pilot_mode
                return
            if self.target.type_mask & 7 == 7:
                self.att_sp = angles_of(self.target.q)
            else:
                self.rate_only = (self.target.body_roll_rate, self.target.body_pitch_rate,
                                  self.target.body_yaw_rate)
            if self.mode == OFFBOARD:
                self.thrust = self.target.thrust
        if self.mode == SYSTEM_ID:
            self.system_id()

    def system_id(self):
        p, t = self.parameters, self.now_s - self.sid_s - 1.0
        first, last = p['SID_F_START_HZ'], p['SID_F_STOP_HZ']
        record, steady = p['SID_T_REC'], 2.0 / first
        whole = p['SID_T_FADE_IN'] + steady + record + p['SID_T_FADE_OUT']
        self.injected = 0.0
        if not 0.0 < t < whole:
            return
        window = min(1.0, t / p['SID_T_FADE_IN'], (whole - t) / p['SID_T_FADE_OUT'])
        if t < steady:
            phase = math.tau * first * (t - steady)
        else:
            b = math.log(last / first)
            phase = math.tau * first * record / b * (math.exp(b * (t - steady) / record) - 1.0)
        self.injected = p['SID_MAGNITUDE'] * window * math.sin(phase)

    def control(self):
        p, loop = self.parameters, self.px4_loop if self.px4 else self.ardupilot_loop
        names = PX4_LOOPS if self.px4 else ARDUPILOT_LOOPS
        out = []
        for i in range(3):
            wrap = math.remainder(self.att_sp[i] - self.angles[i], math.tau)
            most = math.radians(p[names[i][1]]) if self.px4 else 12.0
            wanted = min(max(p[names[i][0]] * wrap, -most), most)
            self.rate_sp[i] = wanted if self.rate_only is None else self.rate_only[i]
            torque, limit = loop(i, self.rate_sp[i], self.measured[i], *(p[n] for n in names[i]))
            self.integral[i] = min(max(self.integral[i], -limit), limit)
            out.append(torque)
        if self.mode == SYSTEM_ID and p['SID_AXIS']:  # at the mixer's input
            out[int(p['SID_AXIS']) - 10] += self.injected
        self.torque = [min(max(v, -1.0), 1.0) if math.isfinite(v) else 0.0 for v in out]

    def px4_loop(self, i, wanted, y, _angle, _most, k, kp, ki, kd, ff, limit, cut):
        error, d = wanted - y, self.filters[i][0]((y - self.before[i]) / DT, cut)
        out = k * (kp * error - kd * d) + self.integral[i] + ff * wanted
        self.integral[i] += k * ki * error * DT
        self.before[i] = y
        return out, limit

    def ardupilot_loop(self, i, wanted, y, _angle, kp, ki, kd, ff, limit, fltt, flte, fltd):
        target, error, slope = self.filters[i]
        wanted = target(wanted, fltt)
        e = error(wanted - y, flte)
        out = kp * e + kd * slope((e - self.before[i]) / DT, fltd) + self.integral[i] + ff * wanted
        self.integral[i] += ki * e * DT
        self.before[i] = e
        return out, limit

    # Its log.

    def note_log(self):
        self.rows.append((self.now_us, *self.measured, *self.angles, *self.rate_sp, *self.att_sp,
                          self.thrust, *self.torque, *self.motors, self.volts,
                          self.injected if self.mode == SYSTEM_ID else math.nan))  # fmt: skip

    def finished_log(self):
        rows = np.array(self.rows)
        if len(rows) < 10:
            return b''
        t, gyro, angle = rows[:, 0], rows[:, 1:4], rows[:, 4:7]
        rate_sp, att_sp, thrust = rows[:, 7:10], rows[:, 10:13], rows[:, 13]
        torque = rows[:, 14:17]
        motors, volts, injected = rows[:, 17:21], rows[:, 21], rows[:, 22]
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / 'log'
            if self.px4:
                ulog(path, {
                    'vehicle_angular_velocity': {'timestamp': t, 'xyz': gyro},
                    'vehicle_attitude': {'timestamp': t[::2], 'q': quaternions(angle[::2])},
                    'vehicle_attitude_setpoint': {'timestamp': t[::5],
                                                  'q_d': quaternions(att_sp[::5])},
                    'vehicle_rates_setpoint': {
                        'timestamp': t[::2], **{n: rate_sp[::2, i] for i, n in
                                                enumerate(('roll', 'pitch', 'yaw'))}},
                    'actuator_motors': {'timestamp': t, 'control': motors[:, list(OUTPUTS)]},
                    'vehicle_torque_setpoint': {'timestamp': t, 'xyz': torque},
                    'vehicle_thrust_setpoint': {'timestamp': t, 'xyz': np.column_stack(
                        [0 * t, 0 * t, -thrust])},
                    'battery_status': {'timestamp': t[::50], 'voltage_v': volts[::50]},
                }, self.parameters)  # fmt: skip
            else:
                deg = 180.0 / math.pi
                sid = np.isfinite(injected)
                messages = {
                    'RATE': (('TimeUS', 'RDes', 'R', 'ROut', 'PDes', 'P', 'POut', 'YDes', 'Y',
                              'YOut', 'ADes', 'A', 'AOut'),
                             np.column_stack([t, *(c for i in range(3) for c in
                                                   (deg * rate_sp[:, i], deg * gyro[:, i],
                                                    torque[:, i])), thrust, thrust, thrust])),
                    'ATT': (('TimeUS', 'DesRoll', 'Roll', 'DesPitch', 'Pitch', 'DesYaw', 'Yaw'),
                            np.column_stack([t, *(c for i in range(3) for c in
                                                  (deg * att_sp[:, i], deg * angle[:, i]))])[::5]),
                    'BAT': (('TimeUS', 'Instance', 'Volt'),
                            np.column_stack([t, 0 * t, volts])[::50]),
                    'EV': (('TimeUS', 'Id'), [(t[0], 10), (t[-1], 11)]),  # armed, disarmed
                }  # fmt: skip
                if sid.any():
                    messages['SIDD'] = (('TimeUS', 'Time', 'Targ'),
                                        np.column_stack([t, 1e-6 * t, injected])[sid])
                    messages['SIDS'] = (('TimeUS', 'Ax', 'Mag', 'FSt', 'FSp', 'TFin', 'TC', 'TR',
                                         'TFout'), np.array(self.said))  # fmt: skip
                dataflash(path, messages, self.parameters)
            return path.read_bytes()

    # The line.

    @property
    def outputs_us(self):
        return [round(1000 + 1000 * self.motors[motor]) for motor in self.outputs]

    @property
    def sticks_us(self):
        return [round(1500 + 500 * stick) for stick in self.sticks]

    @property
    def pressure_hpa(self):
        return 1000.0 - self.state[POSITION + 2] / 8.43

    def moves(self):
        return self.angles, self.measured

    def message(self, name):
        if name in INERTIAL:
            self.timed_us = self.now_us
        ms = self.now_us // 1000 % 2**32
        if name == 'ATTITUDE_TARGET':
            x, y, z, w = quaternion(self.att_sp)
            return mav.MAVLink_attitude_target_message(
                ms, 0, (w, x, y, z), *self.rate_sp, self.thrust)
        if name == 'LOCAL_POSITION_NED':
            (e, n, u), (ve, vn, vu) = (self.state[at : at + 3] for at in (POSITION, VELOCITY))
            return mav.MAVLink_local_position_ned_message(ms, n, e, -u, vn, ve, -vu)
        if name == 'EXTENDED_SYS_STATE':
            return mav.MAVLink_extended_sys_state_message(0, 2 if self.in_air else 1)
        return super().message(name)

    def _answers(self, message):
        kind = message.get_type()
        if kind == 'SET_ATTITUDE_TARGET':
            self.target = message
            self.targets.append(self.now_s)
        elif kind == 'PARAM_SET':
            yield from self._set(message)
        elif kind == 'PARAM_REQUEST_READ' and not self.px4:  # from a queue, with the value of now
            for answer in super()._answers(message):
                self._late.append((self.step + ASKED_STEPS, self.pack(answer)))
        elif kind == 'LOG_REQUEST_LIST':
            if self.px4 or not self.armed:  # ArduPilot says nothing while armed
                open_s = 15.0 - (self.now_s - self.landed_s)  # ArduPilot writes on so long
                size = len(self.log) // (2 if open_s > 0.0 and not self.px4 else 1)
                if self.px4:  # from 0, in the directory's order, `last` is their count
                    yield mav.MAVLink_log_entry_message(0, 3, 3, 90, 1000)
                    yield mav.MAVLink_log_entry_message(self.log_number, 3, 3, 200, size)
                    yield mav.MAVLink_log_entry_message(2, 3, 3, 100, 2000)
                else:
                    yield mav.MAVLink_log_entry_message(
                        self.log_number, 1, self.log_number, 0, size)
        elif kind == 'LOG_REQUEST_DATA' and message.id == self.log_number:
            self.sending.clear()
            for at in range(message.ofs, min(message.ofs + message.count, len(self.log)), 90):
                part = self.log[at : min(at + 90, message.ofs + message.count)]
                self.sending.append(mav.MAVLink_log_data_message(
                    self.log_number, at, len(part), [*part, *bytes(90 - len(part))]))
        else:
            yield from super()._answers(message)

    def _set(self, message):
        name, value = message.param_id, message.param_value
        old = self.parameters.get(name)
        if old is None or (not self.px4 and not math.isfinite(value)):
            return
        if self.px4 and message.param_type != (6 if isinstance(old, int) else 9):
            return  # another type gets no answer
        new = value
        if isinstance(old, int):
            new = int(np.float32(value).view(np.int32)) if self.px4 else round(value)
        self.parameters[name] = new
        self.written.append((name, new))
        yield self.value(name)

    def _command(self, message):
        command = message.command
        if command == REQUEST_MESSAGE and message.param1 == 148:
            version = (1 << 24 | 16 << 16) if self.px4 else (4 << 24 | 6 << 16)
            self.sending.append(mav.MAVLink_autopilot_version_message(
                0, version, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, self.uid))
            return ACCEPTED
        if command == REQUEST_MESSAGE and message.param1 == 0:
            self._late.appendleft((self.step, self.heartbeat()))
            return ACCEPTED
        if command == ARM_DISARM and message.param1 and self.sending and not self.px4:
            self.sending.appendleft(mav.MAVLink_statustext_message(3, b'Arm: Downloading logs'))
            return DENIED
        if command == ARM_DISARM:
            (self.take_off if message.param1 else self.land)()
            return ACCEPTED
        if command == DO_SET_MODE:
            return self._set_mode(message)
        return super()._command(message)

    def _set_mode(self, message):
        wanted = int(message.param2) << 16 | int(message.param3) << 24 if self.px4 else int(
            message.param2)
        if wanted == OFFBOARD:
            streamed = len(self.targets) > 50 and self.now_s - self.targets[-50] < 2.0
            if not streamed or not self.armed:
                return DENIED
        if wanted == SYSTEM_ID:
            if self.mode != STABILIZE or not self.in_air or not self.parameters['SID_AXIS']:
                return DENIED
            self.sid_s, p = self.now_s, self.parameters
            self.said.append((self.now_us, p['SID_AXIS'], p['SID_MAGNITUDE'], p['SID_F_START_HZ'],
                              p['SID_F_STOP_HZ'], p['SID_T_FADE_IN'], 2 / p['SID_F_START_HZ'],
                              p['SID_T_REC'], p['SID_T_FADE_OUT']))  # fmt: skip
        self.mode, self.heading = wanted, None
        return ACCEPTED


# The process.


class Told(Line):
    """The clock of lockstep: the wire is waited for as far as messages with a time were sent."""

    sent_ns = START_NS

    def tell(self, now_ns):
        self.published = {WIRE: self.sent_ns}
        super().tell(now_ns)


def main(argv=None):
    """Fly behind a pseudo-terminal, in lockstep, until a signal."""
    parser = argparse.ArgumentParser()
    parser.add_argument('kind', choices=('px4', 'ardupilot'))
    parser.add_argument('--link', type=Path, required=True)
    parser.add_argument('--lockstep', type=Path, required=True)
    parser.add_argument('--hz', type=float, default=250.0)
    given = parser.parse_args(argv)
    kind = FLYING_PX4 if given.kind == 'px4' else FLYING_ARDUPILOT
    most = {name: min(hz, given.hz) for name, hz in kind.most_hz.items()}
    aircraft = Flying(kind, takes_off=False, most_hz=most, timesync_s=0.0)
    stopped = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stopped.append(1))
    end = Pty(given.link)
    line, unsent = Told(given.lockstep), bytearray()
    try:
        while not stopped:
            line.attend(0.0 if line.ready else 0.2)
            if line.ready and len(unsent) < 8000:
                unsent += aircraft.cycle()
                line.sent_ns = START_NS + 1000 * aircraft.timed_us
                line.tell(START_NS + 1000 * aircraft.now_us)
            if unsent:
                del unsent[: end.write(unsent)]
            with contextlib.suppress(OSError):
                unsent += aircraft.receive(end.read(), 1000 * aircraft.now_us)
    finally:
        end.close()
        line.close()


if __name__ == '__main__':
    sys.exit(main())
