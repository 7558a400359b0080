"""What drifts is named and dated, what is odd is named with its reason, and nothing else is.

The simulated fleet of 30 aircraft x 10 flights is one of rows: each parameter has its aircraft's
own value, what the day adds, and an error whose size its standard error tells.
"""

import json

import numpy as np
import pytest

from quad_sysid.fleets.drift import Series, _mean, over_fleet
from quad_sysid.fleets.page import Fleet

SIZES = {'gain': 450.0, 'lag': 0.04, 'delay': 0.008, 'damping': 0.4, 'bias': 0.2}
FIRST = 20_600.0
"""Day of the first flight since the epoch, in May 2026."""
BEARING, MOTOR = (7, 'roll', 'coulomb_friction.torque'), (11, 'pitch', 'gain')
BEGIN = 90.0


def fleet(seed, *, wear=True, odd=False, aircraft=30, flights=10):
    """Every value scatters by 2 % between days and 3 % by its estimate, by 10 % over aircraft.

    The bearing of one aircraft wears from day 90 on: its friction grows by half. A motor of
    another weakens from the first day: its gain falls by a quarter. Friction is found in every
    third flight of all others, of a size that is hardly found.
    """
    rng = np.random.default_rng(seed)
    own = {(k, axis, name): size * (1.0 + 0.1 * rng.standard_normal())
           for k in range(aircraft) for axis in ('roll', 'pitch') for name, size in SIZES.items()}
    rows = []
    for k in range(aircraft):
        for i, day in enumerate(np.linspace(0.0, 180.0, flights) + rng.uniform(0.0, 5.0, flights)):
            row = {'bag': f'craft_{k:02d}/{i}', 'aircraft': f'craft_{k:02d}', 'reason': '',
                   'status': 'answered', 'start_ns': int((FIRST + day) * 86_400e9)}
            for axis in ('roll', 'pitch'):
                for name in SIZES:
                    value = own[k, axis, name]
                    std = 0.03 * abs(value) * float(np.exp(0.3 * rng.standard_normal()))
                    scatter = (0.02 * value * rng.standard_normal() + std * rng.standard_normal())
                    if wear and (k, axis, name) == MOTOR:
                        value *= 1.0 - 0.3 * day / 180.0
                    if odd and (k, i, axis, name) == (3, 4, 'pitch', 'lag'):
                        value *= 1.6
                    if (k, axis, name) == (5, 'roll', 'delay') and i >= flights // 2:
                        scatter, std = 10.0 * value, None  # at its bound
                    row |= {f'{axis}_{name}': value + scatter, f'{axis}_{name}_std': std}
                friction = {}
                torque = 1.0 * (1.0 + 0.6 * max(0.0, day - BEGIN) / 90.0) if wear else 1.0
                if (k, axis) == BEARING[:2] or rng.random() < 1 / 3:
                    size = torque if (k, axis) == BEARING[:2] else 0.4
                    friction = {BEARING[2]: {
                        'value': size * (1.0 + 0.03 * rng.standard_normal()), 'std': 0.03 * size,
                        'unit': 'rad/s²', 'vanishes': True}}
                row |= {f'{axis}_verdict': 'effects_added' if friction else 'no_missing_effect',
                        f'{axis}_effects': 'coulomb_friction' if friction else '',
                        f'{axis}_effect_parameters': json.dumps(friction)}
            rows.append(row)
    return Fleet(rows)


def alarms(one):
    return [(d.aircraft, q.axis, q.name) for q, d in one.drifts], list(one.odd)


