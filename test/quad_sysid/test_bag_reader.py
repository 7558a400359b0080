"""read_bag: the contract's bags in every storage, and bags as flights really leave them."""

import os
import shutil
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import yaml
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from scipy.spatial.transform import Rotation

from quad_bridge.log.writer import BagWriter, Limits
from quad_sysid.bags import BagOptions, read_bag, split_segments, write_bag, write_streams
from quad_sysid.bags.cdr import Stamped
from quad_sysid.bags.events import Event
from quad_sysid.bags.odometry import moving
from quad_sysid.bags.stamps import uniform_grid
from quad_sysid.contract import TOPIC_TYPES, control_from_motors, motors_from_wrench
from quad_sysid.craft import LAYOUTS
from quad_sysid.errors import BadInputError
from quad_sysid.record import GainChange, Record, Segment

T0 = 1_750_000_000_123_456_789
N = 1000
STEP = 4_000_000


def make_record(n: int = N) -> Record:
    rng = np.random.default_rng(7)
    wrench = np.column_stack((np.full(n, 0.5), 0.3 * rng.standard_normal((n, 3))))
    motors, k = motors_from_wrench(wrench), np.arange(n)
    noise = {name: rng.standard_normal((n, 3)) for name in (
        'rates', 'acceleration', 'attitude_setpoint', 'rate_setpoint', 'excitation')}
    return Record(
        source='made', dt=0.004, t0_ns=T0, control=control_from_motors(motors),
        angles=np.column_stack((0.4 * np.sin(k / 50), 0.3 * np.cos(k / 70),
                                np.linspace(0.0, 9.0, n))),
        motors=motors, wrench=wrench, battery_v=np.linspace(12.0, 11.0, n),
        segments=(
            Segment('idle', 'none', 'roll', 'attitude', 0.0, 1.0),
            Segment('train', 'prbs', 'roll', 'attitude', 1.0, 3.0, {'amplitude': 0.2, 'bits': 9}),
            Segment('validation', 'square', 'roll', 'attitude', 3.0, 4.0),
        ),
        gains=(GainChange(0.0, {'roll.angle.kp': 3.0, 'roll.rate.kp': 0.07}),
               GainChange(2.0, {'roll.rate.kp': 0.09})),
        **noise,
    )


def imu_stream(stamps: np.ndarray) -> Stamped:
    values = np.random.default_rng(3).standard_normal((len(stamps), 13))
    values[:, [4, 11, 12]] = 0.0
    return Stamped(stamps.astype(np.int64), values)


def write_imu(path: Path, stamps: np.ndarray, imu: Stamped | None = None, **other: Stamped):
    """A bag of /imu/data and /control/wrench at these stamps."""
    wrench = Stamped(stamps, np.tile([0.0, 0, 0.5, 0.1, 0, 0], (len(stamps), 1)))
    streams = {'/imu/data': imu or imu_stream(stamps), '/control/wrench': wrench, **other}
    events = streams.pop('/excitation/segment', None)
    return write_streams(path, streams, {'/excitation/segment': events} if events else {})


def regular(n: int = N) -> np.ndarray:
    return T0 + STEP * np.arange(n, dtype=np.int64)


def record_or_line(path: Path) -> bool:
    """Whether the bag gave a record; where not, one line that names it."""
    try:
        record = read_bag(path)
    except BadInputError as error:
        line = str(error)
    else:
        return record.n > 0
    assert '\n' not in line
    assert path.name in line
    return False


