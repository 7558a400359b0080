"""The firmware in C, in memory: all that the bridge can see of it."""

import math
import shutil

import numpy as np
import pytest
from node_process import ended

from quad_bridge.gains.protocol import checksum
from quad_bridge.gains.table import WIRE_NAMES
from quad_bridge.virtual import hil
from quad_bridge.virtual.aircraft import boot
from quad_bridge.virtual.native import NativeFirmware
from quad_bridge.virtual.profile import Profile
from quad_bridge.wire import frames as f
from quad_bridge.wire.codec import Decoder, Encoder

CYCLE_US = 4000
DIVIDER = 11.0
NAMES = tuple(WIRE_NAMES.values())
LEVEL = (0.0, 0.0, 0.0, 0.0, 0.0, 9.81)
"""A sample of gyro and accelerometer at rest, axes of the chips (FLU)."""


class Board:
    """The firmware at rest on a table, with Python's codec at its other end."""

    def __init__(self, *, armed=True, may_arm=True):
        self.decoder, self.encoder = Decoder(), Encoder(1, 191)
        self.firmware = NativeFirmware(boot(Profile()).frame())
        self.firmware.arm(armed, may_arm=may_arm)
        self.cycle = 0
        self.motors = ()

    def tell(self, *frames):
        """Frames to the board at the coming cycle's time; its answers."""
        return self.feed(b''.join(self.encoder.encode(x) for x in frames))

    def feed(self, data):
        return self.decoder.feed(self.firmware.receive(data, self.cycle * CYCLE_US))

    def run(
        self, cycles=1, *, kill=False, failsafe=False, battery_v=12.0, sample=LEVEL, throttle=0.5,
        sticks=(0.0, 0.0, 0.0), samples=4,
    ):  # fmt: skip
        """Cycles with these inputs; `sticks` roll, pitch, yaw; so many `samples` in each."""
        roll, pitch, yaw = (1500.0 + 500.0 * stick for stick in sticks)
        pulses = (roll, pitch, 1000.0 + 1000.0 * throttle, yaw, 2000.0 if kill else 1000.0,
                  *(1000.0,) * 4)  # fmt: skip
        slow, out = (battery_v / DIVIDER, 0.0, 0.24, -0.38, 1013.25, math.nan), []
        for _ in range(cycles):
            gyro = np.array([sample] * samples, dtype=float).reshape(-1, 6)
            frame = hil.sensors(self.cycle * CYCLE_US, pulses, failsafe, slow, gyro)
            self.motors = hil.motors(self.firmware.cycle(frame)).commands
            self.cycle += 1
            out += self.decoder.feed(self.firmware.send())
        return out

    def value(self, name):
        (answer,) = self.tell(f.ParamRequestRead(name))
        return answer.value

    def update(self, **wanted):
        """OPEN, PARAM_SET of each (ROLL_RATE_KP=…), COMMIT; the answer to the last."""
        values = dict(zip(NAMES, self.firmware.gains().tolist(), strict=True)) | wanted
        self.tell(f.GainsCommand(f.GainsAction.OPEN, 5))
        self.tell(*(f.ParamSet(name, value) for name, value in wanted.items()))
        check = checksum([values[name] for name in NAMES])
        return self.tell(f.GainsCommand(f.GainsAction.COMMIT, 5, check, 1000))[0]


def of(kind, frames):
    return [x for x in frames if isinstance(x, kind)]


def texts(frames):
    return [t.text for t in of(f.StatusText, frames)]


def test_all_parameters_are_listed_and_read_by_name_and_by_index():
    made = Board()
    frames = made.tell(f.ParamRequestList(1, 1)) + made.run(60)  # spread over the cycles
    values = of(f.ParamValue, frames)
    assert [(v.name, v.index, v.count) for v in values] == [
        (name, k, len(NAMES)) for k, name in enumerate(NAMES)
    ]
    assert [v.value for v in values] == [made.value(name) for name in NAMES]
    assert len(of(f.Cycle, frames)) == 60
    by_index = f.ParamRequestRead('', NAMES.index('GYRO_FILT_HZ'))
    assert made.tell(by_index) == made.tell(f.ParamRequestRead('GYRO_FILT_HZ'))
    assert made.value('GYRO_FILT_HZ') == 42.0
    assert texts(made.tell(f.ParamRequestRead('NO_SUCH'))) == ['unknown parameter NO_SUCH']


