"""The endpoint in C, called from Python: alone, and beside the virtual STM32, told the same."""

import ctypes
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest

from quad_bridge.virtual import endpoint as virtual
from quad_bridge.virtual.aircraft import Aircraft
from quad_bridge.virtual.firmware import TABLE
from quad_bridge.virtual.profile import load_profile
from quad_bridge.virtual.receiver import Event, Receiver
from quad_bridge.wire import frames as f
from quad_bridge.wire.codec import Decoder, Encoder
from quad_bridge.wire.gain_names import CONTRACT_NAMES, WIRE_NAMES
from quad_bridge.wire.params import checksum
from quad_bridge.wire.signing import Signing

CYCLE_US = 4000
KEY = bytes(range(32))
NAMES = tuple(
    wire
    for name, wire in WIRE_NAMES.items()
    if any(part in name for part in ('.angle.', '.rate.', 'sensor.', 'loop.'))
)
"""What the C firmware has: it flies the cascade only."""
COUNTS = ('frames', 'bad', 'unsigned', 'forged', 'replayed', 'dropped')


class Board:
    """The C endpoint with Python's codec at its other end; one at a time."""

    def __init__(self, path, *, armed=True, may_arm=True, key=None, time=0):
        self.c = ctypes.CDLL(str(path))
        self.c.lib_send.restype = self.c.lib_size.restype = ctypes.c_size_t
        self.c.lib_in_force.restype = ctypes.c_float
        self.c.lib_init(armed, may_arm, key, ctypes.c_uint64(time))
        self.signing = None if key is None else Signing(key, lambda: time)
        self.decoder = Decoder(self.signing)
        self.encoder = Encoder(1, 191, self.signing)
        self.cycle = 0

    def tell(self, *frames, after_us=0):
        """Frames to the board `after_us` after the coming cycle's time; its answers."""
        return self.feed(b''.join(self.encoder.encode(x) for x in frames), after_us=after_us)

    def feed(self, data, *, after_us=0):
        now_us = self.cycle * CYCLE_US + after_us
        self.c.lib_receive(data, ctypes.c_size_t(len(data)), ctypes.c_uint64(now_us))
        return self.sent()

    def run(self, cycles=1, *, kill=False, failsafe=False, battery_v=12.0, flags=0):
        out = []
        for _ in range(cycles):
            now_us = ctypes.c_uint64(self.cycle * CYCLE_US)
            self.c.lib_cycle(now_us, kill, failsafe, ctypes.c_float(battery_v), flags)
            self.cycle += 1
            out += self.sent()
        return out

    def sent(self):
        return self.decoder.feed(self.raw())

    def raw(self):
        room = (ctypes.c_uint8 * 4096)()
        return bytes(room[: self.c.lib_send(room, ctypes.c_size_t(4096))])

    @property
    def counts(self):
        values = (ctypes.c_uint32 * 6)()
        self.c.lib_counts(values)
        return dict(zip(COUNTS, values, strict=True))

    def in_force(self):
        return [self.c.lib_in_force(ctypes.c_size_t(i)) for i in range(len(NAMES))]


@pytest.fixture
def board(firmware):
    library = firmware('libquad.so')
    return lambda **options: Board(library, **options)


def of(kind, frames):
    return [x for x in frames if isinstance(x, kind)]


def update(board, **wanted):
    """OPEN, PARAM_SET of each (ROLL_RATE_KP=…), COMMIT; the answer to the last."""
    values = dict(zip(NAMES, board.in_force(), strict=True)) | wanted
    board.tell(f.GainsCommand(f.GainsAction.OPEN, 5))
    board.tell(*(f.ParamSet(name, value) for name, value in wanted.items()))
    check = checksum([values[name] for name in NAMES])
    commit = f.GainsCommand(f.GainsAction.COMMIT, 5, check, 1000)
    return board.tell(commit)[0]


def test_nothing_hidden_no_heap_no_input_or_output(firmware):
    if shutil.which('nm') is None:
        pytest.skip('no nm here')
    listed = subprocess.run(
        ['nm', firmware('quad.o')], capture_output=True, text=True, check=True
    ).stdout
    kinds = {line.split()[-2]: line for line in listed.splitlines()}
    assert not set('bBdDC') & set(kinds), kinds
    needed = {line.split()[-1] for line in listed.splitlines() if ' U ' in line}
    assert needed <= {'memcpy', 'memset', 'memcmp', 'strncmp', 'strlen', '_GLOBAL_OFFSET_TABLE_'}


