"""The endpoint in C and the virtual STM32's: alike in all that the bridge can see.

Each promise is tested on both; then both get the same random input and must answer the same.
"""

import ctypes
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest

from quad_bridge.gains.protocol import checksum
from quad_bridge.gains.table import CONTRACT_NAMES, WIRE_NAMES
from quad_bridge.virtual import endpoint as virtual
from quad_bridge.virtual.aircraft import Aircraft
from quad_bridge.virtual.firmware import TABLE
from quad_bridge.virtual.profile import load_profile
from quad_bridge.virtual.receiver import Event, Receiver
from quad_bridge.wire import frames as f
from quad_bridge.wire.codec import Decoder, Encoder
from quad_bridge.wire.signing import Signing

CYCLE_US = 4000
KEY = bytes(range(32))
CASCADE = tuple(
    wire
    for name, wire in WIRE_NAMES.items()
    if any(part in name for part in ('.angle.', '.rate.', 'sensor.', 'loop.'))
)
"""What the C firmware has: it flies the cascade only."""
COUNTS = ('frames', 'bad', 'unsigned', 'forged', 'replayed', 'dropped')


class Board:
    """An endpoint with Python's codec at its other end."""

    def __init__(self, signing=None):
        self.decoder, self.encoder = Decoder(signing), Encoder(1, 191, signing)
        self.cycle = 0

    def tell(self, *frames, after_us=0):
        """Frames to the board `after_us` after the coming cycle's time; its answers."""
        return self.feed(b''.join(self.encoder.encode(x) for x in frames), after_us=after_us)

    def value(self, name):
        (answer,) = self.tell(f.ParamRequestRead(name))
        return answer.value

    def update(self, **wanted):
        """OPEN, PARAM_SET of each (ROLL_RATE_KP=…), COMMIT; the answer to the last."""
        values = dict(zip(self.names, self.in_force(), strict=True)) | wanted
        self.tell(f.GainsCommand(f.GainsAction.OPEN, 5))
        self.tell(*(f.ParamSet(name, value) for name, value in wanted.items()))
        check = checksum([values[name] for name in self.names])
        return self.tell(f.GainsCommand(f.GainsAction.COMMIT, 5, check, 1000))[0]


class InC(Board):
    """One at a time."""

    names = CASCADE

    def __init__(self, path, *, armed=True, may_arm=True, key=None, time=0):
        super().__init__(None if key is None else Signing(key, lambda: time))
        self.c = ctypes.CDLL(str(path))
        self.c.lib_send.restype = self.c.lib_size.restype = ctypes.c_size_t
        self.c.lib_in_force.restype = ctypes.c_float
        self.c.lib_init(armed, may_arm, key, ctypes.c_uint64(time))

    def feed(self, data, *, after_us=0):
        now_us = self.cycle * CYCLE_US + after_us
        self.c.lib_receive(data, ctypes.c_size_t(len(data)), ctypes.c_uint64(now_us))
        return self.decoder.feed(self.raw())

    def run(self, cycles=1, *, kill=False, failsafe=False, battery_v=12.0, flags=0):
        out = []
        for _ in range(cycles):
            now_us = ctypes.c_uint64(self.cycle * CYCLE_US)
            self.c.lib_cycle(now_us, kill, failsafe, ctypes.c_float(battery_v), flags)
            self.cycle += 1
            out += self.decoder.feed(self.raw())
        return out

    def raw(self):
        room = (ctypes.c_uint8 * 4096)()
        return bytes(room[: self.c.lib_send(room, ctypes.c_size_t(4096))])

    @property
    def counts(self):
        values = (ctypes.c_uint32 * 6)()
        self.c.lib_counts(values)
        return dict(zip(COUNTS, values, strict=True))

    def in_force(self):
        return [self.c.lib_in_force(ctypes.c_size_t(i)) for i in range(len(self.names))]