def test_refused_values_and_a_wrong_checksum_change_nothing():
    made = Board()
    made.run()
    before = {name: made.value(name) for name in NAMES}
    for name, value in (
        *(('ROLL_RATE_KP', v) for v in (9.0, -1.0, 1e30, float('nan'), float('inf'))),
        ('LOOP_RATE_HZ', 500.0), ('GYRO_FILT_HZ', 1000.0),
    ):  # fmt: skip
        (answer,) = made.tell(f.ParamSet(name, value))
        assert answer.value == before[name], (name, value)
    assert made.update(ROLL_RATE_KP=9.0).result == f.GainsResult.CHECKSUM
    made.tell(f.GainsCommand(f.GainsAction.REVERT, 5))
    assert texts(made.tell(f.ParamSet('SIXTEEN_LETTERS_', 1.0))) == [
        'unknown parameter SIXTEEN_LETTERS_'
    ]
    made.run()
    assert {name: made.value(name) for name in NAMES} == before


@pytest.mark.parametrize(('valid_ms', 'cycles'), [(100, 26), (60_000, 126)])
def test_an_excitation_ends_when_it_is_stale_after_half_a_second_at_the_latest(valid_ms, cycles):
    made = Board()
    made.run()
    made.tell(f.Excitation((0.1, 0.0, -0.2), int(f.Injection.RATE), 7, valid_ms=valid_ms))
    frames = made.run(200)
    excited = [c for c in of(f.Cycle, frames) if c.flags & f.Flag.EXCITATION]
    assert len(excited) == cycles  # until more than 0.5 s old
    assert excited[0].excitation == pytest.approx((0.1, 0.0, -0.2), rel=1e-6)
    assert (excited[0].excitation_seq, excited[0].injection) == (7, f.Injection.RATE)
    last = of(f.Cycle, frames)[-1]
    assert last.excitation == (0.0, 0.0, 0.0)
    assert last.flags & f.Flag.STALE_SETPOINT
    assert 'excitation stale, dropped' in texts(frames)


@pytest.mark.parametrize(
    ('value', 'injection'), [(5.1, 2), (0.6, 1), (0.31, 3), (float('nan'), 2), (0.0, 9)]
)
def test_an_excitation_beyond_its_limits_is_refused(value, injection):
    made = Board()
    made.tell(f.Excitation((0.0, value, 0.0), injection, 1))
    (cycle,) = of(f.Cycle, made.run())
    assert cycle.flags & f.Flag.EXCITATION_REFUSED
    assert not cycle.flags & f.Flag.EXCITATION


UNSAFE = [{'kill': True}, {'failsafe': True}, {'battery_v': 5.0}, {'throttle': 0.04}]


def excite(made, seq):
    made.tell(f.Excitation((0.1, 0.0, 0.0), int(f.Injection.RATE), seq, valid_ms=400))
    return of(f.Cycle, made.run())[-1].flags


@pytest.mark.parametrize('unsafe', UNSAFE, ids=str)
def test_an_unsafe_state_ends_the_excitation_until_it_is_idle(unsafe):
    """In the next cycle; the voltage is a mean over half a second."""
    made = Board()
    made.run()
    assert excite(made, 7) & f.Flag.EXCITATION
    frames = made.run(60 if 'battery_v' in unsafe else 2, **unsafe)
    last = of(f.Cycle, frames)[-1]
    assert not last.flags & f.Flag.EXCITATION
    assert last.flags & f.Flag.EXCITATION_REFUSED
    assert last.excitation == (0.0, 0.0, 0.0)
    assert 'excitation refused' in texts(frames)
    frames += made.run(5, **unsafe)
    low = [text for text in texts(frames) if text.startswith('low battery')]
    assert len(low) == ('battery_v' in unsafe)  # said once
    # and it does not come back by itself, nor with the next set-points of the same segment
    assert not any(c.flags & f.Flag.EXCITATION for c in of(f.Cycle, made.run(500)))
    made.firmware.arm(True)
    flags = excite(made, 8)
    assert flags & f.Flag.EXCITATION_REFUSED
    assert not flags & f.Flag.EXCITATION
    made.tell(f.Excitation((0.0, 0.0, 0.0), int(f.Injection.NONE), 9))
    assert not of(f.Cycle, made.run())[0].flags & f.Flag.EXCITATION_REFUSED
    assert excite(made, 10) & f.Flag.EXCITATION


def arm(made, value, command=400):
    (ack,) = made.tell(f.Command(command, (value,), 0, 1, 1))
    return ack.result


def test_arming():
    made = Board(armed=False)
    assert arm(made, 1.0) == 1  # before the gyro was heard
    for unsafe in ({'kill': True}, {'throttle': 0.06}, {'samples': 0}):
        made.run(30, **{'throttle': 0.0} | unsafe)
        assert arm(made, 1.0) == 1
    made.run(1, throttle=0.0)
    assert arm(made, 1.0) == 0
    (cycle,) = of(f.Cycle, made.run())
    assert cycle.flags & f.Flag.ARMED
    assert arm(made, 0.5) == arm(made, 1.0, command=511) == 3
    assert arm(made, 0.0) == 0
    (cycle,) = of(f.Cycle, made.run())
    assert not cycle.flags & f.Flag.ARMED


