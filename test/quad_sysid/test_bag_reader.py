"""read_bag: the contract's bags in every storage, and bags as flights really leave them."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from quad_sysid.bags import (
    BagOptions,
    cdr,
    parse_span,
    read_bag,
    split_segments,
    write_bag,
    write_streams,
)
from quad_sysid.bags.cdr import Stamped, decode
from quad_sysid.bags.events import Event
from quad_sysid.bags.stamps import uniform_grid
from quad_sysid.contract import MIXER, control_from_motors, motors_from_wrench
from quad_sysid.errors import BadInputError
from quad_sysid.record import GainChange, Record, Segment

SHARED = Path(__file__).resolve().parents[2] / '../shared/data'
T0 = 1_750_000_000_123_456_789
N = 1000
STEP = 4_000_000


def make_record(n: int = N, dt: float = 0.004) -> Record:
    rng = np.random.default_rng(7)
    wrench = np.column_stack((np.full(n, 0.5), 0.3 * rng.standard_normal((n, 3))))
    motors = motors_from_wrench(wrench)
    return Record(
        source='made', dt=dt, t0_ns=T0,
        rates=rng.standard_normal((n, 3)),
        control=control_from_motors(motors),
        angles=np.column_stack(
            (
                0.4 * np.sin(np.arange(n) / 50), 0.3 * np.cos(np.arange(n) / 70),
                np.linspace(0.0, 9.0, n),
            )
        ),
        acceleration=rng.standard_normal((n, 3)),
        motors=motors, wrench=wrench,
        attitude_setpoint=rng.standard_normal((n, 3)),
        rate_setpoint=rng.standard_normal((n, 3)),
        excitation=rng.standard_normal((n, 3)),
        battery_v=np.linspace(12.0, 11.0, n),
        segments=(
            Segment('idle', 'none', 'roll', 'attitude', 0.0, 1.0),
            Segment('train', 'prbs', 'roll', 'attitude', 1.0, 3.0, {'amplitude': 0.2, 'bits': 9}),
            Segment('validation', 'square', 'roll', 'attitude', 3.0, 4.0),
        ),
        gains=(
            GainChange(0.0, {'roll.angle.kp': 3.0, 'roll.rate.kp': 0.07}),
            GainChange(2.0, {'roll.rate.kp': 0.09}),
        ),
    )


def imu_stream(stamps: np.ndarray, seed: int = 3) -> Stamped:
    values = np.random.default_rng(seed).standard_normal((len(stamps), 11))
    values[:, 4] = 0.0
    return Stamped(stamps.astype(np.int64), values)


def write_imu(path: Path, stamps: np.ndarray, **other: Stamped) -> Path:
    stamps = np.asarray(stamps)
    wrench = Stamped(stamps, np.tile([0.0, 0, 0.5, 0.1, 0, 0], (len(stamps), 1)))
    return write_streams(
        path, {'/imu/data': imu_stream(stamps), '/control/wrench': wrench, **other}, {}
    )


def regular(n: int = N) -> np.ndarray:
    return T0 + STEP * np.arange(n, dtype=np.int64)


def refusal(path: Path) -> str:
    with pytest.raises(BadInputError) as caught:
        read_bag(path)
    line = str(caught.value)
    assert '\n' not in line
    return line


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
    [
        ('mcap', 'none'), ('mcap', 'message'), ('mcap', 'file'), ('mcap', 'storage'),
        ('sqlite3', 'none'), ('sqlite3', 'message'), ('sqlite3', 'file'),
    ],
)
def test_a_record_survives_every_storage(tmp_path, storage, compression):
    want = make_record()
    path = write_bag(want, tmp_path / 'bag', BagOptions(storage, compression))
    got = read_bag(path)
    assert got.dt == 0.004
    assert got.t0_ns == T0
    assert got.warnings == ()
    assert got.missing == ()
    for name in (
        'rates', 'acceleration', 'motors', 'wrench', 'control', 'attitude_setpoint',
        'rate_setpoint', 'excitation',
    ):
        np.testing.assert_array_equal(getattr(got, name), getattr(want, name), err_msg=name)
    np.testing.assert_allclose(got.angles, want.angles, atol=1e-12)
    np.testing.assert_allclose(got.battery_v[:975], want.battery_v[:975], atol=1e-5)
    assert got.segments == want.segments
    assert got.gains == want.gains
    assert got.gains_at(2.5) == {'roll.angle.kp': 3.0, 'roll.rate.kp': 0.09}


def test_arrays_of_a_record_are_read_only(tmp_path):
    got = read_bag(write_bag(make_record(), tmp_path / 'bag'))
    with pytest.raises(ValueError, match='read-only'):
        got.rates[0, 0] = 1.0


def test_a_bare_mcap_file_is_a_bag_also_with_compressed_messages(tmp_path):
    bag = write_bag(make_record(), tmp_path / 'bag', BagOptions('mcap', 'message'))
    bare = shutil.copy(bag / 'bag.mcap', tmp_path / 'bare.mcap')
    np.testing.assert_array_equal(read_bag(bare).rates, make_record().rates)


def test_without_motors_the_wrench_goes_through_the_mixer_and_its_limits(tmp_path):
    want = replace(make_record(), motors=None)
    got = read_bag(write_bag(want, tmp_path / 'bag'))
    assert (motors_from_wrench(want.wrench) != want.wrench @ MIXER.T).any()
    np.testing.assert_allclose(got.control, want.control, atol=1e-15)
    assert got.motors is None
    assert any('/motors/command' in line for line in got.warnings)


def test_motors_are_taken_by_their_names():
    store = cdr.typestore()
    types = store.types
    header = types['std_msgs/msg/Header'](
        stamp=types['builtin_interfaces/msg/Time'](sec=1, nanosec=2), frame_id='abc'
    )

    def message(names: list[str], effort: list[float]) -> bytes:
        return bytes(
            store.serialize_cdr(
                types[cdr.JOINTS](
                    header=header, name=names, position=np.ones(len(effort)),
                    velocity=np.zeros(0), effort=np.array(effort),
                ),
                cdr.JOINTS,
            )
        )

    names = ['motor_4', 'motor_2', 'motor_3', 'motor_1']
    got = decode(
        cdr.JOINTS,
        [
            message(names, [0.4, 0.2, 0.3, 0.1]),
            message(sorted(names), [0.1, 0.2, 0.3, 0.4]),
            message(['a', 'b', 'c', 'd'], [0.1, 0.2, 0.3, 0.4]),
            message(names[:3], [0.1, 0.2, 0.3]),
            b'\x00\x01\x00\x00junk',
        ],
    )
    np.testing.assert_array_equal(got.values, [[0.1, 0.2, 0.3, 0.4]] * 2)
    assert got.stamps.tolist() == [1_000_000_002] * 2
    assert got.spoiled == 3


def test_bulk_decoding_equals_rosbags_bit_for_bit(tmp_path):
    from rosbags.rosbag2 import Reader

    from quad_sysid.bags.cdr import WIDTH, _decode_one

    bag = write_bag(make_record(200), tmp_path / 'bag')
    seen = 0
    with Reader(bag) as reader:
        for connection, _, raw in reader.messages():
            if connection.msgtype in WIDTH:
                bulk = decode(connection.msgtype, [raw])
                stamp, values = _decode_one(connection.msgtype, raw)
                assert bulk.stamps[0] == stamp
                np.testing.assert_array_equal(bulk.values[0], values)
                seen += 1
    assert seen > 1000


@pytest.mark.parametrize('name', ['flight', 'second_flight'])
def test_bags_of_somebody_else_are_read(name):
    bag = SHARED / 'independent' / name
    if not bag.exists():
        pytest.skip('the measured data are not beside this checkout')
    record = read_bag(bag)
    assert record.dt == 0.004
    assert record.n == {'flight': 22_500, 'second_flight': 17_500}[name]
    assert np.isfinite(record.rates).all()
    assert np.isfinite(record.control).all()
    assert record.missing == ()
    starts = [s.start_s for s in record.segments]
    assert starts == {
        'flight': [0.0, 5.0, 45.0, 47.0, 67.0, 69.0, 89.0],
        'second_flight': [0.0, 5.0, 30.0, 32.0, 47.0, 49.0, 69.0],
    }[name]
    assert {s.signal for s in record.segments if s.role == 'train'} <= {'prbs'}
    assert record.gains_at(1.0)['sensor.gyro_filter_hz'] == 42.0
    assert 11.0 < np.min(record.battery_v) < np.max(record.battery_v) < 13.0
    assert [line for line in record.warnings if 'battery' in line]


# ---- stamps -----------------------------------------------------------------------------------


def test_lost_cycles_are_gaps_and_never_invented(tmp_path):
    keep = np.ones(N, dtype=bool)
    keep[[100, 300, 301, 302]] = False
    stamps = regular()[keep]
    got = read_bag(write_imu(tmp_path / 'bag', stamps))
    assert got.n == N
    np.testing.assert_array_equal(np.isnan(got.rates[:, 0]), ~keep)
    assert '4 of 1000 cycles lost' in '\n'.join(got.warnings)
    assert len(got.axis('roll').segments) == 3


def test_jitter_and_drift_of_the_stamps_do_not_lose_samples():
    rng = np.random.default_rng(1)
    n = 50_000
    drift = 4_000_321.7 * np.arange(n) + 0.2 * STEP * rng.uniform(-1, 1, n)
    grid = uniform_grid((T0 + drift).astype(np.int64), 'bag')
    np.testing.assert_array_equal(grid.cells, np.arange(n))
    assert grid.dt == 0.004
    odd = uniform_grid((T0 + np.arange(5000) * 1e9 / 300).astype(np.int64), 'bag')
    assert odd.dt == pytest.approx(1 / 300, rel=2e-4)


def test_the_phase_may_change_in_a_long_gap():
    stamps = np.concatenate((regular(500), regular(500) + 700 * STEP + STEP // 2))
    grid = uniform_grid(stamps, 'bag')
    assert np.diff(grid.cells).max() in (201, 202)
    assert np.count_nonzero(np.diff(grid.cells) != 1) == 1


def test_duplicate_stamps_keep_the_first(tmp_path):
    stamps = np.repeat(regular(), np.where(np.arange(N) == 50, 3, 1))
    got = read_bag(write_imu(tmp_path / 'bag', stamps))
    want = imu_stream(stamps).values
    assert got.n == N
    np.testing.assert_array_equal(got.rates[50], want[50, 5:8])
    np.testing.assert_array_equal(got.rates[51], want[53, 5:8])
    assert '2 messages repeat a stamp' in '\n'.join(got.warnings)


def test_swapped_messages_are_sorted_by_stamp():
    stamps = regular(100)
    stamps[[10, 11]] = stamps[[11, 10]]
    grid = uniform_grid(stamps, 'bag')
    assert grid.rows[10:12].tolist() == [11, 10]
    assert '1 stamps run backward' in grid.warnings[0]


def test_a_clock_set_back_keeps_the_longest_part():
    stamps = np.concatenate((regular(700), regular(300) - 5_000_000_000))
    grid = uniform_grid(stamps, 'bag')
    assert grid.n == 700
    assert 'set back' in grid.warnings[0]


def test_a_lone_wild_stamp_does_not_cost_the_flight():
    stamps = regular(500)
    stamps[200] += 86_400 * 10**9
    stamps[300] = 0
    grid = uniform_grid(stamps, 'bag')
    assert grid.n == 500
    assert len(grid.cells) == 498


def test_a_changed_rate_is_a_gap_with_a_warning():
    fast = regular(2000)
    slow = fast[-1] + 2 * STEP * np.arange(1, 401)
    grid = uniform_grid(np.concatenate((fast, slow)), 'bag')
    assert grid.dt == 0.004
    assert abs(len(grid.cells) - 2000) <= 32
    assert any('changes from 250 Hz to about 125 Hz at 7.9' in w for w in grid.warnings)


def test_no_steady_rate_is_refused():
    rng = np.random.default_rng(0)
    slots = np.repeat(rng.uniform(1.0, 10.0, 60), 40)
    with pytest.raises(BadInputError, match='no steady rate'):
        uniform_grid(T0 + np.cumsum(slots * STEP).astype(np.int64), 'bag')


def test_topics_at_other_stamps_go_to_the_nearest_cycle(tmp_path):
    stamps = regular(100)
    other = Stamped(stamps + 1_500_000, np.arange(300.0).reshape(100, 3))
    far = Stamped(stamps[-1:] + 10 * STEP, np.ones((1, 3)))
    others = {'/setpoint/rates': other, '/setpoint/attitude': far}
    got = read_bag(write_imu(tmp_path / 'bag', stamps, **others))
    np.testing.assert_array_equal(got.rate_setpoint, other.values)
    assert got.attitude_setpoint is None
    assert '/setpoint/attitude' in got.missing


def test_nan_samples_are_kept_as_gaps_with_a_warning(tmp_path):
    stamps = regular(100)
    imu = imu_stream(stamps)
    imu.values[40, 5] = np.nan
    imu.values[41, 6] = np.inf
    wrench = Stamped(stamps, np.tile([0.0, 0, 0.5, 0.1, 0, 0], (100, 1)))
    bag = write_streams(tmp_path / 'bag', {'/imu/data': imu, '/control/wrench': wrench}, {})
    got = read_bag(bag)
    assert np.isnan(got.rates[40, 0])
    assert np.isnan(got.rates[41, 1])
    assert '2 samples of angular_velocity' in '\n'.join(got.warnings)
    assert got.axis('roll').segments == ((0, 40), (41, 100))


@pytest.mark.parametrize(
    ('volts', 'measured'),
    [(np.nan, False), (0.004, False), (11.1, True)],
)
def test_a_battery_that_was_not_measured_is_none(tmp_path, volts, measured):
    battery = Stamped(regular(100)[::25], np.full((4, 1), volts))
    got = read_bag(write_imu(tmp_path / 'bag', regular(100), **{'/battery': battery}))
    assert (got.battery_v is not None) is measured
    assert ('/battery' in got.missing) is not measured
    assert any('/battery' in line for line in got.warnings) is not measured


@pytest.mark.parametrize('kind', ['identity', 'zero', 'unknown'])
def test_an_orientation_that_was_not_measured_is_none(tmp_path, kind):
    stamps = regular(50)
    imu = imu_stream(stamps)
    imu.values[:, :5] = (0.0, 0.0, 0.0, 0.0 if kind == 'zero' else 1.0, 0.0)
    if kind == 'unknown':
        imu.values[:, 0] = 0.5
        imu.values[:, 4] = -1.0
    wrench = Stamped(stamps, np.zeros((50, 6)))
    bag = write_streams(tmp_path / 'bag', {'/imu/data': imu, '/control/wrench': wrench}, {})
    assert read_bag(bag).angles is None


# ---- damaged and foreign bags -----------------------------------------------------------------


@pytest.mark.parametrize('compression', ['none', 'storage', 'message'])
def test_a_cut_off_mcap_gives_what_is_whole(tmp_path, compression):
    want = make_record(6000)
    bag = write_bag(want, tmp_path / 'bag', BagOptions('mcap', compression))
    whole = (bag / 'bag.mcap').read_bytes()
    previous = 0
    for share in (0.5, 0.7, 0.9):
        cut = tmp_path / f'cut{share}.mcap'
        cut.write_bytes(whole[: int(share * len(whole))])
        got = read_bag(cut)
        assert got.n > previous
        previous = got.n
        np.testing.assert_array_equal(got.rates, want.rates[: got.n])
        assert 'cut off' in '\n'.join(got.warnings)
    assert previous > 0.6 * want.n


def test_every_cut_gives_a_record_or_one_line(tmp_path):
    whole = (write_bag(make_record(100), tmp_path / 'bag') / 'bag.mcap').read_bytes()
    rng = np.random.default_rng(5)
    cut = tmp_path / 'cut.mcap'
    read = 0
    for length in sorted(rng.integers(0, len(whole), 60)):
        cut.write_bytes(whole[:length])
        read += record_or_line(cut)
    assert read > 10


def test_noise_in_the_file_never_raises_anything_else(tmp_path):
    whole = (write_bag(make_record(100), tmp_path / 'bag') / 'bag.mcap').read_bytes()
    rng = np.random.default_rng(6)
    spoiled = tmp_path / 'spoiled.mcap'
    for _ in range(40):
        data = bytearray(whole)
        for place in rng.integers(8, len(data), 20):
            data[place] = rng.integers(256)
        spoiled.write_bytes(bytes(data))
        record_or_line(spoiled)


def test_a_directory_without_metadata_is_read_with_a_warning(tmp_path):
    bag = write_bag(make_record(), tmp_path / 'bag', BagOptions('sqlite3'))
    (bag / 'metadata.yaml').unlink()
    got = read_bag(bag)
    assert got.n == N
    assert 'metadata.yaml is missing' in got.warnings[0]


def test_a_listed_file_that_is_gone_is_told(tmp_path):
    bag = write_bag(make_record(), tmp_path / 'bag')
    text = (bag / 'metadata.yaml').read_text()
    (bag / 'metadata.yaml').write_text(text.replace('- bag.mcap', '- bag.mcap\n  - bag_1.mcap'))
    assert 'bag_1.mcap' in '\n'.join(read_bag(bag).warnings)


def test_bags_that_are_none_end_in_one_line(tmp_path):
    assert 'no such bag' in refusal(tmp_path / 'absent')
    empty = tmp_path / 'empty.mcap'
    empty.write_bytes(b'')
    assert 'is empty' in refusal(empty)
    (tmp_path / 'folder').mkdir()
    assert 'no storage file' in refusal(tmp_path / 'folder')
    foreign = tmp_path / 'table.csv'
    foreign.write_text('t,u\n0,1\n')
    assert 'quad-sysid import' in refusal(foreign)
    text = tmp_path / 'notes.mcap'
    text.write_text('hello, this is no bag')
    assert 'neither mcap nor sqlite3' in refusal(text)
    broken = tmp_path / 'broken.db3'
    broken.write_bytes(b'SQLite format 3\x00' + bytes(500))
    assert '/imu/data' in refusal(broken)
    assert 'damaged sqlite3 file' in refusal(broken)  # why it is missing


def test_missing_topics_end_in_one_line_with_the_topic(tmp_path):
    stamps = regular(10)
    only_imu = write_streams(tmp_path / 'a', {'/imu/data': imu_stream(stamps)}, {})
    line = refusal(only_imu)
    assert '/motors/command' in line
    assert '/control/wrench' in line
    wrench = Stamped(stamps, np.zeros((10, 6)))
    no_imu = write_streams(tmp_path / 'b', {'/control/wrench': wrench}, {})
    assert '/imu/data' in refusal(no_imu)
    short = write_imu(tmp_path / 'c', stamps[:2])
    assert 'too few' in refusal(short)


def test_a_bag_is_never_overwritten(tmp_path):
    bag = write_bag(make_record(10), tmp_path / 'bag')
    with pytest.raises(BadInputError, match='not overwritten'):
        write_bag(make_record(10), bag)


def test_strange_segments_count_as_idle(tmp_path):
    stamps = regular()
    events = [
        Event(T0 - 10**9, {'segment': 'train', 'signal': 'prbs', 'axis': 'roll'}),
        Event(T0 + 10**9, {'segment': 'trian', 'axis': 'roll'}),
        Event(T0 + 2 * 10**9, {'segment': 'validation', 'axis': 'nose'}),
        Event(T0 + 2 * 10**9, {'segment': 'validation', 'axis': 'nose'}),
    ]
    bag = write_streams(
        tmp_path / 'bag',
        {'/imu/data': imu_stream(stamps), '/control/wrench': Stamped(stamps, np.zeros((N, 6)))},
        {'/excitation/segment': events},
    )
    got = read_bag(bag)
    assert [(s.role, s.start_s, s.end_s) for s in got.segments] == [
        ('train', 0.0, 1.0), ('idle', 1.0, 2.0), ('idle', 2.0, 4.0),
    ]
    assert "'trian'" in '\n'.join(got.warnings)


# ---- splitting --------------------------------------------------------------------------------


def test_without_segments_the_first_sixty_percent_train():
    record = replace(make_record(), segments=())
    got = split_segments(record, axes=('pitch',))
    assert [(s.role, s.axis, s.start_s, s.end_s) for s in got.segments] == [
        ('train', 'pitch', 0.0, pytest.approx(2.4)),
        ('validation', 'pitch', pytest.approx(2.4), 4.0),
    ]
    assert split_segments(make_record()).segments == make_record().segments


def test_spans_of_the_user_replace_the_bags_segments():
    got = split_segments(make_record(), train=(1.5, 2.5), validate=(3.2, 9.0))
    told = [(s.role, s.signal, s.start_s, s.end_s) for s in got.segments if s.role != 'idle']
    assert told == [('train', 'prbs', 1.5, 2.5), ('validation', 'square', 3.2, 4.0)]
    alone = split_segments(make_record(), train=(1.5, 2.5))
    assert [s.start_s for s in alone.segments if s.role == 'validation'] == [3.0]
    plain = split_segments(replace(make_record(), segments=()), validate=(3.0, 4.0), axes=('yaw',))
    assert [(s.role, s.start_s, s.end_s) for s in plain.segments] == [
        ('train', 0.0, 3.0), ('validation', 3.0, 4.0),
    ]


def test_bad_spans_are_refused():
    with pytest.raises(BadInputError, match='overlap'):
        split_segments(make_record(), train=(1.0, 3.5))
    with pytest.raises(BadInputError, match='after the end'):
        split_segments(make_record(), train=(10.0, 12.0))
    for text in ('5', '5:4', 'a:b', ':'):
        if text == ':':
            assert parse_span(text, '--train') == (0.0, float('inf'))
        else:
            with pytest.raises(BadInputError, match='--train'):
                parse_span(text, '--train')
    assert parse_span('5:45', '--train') == (5.0, 45.0)


# ---- what is damaged is told, and read as far as it is whole ----------------------------------


def chunks_of(data: bytes) -> list[int]:
    """Where the chunks of an mcap file begin."""
    found, place = [], 8
    while place + 9 <= len(data) - 8:
        if data[place] == 6:
            found.append(place)
        place += 9 + int.from_bytes(data[place + 1 : place + 9], 'little')
    return found


@pytest.fixture(scope='module')
def chunked(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, np.ndarray]:
    """An mcap file of many chunks, and the rates in it."""
    bag = write_bag(make_record(60_000), tmp_path_factory.mktemp('b') / 'bag',
                    BagOptions('mcap', 'storage'))  # fmt: skip
    return (bag / 'bag.mcap').read_bytes(), read_bag(bag).rates


@pytest.mark.parametrize('harm', ['length', 'opcode', 'private', 'checksum'])
def test_a_damaged_chunk_costs_that_chunk_and_is_told(tmp_path, chunked, harm):
    data, rates = chunked
    chunks = chunks_of(data)
    assert len(chunks) > 5
    place = chunks[2]
    noisy = bytearray(data)
    where, mask = {
        'length': (3, 0x02), 'opcode': (0, 0x01), 'private': (0, 0x80),
        'checksum': (9 + 24, 0x01),
    }[harm]  # fmt: skip
    noisy[place + where] ^= mask
    spoiled = tmp_path / 'spoiled.mcap'
    spoiled.write_bytes(bytes(noisy))
    got = read_bag(spoiled)
    assert got.n == len(rates)
    known = np.isfinite(got.rates[:, 0])
    np.testing.assert_array_equal(got.rates[known], rates[known])
    if harm in {'opcode', 'private'}:  # its lengths and its checksum hold
        assert known.all()
    else:
        assert 0.0 < 1.0 - known.mean() < 2.0 / len(chunks)
        assert 'damaged chunks' in '\n'.join(got.warnings)


def test_zeros_behind_the_data_are_passed_over_at_once(tmp_path, chunked):
    data, rates = chunked
    spoiled = tmp_path / 'spoiled.mcap'
    spoiled.write_bytes(data[: chunks_of(data)[3]] + bytes(20_000_000))
    got = read_bag(spoiled)
    assert 0 < got.n < len(rates)
    assert 'cut off' in '\n'.join(got.warnings)


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
@pytest.mark.parametrize('foreign_last', [True, False])
def test_of_a_topic_with_two_types_the_contracts_one_is_read(tmp_path, storage, foreign_last):
    from rosbags.rosbag2 import Reader, StoragePlugin, Writer

    bag = write_bag(make_record(200), tmp_path / 'bag')
    store = cdr.typestore()
    text = bytes(store.serialize_cdr(store.types['std_msgs/msg/String'](data='hello'),
                                     'std_msgs/msg/String'))  # fmt: skip
    plugin = StoragePlugin.MCAP if storage == 'mcap' else StoragePlugin.SQLITE3
    with Reader(bag) as reader, Writer(
        tmp_path / 'two', version=9, storage_plugin=plugin
    ) as writer:
        kinds = {c.topic: c.msgtype for c in reader.connections}
        pairs = [*kinds.items(), ('/imu/data', 'std_msgs/msg/String')]
        out = {
            pair: writer.add_connection(*pair, typestore=store)
            for pair in (pairs if foreign_last else pairs[::-1])
        }
        for connection, time, raw in reader.messages():
            writer.write(out[connection.topic, connection.msgtype], time, raw)
            if connection.topic == '/battery':
                writer.write(out['/imu/data', 'std_msgs/msg/String'], time, text)
    got = read_bag(tmp_path / 'two')
    np.testing.assert_array_equal(got.rates, make_record(200).rates)
    assert '/imu/data: 8 messages of type std_msgs/msg/String left out' in '\n'.join(got.warnings)


def test_parts_that_metadata_does_not_list_are_read_and_told(tmp_path):
    bag = write_bag(make_record(), tmp_path / 'bag')
    other = replace(make_record(), t0_ns=T0 + N * STEP)
    second = write_bag(other, tmp_path / 'second')
    shutil.copy(second / 'second.mcap', bag / 'bag_1.mcap')
    got = read_bag(bag)
    assert got.n == 2 * N
    assert 'does not list bag_1.mcap: read as parts of the flight' in '\n'.join(got.warnings)
    shutil.copy(second / 'second.mcap', bag / 'copy.mcap')
    got = read_bag(bag)
    assert got.n == 2 * N
    assert 'does not list copy.mcap: left out' in '\n'.join(got.warnings)


def test_rows_that_are_no_messages_are_told(tmp_path):
    import sqlite3

    bag = write_bag(make_record(), tmp_path / 'bag', BagOptions('sqlite3'))
    (file,) = bag.glob('*.db3')
    base = sqlite3.connect(file)
    for number, value in ((100, 1.5), (102, 'text'), (103, 5)):
        base.execute('UPDATE messages SET data=? WHERE id=?', (value, number))
    base.commit()
    base.close()
    data = file.read_bytes()
    assert '3 rows are no messages' in '\n'.join(read_bag(bag).warnings)
    rng = np.random.default_rng(9)
    for _ in range(30):
        noisy = bytearray(data)
        for place in rng.integers(0, len(data), 30):
            noisy[place] = rng.integers(256)
        file.write_bytes(bytes(noisy))
        record_or_line(bag)