@pytest.mark.parametrize(
    ('storage', 'compression'),
    [('mcap', 'none'), ('mcap', 'message'), ('mcap', 'file'), ('mcap', 'storage'),
     ('sqlite3', 'none'), ('sqlite3', 'message'), ('sqlite3', 'file'), ('bare', 'message')],
)
def test_a_record_survives_every_storage(tmp_path, refusal, storage, compression):
    want, kind = make_record(), storage.replace('bare', 'mcap')
    path = write_bag(want, tmp_path / 'bag', BagOptions(kind, compression))
    assert 'not overwritten' in refusal(write_bag, want, path)
    if storage == 'bare':
        path = shutil.copy(path / 'bag.mcap', tmp_path / 'bare.mcap')
    got = read_bag(path)
    assert (got.dt, got.t0_ns, got.warnings, got.missing) == (0.004, T0, (), ())
    for name in (
        'rates', 'acceleration', 'motors', 'wrench', 'control', 'attitude_setpoint',
        'rate_setpoint', 'excitation',
    ):
        np.testing.assert_array_equal(getattr(got, name), getattr(want, name), err_msg=name)
    np.testing.assert_allclose(got.angles, want.angles, atol=1e-12)
    np.testing.assert_allclose(got.battery_v[:975], want.battery_v[:975], atol=1e-5)
    assert (got.segments, got.gains) == (want.segments, want.gains)
    assert got.gains_at(2.5) == {'roll.angle.kp': 3.0, 'roll.rate.kp': 0.09}


def test_a_full_disk_leaves_no_bag_and_is_told_in_one_line(tmp_path, monkeypatch, refusal):
    def full(*_):
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr(Writer, 'write', full)
    line = refusal(write_bag, make_record(), tmp_path / 'bag')
    assert 'cannot be written: found No space left on device' in line
    assert list(tmp_path.iterdir()) == []