def test_on_the_ground_nothing_winds_up_and_in_flight_the_yaw_reference_waits():
    made = Board()
    slope = (0.0, 0.0, 0.0, 0.0, 2.0, 9.6)
    made.run(500, throttle=0.04, sticks=(0.5, 0.0, 1.0), sample=slope)
    assert made.motors == pytest.approx([0.04] * 4)
    (cycle,) = of(f.Cycle, made.run(1, throttle=0.5))
    assert cycle.attitude_setpoint[2] == pytest.approx(cycle.attitude[2], abs=0.01)
    cycle = of(f.Cycle, made.run(1250, sticks=(0.0, 0.0, 1.0)))[-1]  # 450 deg, held fast
    ahead = math.remainder(cycle.attitude_setpoint[2] - cycle.attitude[2], 2 * math.pi)
    assert abs(ahead) == pytest.approx(math.radians(60.0), abs=1e-3)


def test_after_the_gyros_silence_the_attitude_begins_anew():
    made = Board()
    made.run(500)
    turning = (0.3, *LEVEL[1:])
    made.run(3, sample=turning)
    made.run(5000, samples=0)
    cycle = of(f.Cycle, made.run(1))[-1]
    assert cycle.attitude[:2] == pytest.approx((0.0, 0.0), abs=math.radians(0.1))


def test_an_observer_that_diverges_does_not_come_in():
    """A model of no aircraft, beside the cascade for 25 s, then with a share of a quarter."""
    made = Board()
    made.run(50)
    made.update(ROLL_LQR_GAIN=200.0, ROLL_LQR_KANG=0.3, ROLL_LQR_KRATE=0.1, ROLL_LQR_LAG=0.03,
                ROLL_LQR_OBS=0.005, ROLL_LQR_DAMP=-5.0)  # fmt: skip
    (early,) = made.tell(f.GainsCommand(f.GainsAction.CONFIRM, 5))
    assert early.result == f.GainsResult.NOT_FLOWN
    for _ in range(8):  # on the ground the watch stands still
        made.run(250, throttle=0.0)
        made.tell(f.Heartbeat())
    (early,) = made.tell(f.GainsCommand(f.GainsAction.CONFIRM, 5))
    assert (early.result, early.phase) == (f.GainsResult.NOT_FLOWN, f.GainsPhase.WATCH)
    made.run(130)
    made.tell(f.GainsCommand(f.GainsAction.CONFIRM, 5))
    made.run(6250, sample=(0.001, *LEVEL[1:]))
    made.update(ROLL_LQR_SHARE=0.25)
    (cycle,) = of(f.Cycle, made.run())
    assert abs(cycle.control[1]) < 0.05
    made.run(130)
    made.tell(f.GainsCommand(f.GainsAction.CONFIRM, 5))
    cycles = of(f.Cycle, made.run(1250, sample=(0.001, *LEVEL[1:])))
    assert all(math.isfinite(c.control[1]) for c in cycles)


def test_nothing_hidden_no_heap_no_input_or_output(firmware):
    if shutil.which('nm') is None:
        pytest.skip('no nm here')
    listed = ended('nm', firmware('quad.o')).stdout.splitlines()
    assert len(listed) > 10
    assert not set('bBdDC') & {line.split()[-2] for line in listed}
    needed = {line.split()[-1] for line in listed if ' U ' in line}
    maths = {'atan2f', 'cosf', 'expf', 'floorf', 'fmaxf', 'fminf', 'powf', 'sincosf', 'sqrtf',
             'tanf'}
    memory = {'memcpy', 'memset', 'memcmp', 'memmove', 'strncmp', 'strlen'}
    assert needed <= {*memory, *maths, '_GLOBAL_OFFSET_TABLE_'}


def test_only_the_bridge_is_a_sign_of_life_and_only_who_is_meant_is_commanded():
    made = Board()
    for target, answers in (((2, 1), 0), ((1, 7), 0), ((0, 0), 1)):
        assert len(made.tell(f.ParamRequestRead('YAW_ANG_KP', -1, *target))) == answers
    assert arm(Board(may_arm=False), 1.0) == 2
    made.tell(f.GainsCommand(f.GainsAction.OPEN, 9))
    echo, ground, frames = Encoder(1, 1), Encoder(255, 190), []
    for _ in range(510):
        made.feed(echo.encode(f.Heartbeat()) + ground.encode(f.Heartbeat()))
        frames += made.run()
    assert f.GainsResult.LINK_LOST in [s.result for s in of(f.GainsState, frames)]
