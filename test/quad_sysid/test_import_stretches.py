"""A flight without an experiment: what says something is used, and both roles hold some of it."""

from dataclasses import replace

import numpy as np
import pytest

from quad_sysid.bags import read_bag, write_bag
from quad_sysid.contract import motors_from_wrench
from quad_sysid.imports.stretches import airborne, blocks, summary, with_stretches
from quad_sysid.record import Record

DT = 0.004


def flight(seconds: float) -> Record:
    """On the ground for 5 s at either end, hovering without a motion from 20 s to 26 s."""
    rng = np.random.default_rng(1)
    n = round(seconds / DT)
    t = DT * np.arange(n)
    ground = (t < 5.0) | (t >= seconds - 5.0)
    still = (t >= 20.0) & (t < 26.0)
    moves = np.where(ground | still, 0.01, 1.0)[:, None]
    control = np.column_stack([np.where(ground, 0.1, 0.5), 0.05 * moves * rng.normal(size=(n, 3))])
    return Record('flight', DT, moves * rng.normal(size=(n, 3)), np.clip(control, -0.2, 0.5),
                  t0_ns=10**9)


def spans(record: Record, role: str, axis: str = 'roll') -> list[tuple[float, float]]:
    return [(round(s.start_s, 6), round(s.end_s, 6)) for s in record.segments
            if s.role == role and s.axis == axis]


def test_blocks_train_and_validate_and_the_rest_has_its_reason(tmp_path):
    found = with_stretches(flight(60.0))
    assert spans(found, 'idle') == [(0.0, 6.0), (20.0, 26.0), (54.0, 60.0)]
    assert [s.parameters['because'] for s in found.segments if s.axis == 'yaw' and s.role == 'idle'
            ] == ['ground', 'still', 'ground']
    assert spans(found, 'train') == [(6.0, 16.0), (27.0, 32.0), (37.0, 47.0), (52.0, 54.0)]
    assert spans(found, 'validation') == [(16.0, 20.0), (26.0, 27.0), (32.0, 37.0), (47.0, 52.0)]
    assert spans(found, 'train', 'pitch') == spans(found, 'train')
    assert summary(found) == ('the log holds no experiment: 27 s train, 15 s are held out; '
                              'left out: ground 12 s, still 6 s')
    read = read_bag(write_bag(replace(found, wrench=found.control), tmp_path / 'bag'))
    for axis in ('roll', 'pitch', 'yaw'):
        for role in ('train', 'validation', 'idle'):
            assert spans(read, role, axis) == spans(found, role, axis)


@pytest.mark.parametrize(('reason', 'change'), [('gap', 'rates'), ('saturated', 'motors')])
def test_gaps_and_limits_are_left_out(reason, change):
    record = flight(60.0)
    motors = motors_from_wrench(np.clip(record.control, -0.1, 0.6))
    record = replace(record, motors=motors)
    rates = record.rates.copy()
    if change == 'rates':
        rates[2000:2500] = np.nan
    else:
        motors[2000:2500, 2] = 1.0
    found = with_stretches(replace(record, rates=rates, motors=motors))
    assert (8.0, 10.0) in [(s.start_s, s.end_s) for s in found.segments
                           if s.parameters.get('because') == reason]


@pytest.mark.parametrize(('low', 'left_out'), [((30.0, 30.9), 0.0), ((30.4, 31.6), 3.2)])
def test_the_ground_is_where_the_throttle_stays_low_with_take_off_and_landing(low, left_out):
    """A dive of less than a second is flight."""
    throttle = np.full(10000, 0.5)
    throttle[round(low[0] / DT) : round(low[1] / DT)] = 0.05
    assert DT * np.sum(~airborne(throttle, DT)) == pytest.approx(left_out, abs=2 * DT)


@pytest.mark.parametrize('length', [18.0, 20.0, 31.0, 60.0, 108.0])
def test_the_slowest_and_the_quickest_of_a_sweep_train(length):
    parts = blocks(length)
    assert parts[0][0] == parts[-1][0] == 'train'
    assert [end for *_, end in parts[:-1]] == [begin for _, begin, _ in parts[1:]]
    assert (parts[0][1], parts[-1][2]) == (0.0, pytest.approx(length))
    trained = sum(end - begin for role, begin, end in parts if role == 'train')
    assert 0.55 < trained / length < 0.75
    assert all(end - begin >= 3.0 - 1e-9 for _, begin, end in parts)


def test_a_sweep_that_is_too_short_for_blocks_is_split_once():
    assert blocks(12.0) == [('train', 0.0, pytest.approx(7.2)),
                            ('validation', pytest.approx(7.2), 12.0)]