def test_the_parameters_are_the_virtual_stm32s(board):
    c = board().c
    found = []
    while True:
        name, bounds = ctypes.create_string_buffer(17), (ctypes.c_float * 3)()
        if not c.lib_parameter(ctypes.c_size_t(len(found)), name, bounds):
            break
        found.append(name.value.decode())
        contract = CONTRACT_NAMES[found[-1]]
        axis, _, rest = contract.partition('.')
        if rest in TABLE:
            assert bounds[0] == np.float32(TABLE[rest][1]), (axis, rest)
            assert bounds[1] == np.float32(TABLE[rest][2]), (axis, rest)
        elif contract.startswith('sensor.'):
            assert tuple(bounds[:2]) == virtual.FILTER_BOUNDS_HZ
    assert tuple(found) == NAMES


def test_a_second_of_frames(board):
    made = board()
    frames = made.run(250)
    cycles = of(f.Cycle, frames)
    assert [c.cycle for c in cycles] == list(range(250))
    assert [c.time_us for c in cycles] == [CYCLE_US * k for k in range(250)]
    kinds = (f.Heartbeat, f.GainsState, f.Battery, f.RcChannels, f.SlowSensors)
    assert [len(of(kind, frames)) for kind in kinds] == [1, 1, 10, 50, 50]
    assert of(f.Battery, frames)[0].voltage_v == 12.0
    (slow, *_) = of(f.SlowSensors, frames)
    assert (slow.mag_gauss, slow.pressure_hpa) == ((0.25, -0.5, 0.125), 1013.25)
    assert made.counts['dropped'] == 0
    assert made.c.lib_size() < 4096


def test_all_parameters_are_listed_while_the_cycles_go_on(board):
    made = board()
    made.tell(f.ParamRequestList(1, 1))
    frames = made.run(20)
    values = of(f.ParamValue, frames)
    assert [v.name for v in values] == list(NAMES)
    assert [v.value for v in values] == made.in_force()
    assert len(of(f.Cycle, frames)) == 20


def test_time_is_answered_at_once(board):
    made = board()
    made.cycle = 3
    (answer,) = made.tell(f.TimeSync(0, 123), after_us=7)
    assert answer == f.TimeSync(12_007_000, 123)
    assert made.tell(f.TimeSync(5, 123)) == []


def test_a_full_outbox_drops_whole_frames_and_counts_them(board):
    made = board()
    data = made.encoder.encode(f.ParamRequestRead('YAW_ANG_KP')) * 100
    made.c.lib_receive(data, ctypes.c_size_t(len(data)), ctypes.c_uint64(0))
    frames = made.sent()
    assert 0 < len(frames) < 100
    assert made.counts['dropped'] == 100 - len(frames)
    assert made.decoder.counts.bad_crc == made.decoder.counts.garbage_bytes == 0


def test_gains_come_whole_between_cycles_and_stay_when_confirmed(board):
    made = board()
    made.run()
    before = made.in_force()
    state = update(made, ROLL_RATE_KP=0.125, YAW_RATE_KI=0.25)
    assert (state.result, state.phase) == (f.GainsResult.OK, f.GainsPhase.WATCH)
    assert made.in_force() == before
    made.run()
    assert sum(a != b for a, b in zip(made.in_force(), before, strict=True)) == 2
    (state,) = made.tell(f.GainsCommand(f.GainsAction.CONFIRM, 5))
    assert state.phase == f.GainsPhase.IDLE
    made.run(1000)
    assert made.in_force()[NAMES.index('ROLL_RATE_KP')] == 0.125


def test_refused_values_and_a_wrong_checksum_change_nothing(board):
    made = board()
    made.run()
    before = made.in_force()
    for value in (9.0, -1.0, float('nan'), float('inf')):
        (answer,) = made.tell(f.ParamSet('ROLL_RATE_KP', value))
        assert answer.value == before[NAMES.index('ROLL_RATE_KP')]
    (answer,) = made.tell(f.ParamSet('LOOP_RATE_HZ', 500.0))
    assert answer.value == 250.0
    assert update(made, ROLL_RATE_KP=9.0).result == f.GainsResult.CHECKSUM
    (unknown,) = made.tell(f.ParamSet('SIXTEEN_LETTERS_', 1.0))
    assert unknown.text == 'unknown parameter SIXTEEN_LETTERS_'
    made.run()
    assert made.in_force() == before