def test_a_wearing_bearing_and_a_weakening_motor_are_named_and_dated(refusal):
    found = fleet(1)
    drifts, odd = alarms(found)
    assert sorted(drifts) == sorted((f'craft_{k:02d}', axis, name)
                                    for k, axis, name in (BEARING, MOTOR))
    assert odd == []
    by_name = {q.name: d for q, d in found.drifts}
    bearing, motor = by_name[BEARING[2]], by_name['gain']
    assert bearing.between[0] - FIRST <= BEGIN + 20.0  # the time between flights
    assert bearing.between[1] - FIRST >= BEGIN - 20.0
    assert bearing.after > 1.3 * bearing.before
    assert motor.between[0] - FIRST < 45.0
    assert motor.after == pytest.approx(0.72 * motor.before, rel=0.12)
    page, text = found.page(), str(found)
    for said in ('craft_07, roll: coulomb_friction.torque has grown', 'craft_11, pitch: gain has',
                 '30 aircraft'):
        assert said in page
        assert said in ' '.join(text.split())
    assert max(map(len, text.splitlines())) <= 80
    # within the last months the motor is seen still, and other groups have other means
    assert len(found.only(since='2026-09-01').flights) < 0.6 * 300
    (one,) = {len(q.statistics.mean.levels) for q in found.only(group_by='none').quantities}
    assert one == 1
    assert 'group_by' in refusal(found.only, group_by='month')


def test_a_step_is_dated_by_the_last_flight_before_it():
    days = np.arange(10.0)
    values = np.where(days > 4.0, 1.5, 1.0) + 0.01 * np.random.default_rng(1).standard_normal(10)
    ((drift,),) = (one.drifts for one in over_fleet(
        [[Series('craft', tuple('abcdefghij'), days, values, np.full(10, 0.02))]]))
    assert (drift.kind, drift.since, drift.claimed) == ('step', 4.0, True)
    assert (drift.before, drift.after) == pytest.approx((1.0, 1.5), abs=0.03)


@pytest.mark.parametrize('seed', range(4))
def test_its_twin_with_nothing_wrong_has_no_alarm(seed):
    assert alarms(fleet(seed, wear=False)) == ([], [])


def test_an_odd_flight_is_named_with_its_reason_and_is_no_drift():
    found = fleet(2, wear=False, odd=True)
    assert alarms(found) == ([], ['craft_03/4'])
    assert 'craft_03/4: pitch lag 0.0' in str(found)
    (reason,) = found.odd['craft_03/4']
    assert reason[1].value == pytest.approx(1.6 * reason[1].expected, rel=0.15)


def test_few_flights_and_equal_ones_are_no_alarm():
    copies = fleet(3, wear=False, aircraft=3, flights=6)
    rows = [row | {key: copies.rows[0][key] for key in row if key.startswith(('roll', 'pitch'))}
            for row in copies.rows]
    assert alarms(Fleet(rows)) == ([], [])
    twice = Fleet([row | {'bag': row['bag'] + end} for row in rows for end in ('', '_copy')])
    assert [q.statistics for q in twice.quantities] == [
        q.statistics for q in Fleet(rows).quantities]
    assert 'copies: craft_00/0_copy of craft_00/0, craft' in ' '.join(str(twice).split())
    assert 'Nothing is said of drift' in ' '.join(repr(Fleet(rows[:3])).split())


@pytest.mark.parametrize('flights', [2, 3, 8])
def test_few_flights_of_one_aircraft_say_how_far_they_scatter(flights):
    """Five times what each estimate's own error says."""
    rng, covered = np.random.default_rng(6), 0
    for _ in range(200):
        values = 1.0 + 0.5 * rng.standard_normal(flights) + 0.1 * rng.standard_normal(flights)
        (found,) = over_fleet([[Series('a', tuple(map(str, range(flights))),
                                       np.arange(float(flights)), values,
                                       np.full(flights, 0.1))]])
        covered += found.mean.low <= 1.0 <= found.mean.high
    assert covered >= 180


def test_the_mean_over_aircraft_covers_the_truth_and_tells_the_scatter():
    rng, covered, between = np.random.default_rng(5), 0, []
    for _ in range(200):
        series = [Series(str(k), ('a', 'b', 'c'), np.arange(3.0),
                         1.0 + 0.3 * rng.standard_normal() + 0.2 * rng.standard_normal(3),
                         np.full(3, 0.2)) for k in range(12)]
        mean = _mean(series, [0.0] * 12, set())
        covered += mean.low <= 1.0 <= mean.high
        between.append(mean.between)
    assert 180 <= covered <= 198  # 95 % of 200, three standard errors to either side
    assert np.mean(between) == pytest.approx(0.3, abs=0.03)
