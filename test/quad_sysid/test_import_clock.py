"""Any clock: what the times of a recording can be, and what becomes of rates and commands."""

import numpy as np
import pytest

from quad_sysid.imports.clock import Stream, cycles, every_cycle, fresh, hold, unroll

DT, N = 0.004, 2000
T = DT * np.arange(N)


def motion(t: np.ndarray) -> np.ndarray:
    """A rate within 5 Hz, rad/s."""
    return np.sin(9.0 * t) + 0.3 * np.cos(31.0 * t)


def stream(t: np.ndarray) -> Stream:
    return Stream(t, motion(t)[:, None])


def jittered(share: float) -> np.ndarray:
    return T + DT * share * np.random.default_rng(2).uniform(-0.5, 0.5, N)


@pytest.mark.parametrize(
    ('times', 'hz', 'own', 'error', 'words'),
    [
        (T, 250.0, True, 1e-12, '0 odd intervals; each kept in its own cycle of 250 Hz'),
        (jittered(0.3), 250.0, False, 0.002, 'jitter of 15 % of a cycle'),
        (np.delete(T, [100, 101, 900]), 250.0, True, 1e-12, '2 gaps of 0.012 s in all'),
        (np.sort(np.concatenate([T, T[5::400] + 0.4 * DT])), 250.0, True, 0.01, '10 odd'),
        (np.delete(T, np.random.default_rng(1).choice(N, N // 3, replace=False)), 62.5, False,
         0.03, 'the rate is uneven'),
        (np.delete(T, np.random.default_rng(1).choice(N, N // 20, replace=False)), 250.0, False,
         0.01, 'the rate is uneven'),
        (np.delete(T, np.arange(3, N, 4)), 187.5, False, 0.01, 'the rate is uneven'),
        (np.concatenate([T[:1000], T[1000::5]]), 50.0, False, 0.01, 'the rate is uneven'),
        (T * (1.0 + 1e-4 * np.sin(0.5 * T)), 250.0, True, 1e-12, 'kept'),
    ],
    ids=['even', 'jitter', 'gaps', 'odd intervals', 'dropped', 'dropped here and there',
         'each fourth', 'two rates', 'drift'],
)  # fmt: skip
def test_rates_come_onto_one_grid(times, hz, own, error, words):
    laid = cycles(stream(times), 'a table')
    assert 1.0 / laid.dt == pytest.approx(hz, rel=0.01)
    assert np.median(np.diff(laid.times)) == pytest.approx(laid.dt, rel=1e-3)
    assert laid.own is own
    known = np.isfinite(laid.values[:, 0])
    assert known.mean() > 0.9
    assert np.abs(laid.values[known, 0] - motion(laid.times[known])).max() < error
    assert words in laid.notes[0]
    assert len(laid.notes) == 1


def test_a_gap_is_not_drawn_over_and_a_pause_ends_what_is_held():
    t = np.delete(jittered(0.4), np.arange(500, 600))
    laid = cycles(stream(t), 'a table')
    inside = (laid.times > T[500]) & (laid.times < T[598])
    assert np.isnan(laid.values[inside]).all()
    held = hold(Stream(T[:100], np.ones((100, 1))), T, DT)
    assert np.isfinite(held[:102]).all()
    assert np.isnan(held[104:]).all()


@pytest.mark.parametrize(('rows_each', 'resolution', 'share'), [
    (1.0, 0.0, 1.0), (2.0, 0.0, 0.5), (1.6, 0.0, 0.625), (1.0, 0.05, 1.0), (1.0, 0.3, 1.0)])
def test_what_was_measured_once_is_taken_once(rows_each, resolution, share):
    """What stays the same by its resolution is not what a logger repeated."""
    k = np.arange(4000.0)
    row = np.floor(rows_each * np.floor(k / rows_each)).astype(int)
    values = np.sin(0.02 * k) + 0.05 * np.random.default_rng(1).standard_normal(k.size)
    values = np.round(values / resolution) * resolution if resolution else values
    taken = fresh(Stream(DT * k, values[row, None]))
    assert len(taken.time_s) == pytest.approx(share * k.size, abs=1.0)


def rows(t: np.ndarray) -> np.ndarray:
    return np.column_stack([np.arange(len(t)), np.zeros(len(t))])


def test_a_pause_of_the_commands_is_not_drawn_over():
    stream = every_cycle(Stream(np.array([0.0, 4.0, 8.0, 28.0, 32.0, 36.0]),
                                np.array([[0.0], [1.0], [3.0], [9.0], [9.0], [np.nan]])), 2.0)
    np.testing.assert_allclose(stream.time_s, [0.0, 2.0, 4.0, 6.0, 8.0, 28.0, 30.0, 32.0, 36.0])
    np.testing.assert_allclose(stream.values[:, 0],
                               [0.0, 0.5, 1.0, 2.0, 3.0, 9.0, 9.0, 9.0, np.nan])


def test_restarts_and_jumps_are_experiments_one_after_the_other():
    times = np.concatenate([T, T[:700] + 0.5, T[:700] + 3600.0])
    found = unroll(times, rows(times).T, 'file')
    assert (np.diff(found.time_s) > 0.0).all()
    assert np.flatnonzero(np.diff(found.time_s) > 1.0).tolist() == [N - 1, N + 699]
    assert found.time_s[-1] < 20.0
    assert '2 jumps of the clock: 3 experiments, placed 2 s apart' in found.notes
    times = np.concatenate([T[:700], T[:700] + 3600.0, T[:700] + 3599.0])
    assert '2 jumps' in ' '.join(unroll(times, rows(times).T, 'file').notes)


@pytest.mark.parametrize(
    ('times', 'left', 'words'),
    [
        (np.insert(T, 700, 1e6), N, '1 rows with a time far off'),
        (np.insert(T, 700, np.nan), N, '1 rows without a time'),
        (np.concatenate([T[:50], T[52:54], T[50:52], T[54:]]), N, '1 rows ran back'),
        (np.repeat(T, 2)[:3000], 3000, 'ticks more slowly than the rows come (50 % repeat'),
    ],
)
def test_stray_shuffled_and_ticking_times(times, left, words):
    found = unroll(times, rows(times).T, 'file')
    assert len(found.rows) == left
    assert (np.diff(found.time_s) > 0.0).all()
    assert words in '; '.join(found.notes)


@pytest.mark.parametrize('times', [np.zeros(50), -T, np.full(50, np.nan)])
def test_what_cannot_be_mended_is_refused(refusal, times):
    assert 'file' in refusal(unroll, times, rows(times).T, 'file')