class Virtual(Board):
    names = virtual.NAMES

    def __init__(self, *, armed=True, events=()):
        super().__init__()
        aircraft = Aircraft(replace(load_profile('plain'), mount='rig'), seed=1)
        self.endpoint = virtual.Endpoint(aircraft, Receiver(events=tuple(events)))
        self.endpoint.firmware.armed = armed

    def feed(self, data, *, after_us=0):
        now_us = self.cycle * CYCLE_US + after_us
        return self.decoder.feed(self.endpoint.receive(data, 1000 * now_us))

    def run(self, cycles=1, *, kill=None, failsafe=None):
        if kill is not None or failsafe is not None:
            events = [Event(0.0, 'aux1', 1.0 if kill else -1.0)]
            events += [Event(0.0, 'failsafe', 1.0)] if failsafe else []
            self.endpoint._script = Receiver(events=tuple(events))
        self.cycle += cycles
        return [x for _ in range(cycles) for x in self.decoder.feed(self.endpoint.cycle())]

    def in_force(self):
        return list(self.endpoint._store.active.values())


@pytest.fixture
def board(firmware):
    library = firmware('libquad.so')
    return lambda **options: InC(library, **options)


@pytest.fixture(params=['C', 'virtual'])
def either(request):
    """A function that makes an endpoint of either kind."""
    return Virtual if request.param == 'virtual' else request.getfixturevalue('board')


def of(kind, frames):
    return [x for x in frames if isinstance(x, kind)]


def texts(frames):
    return [t.text for t in of(f.StatusText, frames)]


def test_a_second_of_frames(either):
    frames = either().run(250)
    cycles = of(f.Cycle, frames)
    assert [(c.cycle, c.time_us) for c in cycles] == [(k, CYCLE_US * k) for k in range(250)]
    kinds = (f.Heartbeat, f.GainsState, f.Battery, f.RcChannels, f.SlowSensors)
    assert [len(of(kind, frames)) for kind in kinds] == [1, 1, 10, 50, 50]
    assert of(f.Battery, frames)[0].voltage_v == pytest.approx(12.0, abs=0.3)
    assert of(f.SlowSensors, frames)[0].pressure_hpa == pytest.approx(1013.25, abs=0.2)


def test_all_parameters_are_listed_and_read_by_name_and_by_index(either):
    made = either()
    frames = made.tell(f.ParamRequestList(1, 1)) + made.run(20)  # C spreads them over cycles
    values = of(f.ParamValue, frames)
    assert [(v.name, v.index, v.count) for v in values] == [
        (name, k, len(made.names)) for k, name in enumerate(made.names)
    ]
    assert [v.value for v in values] == [made.value(name) for name in made.names]
    assert len(of(f.Cycle, frames)) == 20
    by_index = f.ParamRequestRead('', made.names.index('GYRO_FILT_HZ'))
    assert made.tell(by_index) == made.tell(f.ParamRequestRead('GYRO_FILT_HZ'))
    assert made.value('GYRO_FILT_HZ') == 42.0
    assert texts(made.tell(f.ParamRequestRead('NO_SUCH'))) == ['unknown parameter NO_SUCH']


def test_time_is_answered_at_once_and_only_questions_are(either):
    made = either()
    made.run(3)
    assert made.tell(f.TimeSync(0, 123), after_us=7) == [f.TimeSync(12_007_000, 123)]
    assert made.tell(f.TimeSync(5, 123)) == []


def test_gains_come_whole_and_stay_when_confirmed(either):
    made = either()
    made.run()
    before = [made.value(name) for name in made.names]
    state = made.update(ROLL_RATE_KP=0.125, YAW_RATE_KI=0.25)
    assert (state.result, state.phase) == (f.GainsResult.OK, f.GainsPhase.WATCH)
    if isinstance(made, InC):  # the other's cycle is over when it listens
        assert made.in_force() == before
    made.run()
    after = [made.value(name) for name in made.names]
    assert sum(a != b for a, b in zip(after, before, strict=True)) == 2
    (state,) = made.tell(f.GainsCommand(f.GainsAction.CONFIRM, 5))
    assert state.phase == f.GainsPhase.IDLE
    made.run(1000)
    assert made.value('ROLL_RATE_KP') == 0.125


def test_refused_values_and_a_wrong_checksum_change_nothing(either):
    made = either()
    made.run()
    before = {name: made.value(name) for name in made.names}
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
    assert {name: made.value(name) for name in made.names} == before