@pytest.mark.parametrize(
    ('alive', 'cycles', 'result'),
    [(True, 260, f.GainsResult.NOT_CONFIRMED), (False, 510, f.GainsResult.LINK_LOST)],
)
def test_the_last_good_set_comes_back_by_itself(board, alive, cycles, result):
    made = board()
    made.run()
    before = made.in_force()
    made.tell(f.GainsCommand(f.GainsAction.OPEN, 9))
    if alive:
        update(made, ROLL_RATE_KP=0.125)
        made.run()
        assert made.in_force() != before
    frames = []
    for _ in range(cycles):
        if alive:
            made.tell(f.Heartbeat(18, 8))
        frames += made.run()
    told = [s.result for s in of(f.GainsState, frames) if s.result != f.GainsResult.OK]
    assert told == [result]
    assert 'restored' in ' '.join(t.text for t in of(f.StatusText, frames))
    assert made.in_force() == before


def test_our_own_echo_is_no_sign_of_life(board):
    made = board()
    made.tell(f.GainsCommand(f.GainsAction.OPEN, 9))
    echo, told = Encoder(1, 1), []
    for _ in range(510):
        made.feed(echo.encode(f.Heartbeat()))
        told += of(f.GainsState, made.run())
    assert f.GainsResult.LINK_LOST in [s.result for s in told]


def test_no_excitation_outlives_half_a_second(board):
    made = board()
    made.run()
    made.tell(f.Excitation((0.1, 0.0, -0.2), int(f.Injection.RATE), 7, valid_ms=60_000))
    frames = made.run(200)
    excited = [c for c in of(f.Cycle, frames) if c.flags & f.Flag.EXCITATION]
    assert len(excited) == 126  # until more than 0.5 s old
    assert excited[0].excitation == pytest.approx((0.1, 0.0, -0.2), rel=1e-6)
    assert (excited[0].excitation_seq, excited[0].injection) == (7, f.Injection.RATE)
    last = of(f.Cycle, frames)[-1]
    assert last.excitation == (0.0, 0.0, 0.0)
    assert last.flags & f.Flag.STALE_SETPOINT
    assert 'excitation stale, dropped' in [t.text for t in of(f.StatusText, frames)]


@pytest.mark.parametrize(
    ('value', 'injection'),
    [(5.1, 2), (0.6, 1), (0.31, 3), (float('nan'), 2), (0.0, 9)],
)
def test_an_excitation_beyond_its_limits_is_refused(board, value, injection):
    made = board()
    made.tell(f.Excitation((0.0, value, 0.0), injection, 1))
    (cycle,) = of(f.Cycle, made.run())
    assert cycle.flags & f.Flag.EXCITATION_REFUSED
    assert not cycle.flags & f.Flag.EXCITATION


@pytest.mark.parametrize(
    'unsafe',
    [{'kill': True}, {'failsafe': True}, {'battery_v': 9.5}, {'flags': int(f.Flag.ANGLE_LIMIT)}],
    ids=str,
)
def test_an_unsafe_state_ends_the_excitation_in_the_next_cycle_at_the_latest(board, unsafe):
    made = board()
    made.run()
    made.tell(f.Excitation((0.1, 0.0, 0.0), int(f.Injection.RATE), 7, valid_ms=400))
    (cycle,) = of(f.Cycle, made.run())
    assert cycle.flags & f.Flag.EXCITATION
    frames = made.run(2, **unsafe)
    last = of(f.Cycle, frames)[-1]
    assert not last.flags & f.Flag.EXCITATION
    assert last.flags & f.Flag.EXCITATION_REFUSED
    assert last.excitation == (0.0, 0.0, 0.0)
    assert 'excitation refused' in [t.text for t in of(f.StatusText, frames)]
    # and it does not come back by itself
    assert not any(c.flags & f.Flag.EXCITATION for c in of(f.Cycle, made.run(5)))


def test_only_who_is_meant_is_commanded(board):
    made = board()
    assert made.tell(f.ParamRequestRead('YAW_ANG_KP', -1, 2, 1)) == []
    assert made.tell(f.ParamRequestRead('YAW_ANG_KP', -1, 1, 7)) == []
    assert len(made.tell(f.ParamRequestRead('YAW_ANG_KP', -1, 0, 0))) == 1


def test_arming(board):
    def arm(made, value, command=400):
        (ack,) = made.tell(f.Command(command, (value,), 0, 1, 1))
        return ack.result

    assert arm(board(may_arm=False), 1.0) == 2
    made = board(armed=False)
    made.run(1, kill=True)
    assert arm(made, 1.0) == 1
    made.run(1)
    assert arm(made, 1.0) == 0
    (cycle,) = of(f.Cycle, made.run())
    assert cycle.flags & f.Flag.ARMED
    assert arm(made, 0.5) == arm(made, 1.0, command=511) == 3
    assert arm(made, 0.0) == 0
    (cycle,) = of(f.Cycle, made.run())
    assert not cycle.flags & f.Flag.ARMED


