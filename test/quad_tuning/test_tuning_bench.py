"""Two of the bench's 100 airframes: identified from their own flight, designed, flown again."""

import sys
from pathlib import Path

import pytest

BENCH = Path(__file__).parents[2] / 'bench'


@pytest.fixture(scope='module')
def bench():
    """The bench's modules; they import each other by name, as when run from their folder."""
    sys.path.insert(0, str(BENCH))
    try:
        import tuning
        import tuning_airframes
    finally:
        sys.path.remove(str(BENCH))
    return {'run': tuning, 'airframes': tuning_airframes}


@pytest.mark.parametrize('number', [2, pytest.param(9, marks=pytest.mark.long)])
def test_an_airframe_is_better_with_the_gains_from_its_own_flight(bench, number):
    """Hover; rig with a dead zone. Promise within 5 points, 0.85 of what the true plant allows."""
    run, airframe = bench['run'], bench['airframes'].draw(100, 1000)[number]
    ours, best = run.tuned(airframe, None, peers=False)
    assert ours.refused_because == ''
    assert not ours.unstable
    assert ours.improvement_pct > 10.0
    assert ours.improvement_pct == pytest.approx(ours.predicted_pct, abs=5.0)
    assert ours.improvement_pct > 0.85 * best.improvement_pct
    assert abs(ours.rise_time_error_pct) < 10.0
    assert ours.phase_margin_deg > 44.0