@pytest.mark.parametrize(
    ('alive', 'cycles', 'result'),
    [(True, 260, f.GainsResult.NOT_CONFIRMED), (False, 510, f.GainsResult.LINK_LOST)],
)
def test_the_last_good_set_comes_back_by_itself(either, alive, cycles, result):
    made = either()
    made.run()
    before = made.in_force()
    made.tell(f.GainsCommand(f.GainsAction.OPEN, 9))
    if alive:
        made.update(ROLL_RATE_KP=0.125)
        made.run()
        assert made.in_force() != before
    frames = []
    for _ in range(cycles):
        if alive:
            made.tell(f.Heartbeat(18, 8))
        frames += made.run()
    results = {s.result for s in of(f.GainsState, frames)} - {f.GainsResult.OK}
    assert results == {result}
    assert 'restored' in ' '.join(texts(frames))
    assert made.in_force() == pytest.approx(before)


@pytest.mark.parametrize(('valid_ms', 'cycles'), [(100, 26), (60_000, 126)])
def test_an_excitation_ends_when_it_is_stale_after_half_a_second_at_the_latest(
    either, valid_ms, cycles
):
    made = either()
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
def test_an_excitation_beyond_its_limits_is_refused(either, value, injection):
    made = either()
    made.tell(f.Excitation((0.0, value, 0.0), injection, 1))
    (cycle,) = of(f.Cycle, made.run())
    assert cycle.flags & f.Flag.EXCITATION_REFUSED
    assert not cycle.flags & f.Flag.EXCITATION


UNSAFE = [{'kill': True}, {'failsafe': True}]
IN_C = [{'battery_v': 9.5}, {'flags': int(f.Flag.ANGLE_LIMIT)}]
"""The virtual one's are those of its physics: test_virtual_endpoint.py."""


@pytest.mark.parametrize(
    ('kind', 'unsafe'),
    [(k, x) for k in ('C', 'virtual') for x in UNSAFE] + [('C', x) for x in IN_C],
    ids=str,
)
def test_an_unsafe_state_ends_the_excitation_in_the_next_cycle_at_the_latest(
    board, kind, unsafe
):
    made = board() if kind == 'C' else Virtual()
    made.run()
    made.tell(f.Excitation((0.1, 0.0, 0.0), int(f.Injection.RATE), 7, valid_ms=400))
    (cycle,) = of(f.Cycle, made.run())
    assert cycle.flags & f.Flag.EXCITATION
    frames = made.run(2, **unsafe)
    last = of(f.Cycle, frames)[-1]
    assert not last.flags & f.Flag.EXCITATION
    assert last.flags & f.Flag.EXCITATION_REFUSED
    assert last.excitation == (0.0, 0.0, 0.0)
    assert 'excitation refused' in texts(frames)
    # and it does not come back by itself
    assert not any(c.flags & f.Flag.EXCITATION for c in of(f.Cycle, made.run(5)))


def arm(made, value, command=400):
    (ack,) = made.tell(f.Command(command, (value,), 0, 1, 1))
    return ack.result


def test_arming(either):
    made = either(armed=False)
    made.run(1, kill=True)
    assert arm(made, 1.0) == 1
    made.run(1, kill=False)
    assert arm(made, 1.0) == 0
    (cycle,) = of(f.Cycle, made.run())
    assert cycle.flags & f.Flag.ARMED
    assert arm(made, 0.5) == arm(made, 1.0, command=511) == 3
    assert arm(made, 0.0) == 0
    (cycle,) = of(f.Cycle, made.run())
    assert not cycle.flags & f.Flag.ARMED


# The C alone.


def test_nothing_hidden_no_heap_no_input_or_output(firmware):
    if shutil.which('nm') is None:
        pytest.skip('no nm here')
    listed = subprocess.run(
        ['nm', firmware('quad.o')], capture_output=True, text=True, check=True
    ).stdout.splitlines()
    assert not set('bBdDC') & {line.split()[-2] for line in listed}
    needed = {line.split()[-1] for line in listed if ' U ' in line}
    assert needed <= {'memcpy', 'memset', 'memcmp', 'strncmp', 'strlen', '_GLOBAL_OFFSET_TABLE_'}