AWAY = np.where(np.arange(N) // 50 == 8, 2 * 10**9, 0)
CLOSE = np.isin(range(20), [3, 14]) - 1.0 * np.isin(range(20), [4, 13])
"""Two samples that come closer to each other, and two that move apart."""


def shaken(cycles):
    return regular() + np.rint(STEP * cycles).astype(np.int64)


STAMPS = {
    'jitter of a quarter cycle, and some lost': (
        np.delete(shaken(np.random.default_rng(1).uniform(-0.25, 0.25, N)), [100, 300]), N, 2, ''),
    'two samples that nearly meet': (shaken(0.3 * np.tile(CLOSE, N // 20)), N, 0, ''),
    'another rate': ((T0 + np.arange(5000) * 1e9 / 300).astype(np.int64), 5000, 0, ''),
    'a phase that changes in a long gap': (
        np.concatenate((regular(500), regular(500) + 700 * STEP + STEP // 2)), 1201, 201, ''),
    'repeated stamps': (
        np.repeat(regular(), np.where(np.arange(N) == 50, 3, 1)), N, 0,
        '2 messages repeat a stamp'),
    'swapped messages': (
        regular()[np.r_[:10, 11, 10, 12:N]], N, 0, '1 stamps run backward'),
    'a clock set back': (
        np.concatenate((regular(700), regular(300) - 5_000_000_000)), 700, 0, 'set back'),
    'a while of stamps that run beside those before and behind it': (
        np.concatenate((regular(400), regular(560) + 125 * STEP, regular(400) + 400 * STEP)),
        800, 0, 'set back 2 times: 560 of 1360'),
    'a while of stamps 2 s early': (regular() + AWAY, N, 50, 'set back 1 times: 50 of 1000'),
    'stamps in pairs': (regular(N + 1) - 3 * STEP // 4 * (np.arange(N + 1) % 2), N + 1, N // 2,
                        'fall into an occupied cycle'),
    'wild stamps': (
        np.where(np.arange(N) == 300, 0, regular() + 86_400 * 10**9 * (np.arange(N) == 200)), N, 2,
        '1 messages without a stamp left out'),
}


@pytest.mark.parametrize('case', STAMPS)
def test_cycles_lie_where_their_stamps_say_and_lost_ones_are_gaps(case):
    stamps, n, lost, words = STAMPS[case]
    grid = uniform_grid(stamps, 'bag')
    # a whole number of µs
    dt = 0.003333 if case == 'another rate' else 0.004
    assert grid.dt == pytest.approx(dt, abs=2e-6 if 'quarter' in case else 1e-12)
    assert grid.n == pytest.approx(n, abs=n == 1201)
    assert grid.n - len(grid.cells) == pytest.approx(lost, abs=n == 1201)
    assert words in '\n'.join(grid.warnings)
    assert 'long gap' not in case or 'jitter' not in '\n'.join(grid.warnings)
    assert np.all(np.diff(grid.cells) > 0)
    assert np.all(np.diff(stamps[grid.rows]) > 0)


@pytest.mark.parametrize('plugin', StoragePlugin)
def test_a_bag_whose_recorders_clock_was_set_back_is_read_in_the_order_of_its_file(
        tmp_path, plugin):
    """By the times of their receipt, messages of before and after would alternate."""
    parts = [write_imu(tmp_path / name, stamps) for name, stamps in (
        ('before', regular(700)), ('after', regular(300) + 700 * STEP - 2_000_500_000))]
    with Writer(tmp_path / 'bag', version=9, storage_plugin=plugin) as writer:
        topics = {}
        for part in parts:
            with Reader(part) as reader:
                for c, time_ns, raw in reader.messages():
                    if c.topic not in topics:
                        topics[c.topic] = writer.add_connection(
                            c.topic, c.msgtype, msgdef=c.msgdef.data, rihs01=c.digest)
                    writer.write(topics[c.topic], time_ns, raw)
    got = read_bag(tmp_path / 'bag')
    assert 'the clock was set back 1 times: 300 of 1000' in '\n'.join(got.warnings)
    assert (got.n, got.dt) == (700, 0.004)


@pytest.mark.parametrize(('stamps', 'words'), [
    (T0 + 10_000_000 * (regular() // 10_000_000 - T0 // 10_000_000), '60 % repeat a time'),
    (T0 - 16_000_000 * ((T0 - regular()) // 16_000_000) + 100_000 * (np.arange(N) % 4),
     '75 % of the rows come right behind another'),
], ids=['simulated time that ticks', 'bursts of a driver'])
def test_messages_of_one_tick_or_burst_lie_in_cycles_of_their_own(tmp_path, stamps, words):
    got = read_bag(write_imu(tmp_path / 'bag', stamps, imu_stream(stamps)))
    assert words in '; '.join(got.warnings)
    assert got.dt == pytest.approx(0.004, rel=1e-3)
    assert got.n == pytest.approx(N, abs=2)
    assert np.isfinite(got.rates).all(axis=1).sum() >= N - 2


def test_topics_at_other_stamps_go_to_the_nearest_cycle(tmp_path):
    stamps = regular(100)
    first = np.arange(300.0).reshape(100, 3)
    other = Stamped(  # two of them come in each cycle: the nearest counts
        np.repeat(stamps, 2) + np.tile([500_000, 1_500_000], 100),
        np.stack((first, -first), axis=1).reshape(200, 3))
    far = Stamped(stamps[-1:] + 10 * STEP, np.ones((1, 3)))
    late = Stamped(stamps + 1_200_000, np.full((100, 4), 0.5))
    fast = Stamped(np.repeat(stamps, 5) + np.tile(800_000 * np.arange(-2, 3), 100),
                   np.repeat(np.arange(500.0), 3).reshape(500, 3))
    others = {'/setpoint/rates': other, '/setpoint/attitude': far, '/motors/command': late,
              '/excitation/applied': fast}
    got = read_bag(write_imu(tmp_path / 'bag', stamps, **others))
    np.testing.assert_array_equal(got.rate_setpoint, first)
    np.testing.assert_array_equal(got.excitation[:, 0], 5.0 * np.arange(100) + 2.0)
    assert got.attitude_setpoint is None
    assert '/setpoint/attitude' in got.missing
    assert [line[:55] for line in got.warnings if 'of a cycle' in line] == [
        '/motors/command: its stamps lie 0.3 of a cycle from tho']


@pytest.mark.parametrize('step', [STEP // 4, 2 * STEP])
def test_commands_that_come_faster_or_more_slowly_hold_until_the_next(tmp_path, step):
    """Of several in a cycle the mean counts; where one is lost, nobody knows."""
    stamps = regular(400)
    at = np.delete(stamps[0] + step * np.arange(400 * STEP // step), slice(80, 84))
    values = np.zeros((at.size, 6))
    values[:, 2:] = np.random.default_rng(1).uniform(0.4, 0.6, (at.size, 4))
    got = read_bag(write_streams(tmp_path / 'bag', {
        '/imu/data': imu_stream(stamps), '/control/wrench': Stamped(at, values)},
        {'/gains/active': [Event(int(stamps[0]), {'mixer.desaturation': 'none'})]}))
    every = at[0] + STEP // 4 * np.arange(1600)
    held = values[np.searchsorted(at, every, side='right') - 1, 2:].reshape(400, 4, 4)
    lost = slice(20, 21) if step < STEP else slice(161, 168)
    assert np.isnan(got.control[lost]).all()
    np.testing.assert_allclose(np.delete(got.control, lost, 0),
                               np.delete(held.mean(axis=1), lost, 0), atol=1e-12)
    assert ('one for 2 cycles of /imu/data' in ' '.join(got.warnings)) is (step > STEP)


def test_samples_that_were_not_measured_are_gaps_with_a_warning(tmp_path):
    """NaN, and what a covariance of -1 marks (REP-145)."""
    imu = imu_stream(regular(100))
    imu.values[40, 5], imu.values[41, 6], imu.values[60, 11] = np.nan, np.inf, -1.0
    imu.values[:, 12] = -1.0
    got = read_bag(write_imu(tmp_path / 'bag', regular(100), imu))
    assert np.isnan([got.rates[40, 0], got.rates[41, 1], *got.rates[60]]).all()
    assert '3 samples of angular_velocity' in ' '.join(got.warnings)
    assert got.axis('roll').segments == ((0, 40), (41, 60), (61, 100))
    assert got.acceleration is None
    assert read_bag(write_bag(got, tmp_path / 'again')).acceleration is None


def test_what_is_published_again_until_the_next_one_is_measured_is_taken_once(tmp_path):
    """Between orientations lies a line."""
    imu, t = imu_stream(regular()), 0.02 * np.arange(N)
    leans = 0.3 * np.sin(t)
    imu.values[:, :4] = Rotation.from_euler(
        'x', np.repeat(leans[::2], 2)[:, None]).as_quat()
    imu.values[1::2, 5:8] = imu.values[::2, 5:8]
    record = read_bag(write_imu(tmp_path / 'bag', regular(), imu))
    np.testing.assert_array_equal(record.rates[::2], imu.values[::2, 5:8])
    assert np.isnan(record.rates[1::2]).all()
    np.testing.assert_allclose(record.angles[:-1, 0], leans[:-1], atol=1e-4)
    for what in ('a rate', 'an orientation'):
        assert f'/imu/data: {what} stands in 2 messages' in ' '.join(record.warnings)


@pytest.mark.parametrize(('volts', 'there'), [(np.nan, False), (0.004, False), (11.1, True)])
def test_a_battery_that_was_not_measured_is_none(tmp_path, volts, there):
    battery = Stamped(regular(100)[::25], np.full((4, 1), volts))
    got = read_bag(write_imu(tmp_path / 'bag', regular(100), **{'/battery': battery}))
    assert (got.battery_v is not None) is there
    assert ('/battery' in got.missing) is ('/battery' in ' '.join(got.warnings)) is not there


def test_no_voltage_is_invented_long_before_or_behind_its_messages(tmp_path):
    stamps = regular(2500)
    battery = Stamped(stamps[1000:1251:25], np.full((11, 1), 11.1))
    got = read_bag(write_imu(tmp_path / 'bag', stamps, **{'/battery': battery}))
    assert np.flatnonzero(np.isfinite(got.battery_v)).tolist() == list(range(500, 1751))


@pytest.mark.parametrize('frame', ['body', 'world', 'none'])
def test_speeds_are_along_the_heading_whatever_frame_the_twist_is_in(tmp_path, frame):
    """REP-105 has it in the body's; where it is not, or not filled in, the positions say so."""
    t = 1e-9 * STEP * np.arange(N)
    attitude = np.column_stack([0.1 * np.sin(t), 0.2 * np.cos(t), 2.0 + t])
    level = np.column_stack([1.0 + np.sin(2.0 * t), 0.5 * np.cos(3.0 * t), 0.3 * np.sin(t)])
    world = Rotation.from_euler('z', attitude[:, 2:]).apply(level)
    body = Rotation.from_euler('ZYX', attitude[:, ::-1])
    twist = {'body': body.inv().apply(world), 'world': world, 'none': 0.0 * world}[frame]
    place = 1e-9 * STEP * np.cumsum(world, axis=0)
    odom = Stamped(regular(), np.hstack([place, body.as_quat(), twist]))
    got = read_bag(write_imu(tmp_path / 'bag', regular(), **{'/odom': odom}))
    np.testing.assert_allclose(got.velocity, level, atol=0.02)


def test_where_the_barometer_is_silent_no_vertical_speed_is_known():
    time, swing = 0.004 * np.arange(15_000), 0.1 * np.pi
    speed, height = 2.0 * np.sin(swing * time), 2.0 / swing * (1.0 - np.cos(swing * time))
    force = np.column_stack([0 * time, 0 * time, 9.80665 + 2.0 * swing * np.cos(swing * time)])
    pressure = 101_325.0 * (1.0 - height / 44_330.77) ** 5.25588  # standard atmosphere
    silent = (time > 30.0) & (time < 35.0)
    rows = np.flatnonzero(~silent)[::5]
    baro = Stamped(regular(time.size)[rows], pressure[rows, None])
    grid = uniform_grid(regular(time.size), 'bag')
    moved = moving({'/baro': baro}, grid, np.zeros_like(force), force, [])
    got = moved.velocity[:, 2]
    assert np.isnan(got[silent]).all()
    known = np.isfinite(got)
    assert known.sum() > 0.98 * np.count_nonzero(~silent)
    known &= (time > 10.0) & (time < 50.0)
    assert np.abs(got - speed)[known].max() < 0.1
    assert np.abs(moved.altitude - height)[known].max() < 0.2


def test_any_cut_or_noise_gives_a_record_or_one_line(tmp_path):
    whole = (write_bag(make_record(100), tmp_path / 'bag') / 'bag.mcap').read_bytes()
    rng = np.random.default_rng(5)
    spoiled, read = tmp_path / 'spoiled.mcap', 0
    for length in sorted(rng.integers(0, len(whole), 30)):
        spoiled.write_bytes(whole[:length])
        read += record_or_line(spoiled)
    assert read > 5
    for _ in range(20):
        data = bytearray(whole)
        for place in rng.integers(8, len(data), 20):
            data[place] = rng.integers(256)
        spoiled.write_bytes(bytes(data))
        record_or_line(spoiled)


@pytest.mark.parametrize(('name', 'content', 'words'), [
    ('absent', None, 'no such bag'), ('empty.mcap', b'', 'is empty'),
    ('folder', '', 'metadata.yaml names lost.mcap'),
    ('table.csv', b't,u\n0,1\n', 'quad-sysid import'),
    ('broken.db3', b'SQLite format 3\x00' + bytes(500), 'is a damaged sqlite3 file'),
])
def test_what_is_no_bag_ends_in_one_line(tmp_path, refusal, name, content, words):
    path = tmp_path / name
    if content == '':
        path.mkdir()
        listed = {'rosbag2_bagfile_information': {'relative_file_paths': ['lost.mcap']}}
        (path / 'metadata.yaml').write_text(yaml.safe_dump(listed))
    elif content is not None:
        path.write_bytes(content)
    assert words in refusal(read_bag, path)


UNEVEN = T0 + np.cumsum(
    np.repeat(np.random.default_rng(0).uniform(1.0, 10.0, 60), 40) * STEP
).astype(np.int64)


@pytest.mark.parametrize(
    ('topics', 'stamps', 'words'),
    [
        (('/imu/data',), regular(10), '/control/wrench'),
        (('/control/wrench',), regular(10), '/imu/data'),
        (('/imu/data', '/control/wrench'), regular(2), 'too few'),
        (('/imu/data', '/control/wrench'), UNEVEN,
         'no steady rate: found 81 % of the time more than 15 % off 42.57 Hz'),
        (('/mavros/imu/data', '/control/wrench'), regular(10),
         'the rates may be in /mavros/imu/data: `quad-sysid import`'),
    ],
)
def test_a_bag_that_lacks_too_much_ends_in_one_line(tmp_path, refusal, topics, stamps, words):
    wrench, imu = Stamped(stamps, np.zeros((len(stamps), 6))), imu_stream(stamps)
    streams = {'/imu/data': imu, '/mavros/imu/data': imu, '/control/wrench': wrench}
    with mock.patch.dict(TOPIC_TYPES, {'/mavros/imu/data': TOPIC_TYPES['/imu/data']}):
        bag = write_streams(tmp_path / 'bag', {name: streams[name] for name in topics}, {})
    assert words in refusal(read_bag, bag)


@pytest.mark.parametrize('compression', ['none', 'storage', 'message'])
def test_a_cut_off_mcap_gives_what_is_whole(tmp_path, compression):
    want = make_record(3000)
    bag = write_bag(want, tmp_path / 'bag', BagOptions('mcap', compression))
    whole, cut, previous = (bag / 'bag.mcap').read_bytes(), tmp_path / 'cut.mcap', 0
    for share in (0.5, 0.9):  # and as a disk leaves it
        cut.write_bytes(whole[: int(share * len(whole))] + bytes(20_000_000 * (share == 0.9)))
        os.utime(cut, (0.0, 0.0))  # long ago: nobody records it any more
        got = read_bag(cut)
        assert got.n > previous
        previous = got.n
        np.testing.assert_array_equal(got.rates, want.rates[: got.n])
        assert 'cut off' in ' '.join(got.warnings)
    assert previous > 0.6 * want.n
    shutil.copy(cut, bag / 'bag.mcap')  # of which metadata.yaml says how much there was
    os.utime(bag / 'bag.mcap', (0.0, 0.0))
    assert 'of 18126 messages are missing' in ' '.join(read_bag(bag).warnings)
    end = whole.rindex(b'\x0f\x04' + bytes(7))  # of the data: the last chunk goes, its end stays
    cut.write_bytes(whole[: end - 20_000] + whole[end:])
    assert 'bytes are damaged' in ' '.join(read_bag(cut).warnings)


def test_strange_segments_count_as_idle(tmp_path):
    events = [
        Event(T0 - 10**9, {'segment': 'train', 'signal': 'prbs', 'axis': 'roll'}),
        Event(T0 + 10**9, {'segment': 'trian', 'axis': 'roll'}),
        *2 * [Event(T0 + 2 * 10**9, {'segment': 'validation', 'axis': 'nose'})],
    ]
    got = read_bag(write_imu(tmp_path / 'bag', regular(), **{'/excitation/segment': events}))
    assert [(s.role, s.start_s, s.end_s) for s in got.segments] == [
        ('train', 0.0, 1.0), ('idle', 1.0, 2.0), ('idle', 2.0, 4.0),
    ]
    assert "'trian'" in ' '.join(got.warnings)


@pytest.mark.parametrize(('killed_s', 'end_s'), [(2.6, 2.6), (3.2, 4.0), (0.5, 4.0)])
def test_a_segment_whose_node_was_killed_ends_with_its_excitation(tmp_path, killed_s, end_s):
    """Not with the landing and what was done by hand after it; without any it is left alone."""
    made = make_record()
    flown = np.where(np.arange(N)[:, None] < killed_s / 0.004, made.excitation, np.nan)
    segments = made.segments[0], replace(made.segments[1], end_s=4.0)
    bag = write_bag(replace(made, excitation=flown, segments=segments), tmp_path / 'bag')
    got = read_bag(bag)
    assert [(s.role, pytest.approx(s.end_s)) for s in got.segments] == [
        ('idle', 1.0), ('train', end_s)]
    assert ('train of roll ends at' in ' '.join(got.warnings)) is (end_s < 4.0)


@pytest.mark.parametrize(
    ('bare', 'asked', 'spans'),
    [
        (True, {}, [('train', 0.0, 2.4), ('validation', 2.4, 4.0)]),
        (True, {'validate': (3.0, 4.0)}, [('train', 0.0, 3.0), ('validation', 3.0, 4.0)]),
        (False, {}, [('train', 1.0, 3.0), ('validation', 3.0, 4.0)]),
        (False, {'train': (1.5, 2.5)}, [('train', 1.5, 2.5), ('validation', 3.0, 4.0)]),
        (False, {'train': (1.5, 2.5), 'validate': (3.2, 9.0)},
         [('train', 1.5, 2.5), ('validation', 3.2, 4.0)]),
    ],
)
def test_what_trains_and_what_validates(bare, asked, spans):
    record = replace(make_record(), segments=()) if bare else make_record()
    got = split_segments(record, **asked, **({'axes': ('pitch',)} if bare else {}))
    told = [s for s in got.segments if s.role != 'idle']
    assert [(s.role, pytest.approx(s.start_s), pytest.approx(s.end_s)) for s in told] == spans
    assert {s.axis for s in told} == {'pitch' if bare else 'roll'}
    assert bare or [s.signal for s in told] == ['prbs', 'square']


def test_metadata_that_is_missing_or_lists_too_much_or_too_little_is_told(tmp_path):
    bag = write_bag(make_record(), tmp_path / 'bag')
    second = write_bag(replace(make_record(), t0_ns=T0 + N * STEP), tmp_path / 'second')
    for name, told in (('bag_1', 'read as parts of the flight'), ('copy', 'left out')):
        shutil.copy(second / 'second.mcap', bag / f'{name}.mcap')
        got = read_bag(bag)
        assert got.n == 2 * N
        assert f'does not list {name}.mcap: {told}' in ' '.join(got.warnings)
    file = second / 'metadata.yaml'
    file.write_text(file.read_text().replace('- second.mcap', '- second.mcap\n  - more.mcap'))
    assert 'more.mcap' in ' '.join(read_bag(second).warnings)
    file.unlink()
    (second / 'second.mcap.zstd').write_bytes(b'\x28\xb5\x2f\xfd')  # killed as it compressed
    assert (got := read_bag(second)).n == N
    assert 'metadata.yaml is missing' in got.warnings[0]
    assert len(got.warnings) == 1


def test_each_file_of_a_split_bag_holds_what_is_in_force(tmp_path):
    whole = write_bag(replace(make_record(), craft=LAYOUTS['plus']), tmp_path / 'whole')
    split = BagWriter(tmp_path / 'split', Limits(split_s=1.5))
    with Reader(whole) as reader:
        for c, time_ns, raw in reader.messages():
            split.add_topic(c.topic, c.msgtype)
            split.write(c.topic, time_ns, raw)
        assert split.counts == {c.topic: c.msgcount for c in reader.connections}
    split.close()
    one, all_parts = read_bag(whole), read_bag(split.path)
    assert one.craft.motors == LAYOUTS['plus'].motors
    assert (all_parts.segments, all_parts.gains, all_parts.craft) == (
        one.segments, one.gains, one.craft)
    starts_s = (0.0, 1.5, 3.0)
    for part, start_s in enumerate(starts_s):
        alone = read_bag(split.path / f'split_{part}.mcap')
        assert alone.craft == one.craft
        assert alone.gains_at(0.0) == one.gains_at(start_s)
        running = next(s for s in one.segments if s.start_s <= start_s < s.end_s)
        assert (alone.segments[0].role, alone.segments[0].parameters) == (
            running.role, running.parameters)
        assert 'split bag' not in ' '.join(alone.warnings)
    (split.path / 'metadata.yaml').unlink()
    (split.path / 'split_1.mcap').unlink()
    assert 'part 1 of the bag is missing' in ' '.join(read_bag(split.path).warnings)
    bare = write_imu(tmp_path / 'bare', regular())  # as other recorders split
    for name, is_told in (('flight_1', True), ('flight_0', False), ('flight_20250101', False)):
        file = shutil.copy(bare / 'bare.mcap', tmp_path / f'{name}.mcap')
        shutil.copytree(bare, folder := tmp_path / f'of_{name}')  # whose first file is gone
        (folder / 'bare.mcap').replace(folder / file.name)
        for bag in (file, folder):
            assert ('split bag' in ' '.join(read_bag(bag).warnings)) == is_told
