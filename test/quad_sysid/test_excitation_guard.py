"""The guard and the player: every reason to end, how it ends, and that nothing else ends it.

A standstill of the node itself is left out of the age of what it heard, a silent link never is.
"""

import math
from dataclasses import replace

import pytest

from quad_sysid.signals.guard import MOST_STALLED_S, Limits, Readings, Stall, check
from quad_sysid.signals.player import Player, State
from quad_sysid.signals.schedule import parse_schedule

RIG = Limits(battery_min_v=10.2, abort_switch=True)
UNGUARDED = replace(RIG, battery_min_v=0.0, abort_switch=False)
HOVER = replace(RIG, mount='hover')
GOOD = Readings(
    imu_age_s=0.004, angles=(0.1, -0.1, 3.0), rc_age_s=0.02, sticks=(0.0, 0.05, 0.0),
    abort_switch=-1.0, failsafe=False, battery_v=11.5, battery_age_s=0.1,
)
DT = 0.004

REASONS = [
    ({'failsafe': True}, 'failsafe', True), ({'rc_age_s': 1.5}, '/rc/in is 1.50 s old', True),
    ({'abort_switch': 0.9}, 'abort switch', False),
    ({'imu_age_s': None}, 'no /imu/data yet', False),
    ({'imu_age_s': 0.25}, '/imu/data is 0.25 s old', False),
    ({'angles': None}, 'no orientation', False),
    ({'angles': (math.nan, 0.0, 0.0)}, 'no orientation', False),
    ({'angles': (math.radians(26.0), 0.0, 0.0)}, 'roll of 26.0° is beyond 25°', False),
    ({'angles': (0.0, math.radians(-25.5), 0.0)}, 'pitch of -25.5°', False),
    ({'sticks': (0.0, 0.2, 0.0)}, 'the pitch stick is at 20 %', False),
    ({'sticks': (0.0, 0.0, -0.15)}, 'the yaw stick', False),
    ({'sticks': (math.nan, 0.0, 0.0)}, 'the roll stick', False),
    ({'battery_v': 10.1}, 'battery at 10.10 V', False),
    ({'refused': 'excitation_refused'}, 'the STM32 refuses the excitation: it is disarmed', True),
    ({'refused': 'rc_kill excitation_refused'}, "the pilot's kill switch is on", True),
    ({'refused': 'armed angle_limit excitation_refused'}, 'it is beyond its angle', True),
    ({'refused': 'armed excitation_refused', 'battery_v': 8.73}, 'low battery (8.73 V)', True)]
UNHEARD = [
    ({'rc_age_s': None, 'abort_switch': None}, 'no /rc/in yet', False),
    ({'abort_switch': None}, 'no channel of the pilot', False),
    ({'abort_switch': math.nan}, 'no channel of the pilot', False),
    ({'battery_v': None, 'battery_age_s': None}, 'no voltage on /battery yet', False),
    ({'battery_age_s': 2.1}, 'the last voltage on /battery is 2.1 s old', False),
]
FINE = [
    {}, {'battery_age_s': 1.9}, {'angles': (math.radians(24.9), 0.0, 3.1)}, {'imu_age_s': 0.19},
]


def schedule(axis: str = 'roll'):
    square = {'signal': 'square', 'period_s': 1.0, 'axis': axis, 'amplitude_deg': 10.0,
              'ramp_s': 0.2}
    idle = {'segment': 'idle', 'duration_s': 0.5}
    return parse_schedule({'schedule': {'segments': [
        idle, {'segment': 'train', 'duration_s': 2.0, **square},
        idle, {'segment': 'validation', 'duration_s': 1.0, **square}, idle,
    ]}}, 'test')


def play(player: Player, readings, seconds: float, start: float = 100.0):
    """Ticks at 250 Hz; `readings` is a function of the elapsed time."""
    ticks = []
    for k in range(round(seconds / DT)):
        if not player.active:
            break
        ticks.append((k * DT, player.tick(start + k * DT, readings(k * DT))))
    return ticks


def told(ticks):
    """When which segment and signal were announced, to 0.1 s."""
    said = [(round(t, 1), tick.announcement) for t, tick in ticks if tick.announcement]
    return [(t, one['segment'], one['signal']) for t, one in said]


@pytest.mark.parametrize(('limits', 'change'), [
    *((limits, change) for limits in (RIG, HOVER) for change in FINE),
    *((UNGUARDED, change) for change, *_ in UNHEARD),
    (UNGUARDED, {'battery_v': -0.1, 'abort_switch': 1.0}),
])
def test_nothing_else_ends_it(limits, change):
    assert check(limits, replace(GOOD, **change), 'roll') is None


def test_in_hover_the_sticks_may_move_and_a_large_deflection_ends_it():
    assert check(HOVER, replace(GOOD, sticks=(0.55, -0.55, 0.3)), 'roll') is None
    abort = check(HOVER, replace(GOOD, sticks=(0.0, -0.65, 0.0)), 'roll')
    assert 'pitch stick is at -65 %' in abort.reason


def test_yaw_counts_from_its_start_and_only_while_excited():
    turned = replace(GOOD, angles=(0.0, 0.0, -3.0))
    assert check(RIG, turned, 'roll') is None
    assert check(RIG, turned, 'yaw', yaw_start=3.1) is None
    assert check(RIG, turned, 'yaw', yaw_start=0.0) is not None