def test_the_parameters_and_their_bounds_are_the_virtual_stm32s(board):
    c, found = board().c, []
    name, bounds = ctypes.create_string_buffer(17), (ctypes.c_float * 3)()
    while c.lib_parameter(ctypes.c_size_t(len(found)), name, bounds):
        found.append(name.value.decode())
        contract = CONTRACT_NAMES[found[-1]]
        rest = contract.partition('.')[2]
        if rest in TABLE:
            wanted = tuple(np.float32(TABLE[rest][1:3]))
            assert tuple(bounds[:2]) == wanted, contract
        elif contract.startswith('sensor.'):
            assert tuple(bounds[:2]) == virtual.FILTER_BOUNDS_HZ
    assert tuple(found) == CASCADE


def test_a_full_outbox_drops_whole_frames_and_counts_them(board):
    made = board()
    assert made.c.lib_size() < 4096
    frames = made.feed(made.encoder.encode(f.ParamRequestRead('YAW_ANG_KP')) * 100)
    assert 0 < len(frames) < 100
    assert made.counts['dropped'] == 100 - len(frames)
    assert made.decoder.counts.bad_crc == made.decoder.counts.garbage_bytes == 0


def test_our_own_echo_is_no_sign_of_life_and_only_who_is_meant_is_commanded(board):
    made = board()
    for target, answers in (((2, 1), 0), ((1, 7), 0), ((0, 0), 1)):
        assert len(made.tell(f.ParamRequestRead('YAW_ANG_KP', -1, *target))) == answers
    assert arm(board(may_arm=False), 1.0) == 2
    made.tell(f.GainsCommand(f.GainsAction.OPEN, 9))
    echo, frames = Encoder(1, 1), []
    for _ in range(510):
        made.feed(echo.encode(f.Heartbeat()))
        frames += made.run()
    assert f.GainsResult.LINK_LOST in [s.result for s in of(f.GainsState, frames)]


ASK = f.ParamRequestRead('YAW_ANG_KP')


def test_a_signed_link_hears_nobody_else(board):
    made = board(key=KEY, time=10**12)
    assert of(f.Cycle, made.run())
    assert of(f.TimeSync, made.tell(f.TimeSync(0, 5)))
    assert made.decoder.counts.unsigned == made.decoder.counts.forged == 0
    assert made.feed(Encoder(1, 191).encode(ASK)) == []
    other = Signing(bytes(32), lambda: 2 * 10**12)
    assert made.feed(Encoder(1, 191, other).encode(ASK)) == []
    data = made.encoder.encode(ASK)
    assert [len(made.feed(data)) for _ in range(2)] == [1, 0]
    assert [made.counts[n] for n in ('unsigned', 'forged', 'replayed')] == [1, 1, 1]
    # after a restart a second later the recording is too old, though less than a minute
    again = board(key=KEY, time=10**12 + 100_000)
    assert again.feed(data) == []
    assert again.counts['replayed'] == 1
    assert len(again.tell(ASK)) == 1


def test_a_board_without_a_clock_takes_the_bridges_time(board):
    made = board(key=KEY, time=0)
    bridge = Signing(KEY, lambda: 10**12)
    made.decoder = Decoder(bridge)
    assert made.run(2) == []
    assert made.decoder.counts.replayed > 0
    made.feed(Encoder(1, 191, bridge).encode(f.Heartbeat(18, 8)))
    assert of(f.Cycle, made.run())


@pytest.mark.parametrize('stored', [2**64 - 1, 2**48 - 1, 2**47 + 1])
def test_erased_flash_is_no_time(board, stored):
    made = board(key=KEY, time=stored)
    made.run(1)
    assert len(made.feed(Encoder(1, 191, Signing(KEY, lambda: 10**12)).encode(ASK))) == 1