# Signing.


def test_a_signed_link_hears_nobody_else(board):
    made = board(key=KEY, time=10**12)
    assert of(f.Cycle, made.run())
    assert of(f.TimeSync, made.tell(f.TimeSync(0, 5)))
    assert made.decoder.counts.unsigned == made.decoder.counts.forged == 0
    ask = f.ParamRequestRead('YAW_ANG_KP')
    assert made.feed(Encoder(1, 191).encode(ask)) == []
    other = Signing(bytes(32), lambda: 2 * 10**12)
    assert made.feed(Encoder(1, 191, other).encode(ask)) == []
    data = made.encoder.encode(ask)
    assert len(made.feed(data)) == 1
    assert made.feed(data) == []
    counts = made.counts
    assert (counts['unsigned'], counts['forged'], counts['replayed']) == (1, 1, 1)
    # after a restart a second later the recording is too old, though less than a minute
    again = board(key=KEY, time=10**12 + 100_000)
    assert again.feed(data) == []
    assert again.counts['replayed'] == 1
    assert len(again.tell(ask)) == 1


def test_a_board_without_a_clock_takes_the_bridges_time(board):
    made = board(key=KEY, time=0)
    bridge = Signing(KEY, lambda: 10**12)
    first = Decoder(bridge)
    made.run(1)
    made.feed(b'')
    made.c.lib_cycle(ctypes.c_uint64(CYCLE_US), 0, 0, ctypes.c_float(12.0), 0)
    assert first.feed(made.raw()) == []
    assert first.counts.replayed > 0
    made.feed(Encoder(1, 191, bridge).encode(f.Heartbeat(18, 8)))
    made.c.lib_cycle(ctypes.c_uint64(2 * CYCLE_US), 0, 0, ctypes.c_float(12.0), 0)
    assert of(f.Cycle, first.feed(made.raw()))


@pytest.mark.parametrize('stored', [2**64 - 1, 2**48 - 1, 2**47 + 1])
def test_erased_flash_is_no_time(board, stored):
    made = board(key=KEY, time=stored)
    bridge = Signing(KEY, lambda: 10**12)
    made.run(1)
    ask = f.ParamRequestRead('YAW_ANG_KP')
    assert len(made.feed(Encoder(1, 191, bridge).encode(ask))) == 1


def test_one_frame_of_a_broken_clock_locks_nobody_out(board):
    made = board(key=KEY, time=10**12)
    ask = f.ParamRequestRead('YAW_ANG_KP')
    broken = Signing(KEY, lambda: 10**12)
    broken.stamp = lambda: 2**48 - 1
    data = Encoder(1, 191, broken).encode(ask)
    assert made.feed(data) == []
    assert made.counts['replayed'] == 1
    assert len(made.tell(ask)) == 1
    # behind a good frame in the same bytes, and before one
    good = [made.encoder.encode(ask) for _ in range(2)]
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
        name = NAMES[draw.integers(len(NAMES))]
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
def test_both_far_ends_answer_alike(board, monkeypatch, seed):
    monkeypatch.setattr(virtual, 'NAMES', NAMES)
    events = [Event(3.0, 'aux1', 1.0), Event(3.5, 'aux1', -1.0)]
    events += [Event(6.0, 'failsafe', 1.0), Event(6.2, 'failsafe', 0.0)]
    aircraft = Aircraft(replace(load_profile('plain'), mount='rig'), seed=1)
    python, script = virtual.Endpoint(aircraft, Receiver(events=tuple(events))), Script(seed)
    encoder, decoder, made = Encoder(1, 191), Decoder(), board()
    compared = 0
    silence = 0
    for number in range(2500):
        frames = decoder.feed(python.cycle())
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
        values = [python._store.shown(name) for name in NAMES]
        for frame in script.frames(values):
            # never at a cycle's own time, where a limit in seconds and one in µs might differ
            now_us = made.cycle * CYCLE_US - CYCLE_US + 1237
            theirs = python.receive(encoder.encode(frame), 1000 * now_us)
            ours = made.tell(frame, after_us=1237 - CYCLE_US)
            assert comparable(ours) == comparable(decoder.feed(theirs)), (number, frame)
            compared += 1
    assert compared > 150