def test_a_schedule_is_played_to_its_end():
    player = Player(schedule(), RIG)
    assert player.start(100.0, GOOD) == ''
    assert player.start(100.0, GOOD) == 'the schedule is already running'
    ticks = play(player, lambda _: GOOD, 10.0)
    assert player.state is State.DONE
    assert ticks[-1][0] == pytest.approx(4.5, abs=0.005)
    assert told(ticks) == [
        (0.0, 'idle', 'none'), (0.5, 'train', 'square'), (2.5, 'idle', 'none'),
        (3.0, 'validation', 'square'), (4.0, 'idle', 'none'), (4.5, 'idle', 'none'),
    ]
    sent = [tick.setpoint for _, tick in ticks if tick.setpoint is not None]
    assert len(sent) == 750
    assert max(abs(s[0]) for s in sent) == pytest.approx(math.radians(10.0))
    assert all(s[1] == s[2] == 0.0 for s in sent)
    assert player.start(200.0, GOOD) == ''


@pytest.mark.parametrize(('change', 'words', 'immediate'), REASONS + UNHEARD)
def test_a_reason_keeps_from_starting_and_ramps_out_or_ends_at_once(change, words, immediate):
    player = Player(schedule(), RIG, ramp_out_s=0.4)
    if 'refused' not in change:  # what the STM32 refused before counts no more
        assert words in player.start(0.0, replace(GOOD, **change))
        assert (player.state, player.tick(1.0, GOOD).setpoint) == (State.READY, None)
    assert player.start(100.0, GOOD) == ''
    ticks = play(player, lambda t: GOOD if t < 1.2 else replace(GOOD, **change), 10.0)
    assert player.state is State.ABORTED
    assert words in player.reason
    after = [abs(tick.setpoint[0]) for t, tick in ticks if t >= 1.2 and tick.setpoint]
    said = ticks[-1][1].announcement
    assert (after[-1], said['segment'], said['signal']) == (0.0, 'idle', 'none')
    assert words in str(said['reason'])
    if immediate:
        assert after == [0.0]
    else:
        assert len(after) == pytest.approx(101, abs=2)
        assert after == sorted(after, reverse=True)
        assert after[0] == pytest.approx(math.radians(10.0))


def test_failsafe_cuts_a_ramp_short():
    player = Player(schedule(), RIG, ramp_out_s=1.0)
    player.start(100.0, GOOD)

    def readings(t: float) -> Readings:
        return replace(GOOD, abort_switch=1.0 if t > 1.0 else -1.0, failsafe=t > 1.2)

    ticks = play(player, readings, 5.0)
    assert ticks[-1][0] == pytest.approx(1.204, abs=0.005)
    assert 'failsafe' in player.reason


def test_a_clock_set_back_does_not_enlarge_what_fades_out():
    player = Player(schedule(), RIG, ramp_out_s=0.5)
    player.start(100.0, GOOD)
    play(player, lambda _: GOOD, 1.2)
    player.stop(101.2, 'enough')
    tick = player.tick(100.4, GOOD)
    assert tick.setpoint == (0.0, 0.0, 0.0)
    assert player.state is State.ABORTED


def test_a_clock_set_back_before_the_start_completes_nothing():
    player = Player(schedule(), RIG)
    player.start(100.0, GOOD)
    play(player, lambda _: GOOD, 1.0, start=100.0)
    play(player, lambda _: GOOD, 1.0, start=50.0)
    assert player.state is State.ABORTED


def test_stop_and_cut():
    player = Player(schedule(), RIG, ramp_out_s=0.2)
    player.start(100.0, GOOD)
    play(player, lambda _: GOOD, 1.0)
    player.stop(101.0, 'stopped')
    ticks = play(player, lambda _: GOOD, 1.0, start=101.0)
    assert player.state is State.ABORTED
    assert len(ticks) <= 52
    player.start(200.0, GOOD)
    play(player, lambda _: GOOD, 1.0, start=200.0)
    last = player.cut('the node ends')
    assert last.setpoint == (0.0, 0.0, 0.0)
    assert last.announcement['segment'] == 'idle'
    assert player.cut('again').announcement is None


def ages(*gaps: float, period_s: float = DT) -> list[float]:
    """At each tick, so long after the one before, the age of what was heard at the first."""
    stall, time, found = Stall(period_s), 0.0, []
    heard = stall.awake_s(time)
    for gap in (0.0, *gaps):
        time += gap
        stall.tick(time)
        found.append(stall.awake_s(time) - heard)
    return found


@pytest.mark.parametrize(
    ('gaps', 'last'),
    [
        (999 * [DT], 999 * DT),
        # left out until what waited has had time to come
        ((DT, 0.34), DT), ((DT, 0.34, DT, DT), 3 * DT),
        # a second standstill at once is left out too, but no more than a second of both
        ((0.5, DT, 0.4, DT), 2 * DT), ((0.5, DT, 0.4, DT, 0.3), 0.3 + 2 * DT),
        # a long one by nothing, and one that only time awake has earned
        ((1.01 * MOST_STALLED_S,), 1.01 * MOST_STALLED_S),
        ((0.9, *50 * [DT], 0.9), 0.9 + 50 * DT), ((0.9, *250 * [DT], 0.9), 250 * DT),
    ],
)
def test_a_silent_link_grows_old_by_the_clock_but_for_standstills(gaps, last):
    assert ages(*gaps)[-1] == pytest.approx(last, abs=1e-9)


def test_the_ticks_of_a_slow_node_are_no_standstills():
    assert ages(*20 * [0.1], period_s=0.1)[-1] == pytest.approx(2.0)