def test_one_frame_of_a_broken_clock_locks_nobody_out(board):
    made = board(key=KEY, time=10**12)
    broken = Signing(KEY, lambda: 10**12)
    broken.stamp = lambda: 2**48 - 1
    data = Encoder(1, 191, broken).encode(ASK)
    assert made.feed(data) == []
    assert made.counts['replayed'] == 1
    assert len(made.tell(ASK)) == 1
    # behind a good frame in the same bytes, and before one
    good = [made.encoder.encode(ASK) for _ in range(2)]
    assert len(made.feed(good[0] + data + good[1])) == 2


# The same input to both.

TOLD = (f.GainsState, f.ParamValue, f.CommandAck, f.TimeSync, f.StatusText)


class Script:
    """What a bridge might send, drawn at random, mostly in a sensible order."""

    def __init__(self, seed):
        self.draw = np.random.default_rng(seed)
        self.values = {}

    def frames(self, values):
        draw = self.draw
        kind = draw.integers(12)
        name = CASCADE[draw.integers(len(CASCADE))]
        value = float(np.float32(draw.choice([0.02, 0.3, 0.9, 7.0, 40.0]) * draw.random()))
        if kind <= 2:
            return [f.ParamSet(name, value)]
        if kind == 3:
            return [f.ParamRequestRead(name), f.ParamRequestRead('', int(draw.integers(-1, 30)))]
        if kind <= 7:
            action, number = int(draw.integers(6)), int(draw.integers(1, 3))
            right = checksum(values) if draw.random() < 0.8 else 5
            return [f.GainsCommand(action, number, right, int(draw.integers(100, 3000)))]
        if kind <= 9:
            wanted = tuple(float(v) for v in draw.normal(0.0, 0.1, 3).astype(np.float32))
            injection, valid = int(draw.integers(5)), int(draw.integers(10, 900))
            return [f.Excitation(wanted, injection, int(draw.integers(256)), valid)]
        if kind == 10:
            return [f.TimeSync(int(draw.integers(2)), int(draw.integers(10**9)))]
        wanted = float(draw.choice([0.0, 0.5, 1.0, 1.0]))
        return [f.Command(int(draw.choice([400, 511])), (wanted,))]


def comparable(frames):
    told = [replace(x, aircraft=0) if isinstance(x, f.GainsState) else x for x in frames]
    return [
        x
        for x in told
        if isinstance(x, TOLD) and not str(getattr(x, 'text', '')).startswith(('virtual', 'low'))
    ]


@pytest.mark.parametrize('seed', range(4))
def test_both_endpoints_answer_alike(board, monkeypatch, seed):
    monkeypatch.setattr(virtual, 'NAMES', CASCADE)
    events = [Event(3.0, 'aux1', 1.0), Event(3.5, 'aux1', -1.0)]
    events += [Event(6.0, 'failsafe', 1.0), Event(6.2, 'failsafe', 0.0)]
    python, made, script = Virtual(events=events), board(), Script(seed)
    compared = silence = 0
    for number in range(2500):
        frames = python.run()
        (cycle,) = of(f.Cycle, frames)
        flags = cycle.flags & (f.Flag.SATURATED | f.Flag.ANGLE_LIMIT)
        killed, lost = (bool(cycle.flags & x) for x in (f.Flag.RC_KILL, f.Flag.RC_FAILSAFE))
        answers = made.run(1, kill=killed, failsafe=lost, flags=flags)
        (mine,) = of(f.Cycle, answers)
        assert f.Flag(mine.flags) == f.Flag(cycle.flags), number
        assert (mine.injection, mine.excitation_seq) == (cycle.injection, cycle.excitation_seq)
        assert mine.excitation == pytest.approx(cycle.excitation, abs=1e-7)
        assert comparable(answers) == comparable(frames), number
        silence = max(0, silence - 1)
        if script.draw.random() < 0.0008:
            silence = 600  # longer than the link may be dead
        if silence or script.draw.random() > 0.2:
            continue
        for frame in script.frames([python.endpoint._store.shown(name) for name in CASCADE]):
            # never at a cycle's own time, where a limit in seconds and one in µs might differ
            theirs, ours = (x.tell(frame, after_us=1237 - CYCLE_US) for x in (python, made))
            assert comparable(ours) == comparable(theirs), (number, frame)
            compared += 1
    assert compared > 150
