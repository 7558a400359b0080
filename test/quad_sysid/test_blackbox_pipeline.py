"""The black-box part of an identification: approaches, both steps, preparation, advice."""

import dataclasses
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest
from flown_axis import model_of
from known_plants import reference_study
from scipy import signal

from quad_sysid.blackbox import detrend, frequency_response, residual_test
from quad_sysid.effects import EFFECTS
from quad_sysid.loop.cascade import CascadeGains
from quad_sysid.loop.plant import plant_like
from quad_sysid.loop.simulation import simulate_cascade
from quad_sysid.model import GainProposal
from quad_sysid.model.data import axis_data
from quad_sysid.pipeline import identify as pipeline
from quad_sysid.pipeline import step_b
from quad_sysid.pipeline.advice import _between_flights, _beyond
from quad_sysid.pipeline.assemble import Support
from quad_sysid.pipeline.blackbox_part import box_jenkins, fit_models, select, window_error
from quad_sysid.pipeline.identify import Options, identify
from quad_sysid.record import GainChange, IOData, Record, Segment
from quad_sysid.report import document, text
from quad_sysid.signals.waveforms import prbs

DT, TRIM, NOISE = 0.004, 0.013, 0.01
SECONDS = 38.0
SPANS = (('train', 'prbs', 0.0, 22.0), ('validation', 'prbs', 23.0, 30.0),
         ('validation', 'square', 31.0, SECONDS))
PLANT = plant_like('roll', np.array([450.0, 0.04, 0.008, 0.4, 0.0]), DT, None)
SLOW = CascadeGains.default('roll')
FAST = dataclasses.replace(SLOW, angle_kp=4.5, rate_kp=1.6 * SLOW.rate_kp)


def references(n: int, seed: int) -> np.ndarray:
    """PRBS, another PRBS, a square wave: 0.2 rad, and nothing between them."""
    time, out = np.arange(n) * DT, np.zeros(n)
    square = 0.2 * np.sign(np.sin(2 * np.pi * 0.4 * time))
    waves = (*(np.resize(prbs(bits, 24, 0.2, seed), n) for bits in (9, 10)), square)
    for (*_, start, end), wave in zip(SPANS, waves, strict=True):
        inside = (start <= time) & (time < end)
        out[inside] = wave[inside]
    return out


def flight(
    seed: int = 0, gains: CascadeGains = SLOW, *, trim: float = TRIM, torque: float = 0.5,
    injection: str = 'attitude', source: str = 'flight',
) -> Record:
    """Roll excited in the cascade; white gyro noise, a white torque and a trim of the command."""
    n = round(SECONDS / DT)
    rng = np.random.default_rng(seed)
    signal = {'attitude': 1.0, 'rate': 2.5, 'control': 0.15}[injection] * references(n, seed + 1)
    behind = {} if injection == 'attitude' else {f'{injection}_excitation': signal}
    reference = 0.0 * signal if behind else signal
    run = simulate_cascade(PLANT, gains, reference, DT, noise=NOISE * rng.standard_normal(n),
                           disturbance=torque * rng.standard_normal(n), **behind)
    rates, angles, wanted, applied = (
        np.outer(x, [1.0, 0.0, 0.0]) for x in (run.rate, run.angle, reference, signal)
    )
    still = np.full((n, 2), trim)
    return Record(
        source=source, dt=DT, rates=rates, angles=angles, attitude_setpoint=wanted,
        control=np.column_stack((np.full(n, 0.5), run.control + trim, still)), excitation=applied,
        segments=tuple(Segment(r, s, 'roll', injection, a, b) for r, s, a, b in SPANS),
        gains=(GainChange(0.0, gains.to_mapping('roll', constants=True)),))


@pytest.fixture(scope='module')
def answers():
    records = [flight(), flight(7, FAST, source='second')]
    return identify(records, Options(axes=('roll',), effects=()))


@pytest.fixture(scope='module')
def roll(answers):
    return answers['roll']


def test_every_structure_stands_in_the_table_and_the_selected_one_finds_the_plant(roll):
    kinds = {row.step_a.model.structure for row in roll.rows}
    assert {'ARX', 'ARMAX', 'OE', 'BJ', 'IV4', 'CLRIV'} <= kinds
    assert {row.step_a.model.approach for row in roll.rows} == {'direct'}
    for row in roll.rows:
        if not row.step_a.model.stable or not row.step_a.model.converged:
            continue
        first, second = row.loop_runs
        assert (first.gains_changed, second.gains_changed) == (False, True)
        assert min(first.fit_pct, second.fit_pct) > 80.0, row.step_a.model.name
        assert 0.0 < first.mae < first.rmse < 0.3
    because = {a.name: a.because for a in roll.selection.approaches if not a.possible}
    assert all('several sets of gains' in because[name] for name in ('indirect', 'joint'))
    assert roll.selection.feedback is True
    row = roll.rows[roll.selected]
    assert row.step_a.passed_first_step
    assert row.passed_second_step
    assert all(fit > 90.0 for fit in row.step_a.fit_validation_pct.values())
    w = np.array([3.0])
    true = 450.0 / abs((3j + 0.4) * (0.04 * 3j + 1.0))
    found = frequency_response(row.step_a.model, w).magnitude[0]
    assert abs(found / true - 1.0) < 0.03


def test_a_structure_that_claims_no_white_residual_is_not_selected_for_passing_alone(roll):
    rows = tuple(
        dataclasses.replace(row, step_a=dataclasses.replace(
            row.step_a, eliminated_because='' if row.step_a.model.structure == 'IV4' else 'it'))
        for row in roll.rows)
    data = roll.findings.data
    errors = [window_error(data, row.step_a.model, data.train) or np.inf for row in rows]
    chosen = select(rows, data)
    assert errors[chosen] == min(errors)
    assert not rows[chosen].step_a.passed_first_step


def test_order_and_delay_are_the_plants_where_the_command_feels_the_rate_of_its_own_cycle():
    """Least squares then takes the controller for an undelayed plant."""
    study = reference_study()
    truth = dataclasses.replace(study.truth, noise_variance=2.5)
    study = dataclasses.replace(study, truth=truth, samples=4000)
    fits = fit_models(study.record(np.random.default_rng(1)))
    assert (fits.nk, fits.order) == (study.truth.nk, 2)
    short = dataclasses.replace(study, samples=240).record(np.random.default_rng(1))
    assert fit_models(short).surest.structure == 'BJ'  # though no residual of it can be tested


def test_box_jenkins_passes_the_first_step_behind_a_gyros_filter_in_any_unit():
    n, rng = 3000, np.random.default_rng(2)
    plant = plant_like('roll', np.array([450.0, 0.04, 0.008, 0.4, 0.0]), DT, 42.0)
    noise = 2.0 * NOISE * signal.lfilter(*signal.butter(2, 42.0, fs=1.0 / DT),
                                         rng.standard_normal(n))
    run = simulate_cascade(plant, SLOW, references(n, 3), DT, noise=noise,
                           disturbance=0.5 * rng.standard_normal(n))
    units = [detrend(IOData(run.control, unit * run.rate, DT)) for unit in (1.0, 57.3)]
    in_rad, in_deg = (box_jenkins([], z, 5) for z in units)
    assert in_rad.name == in_deg.name
    test = residual_test(units[0], in_rad, fitted=True)
    assert test.residual_white
    assert test.residual_uncorrelated_with_input


def test_gains_are_designed_in_the_band_that_the_report_trusts(roll):
    """Where a gain is known to 3 dB, which here is so at half of the coherent frequencies."""
    known = next(row.step_a.model for row in roll.rows if row.step_a.model.structure == 'BJ')
    low, high = Support.of(roll.train, 'roll').band
    response = frequency_response(known, np.geomspace(low, high))
    usual = np.median(response.magnitude_std / response.magnitude)
    vague = dataclasses.replace(known, covariance=(0.41 / 2.576 / usual) ** 2 * known.covariance)
    fits = mock.Mock(surest=vague)
    with mock.patch.multiple(pipeline, findings_of=lambda *_: roll.findings,
                             fit_models=lambda _: fits, _compared=lambda answer, *_: answer):
        answer = pipeline.identify_axis([flight()], 'roll', Options(
            effects=(), designer=lambda model: GainProposal(None, str(model.trusted_band_rad_s)),
        ), lambda _: None)
    band = answer.model.trusted_band_rad_s
    assert answer.proposal.refused_because == str(band)
    assert low <= band[0] < band[1] <= high
    assert band[1] / band[0] < 0.8 * high / low


@pytest.mark.parametrize(('flights', 'label', 'lines'), [
    (2, 'shape:gain:time/smooth', 1), (1, 'shape:gain:time/smooth', 0),
    (2, 'coulomb_friction', 0)])
def test_what_changes_between_flights_may_be_the_aircraft(flights, label, lines):
    effect = next(one for one in EFFECTS if one.label == label)
    chosen = SimpleNamespace(theta=None, structure=SimpleNamespace(
        natural=lambda _: np.ones(len(effect.parameters)),
        effects=[(SimpleNamespace(effect=effect), slice(None))]))
    whole = SimpleNamespace(flights=((0, 9),) * flights), None
    answer = SimpleNamespace(findings=SimpleNamespace(
        verdict=SimpleNamespace(chosen=chosen),
        problem=SimpleNamespace(data=SimpleNamespace(whole=whole))))
    told = list(_between_flights(answer))
    assert len(told) == lines
    assert all('identify each by itself' in line for line in told)


def test_a_sweep_is_trusted_where_it_has_been_and_its_rest_is_named():
    """The cut that ends its training is in command and rate alike, and coherent up to any."""
    t = 0.004 * np.arange(5000)
    u = signal.chirp(t, 0.3, 20.0, 8.0, 'log')  # 2 to 50 rad/s, its training to 14
    y = signal.lfilter([0.02], [1.0, -0.98], u)
    y += 1e-5 * np.random.default_rng(4).standard_normal(y.size)
    train, rest = (IOData(u, y, 0.004, segments=[span]) for span in ((0, 3000), (3000, 5000)))
    low, high = Support.of(train, 'roll').band
    assert low < 5.0
    assert 10.0 < high < 30.0
    (line,) = _beyond(train, rest)
    assert 'choose --train and --validate' in line
    cut = IOData(u, y, 0.004, segments=[(k, k + 500) for k in range(0, 5000, 500)])
    assert not list(_beyond(IOData(u, y, 0.004), cut))  # the same motion in parts


def test_one_loop_is_identified_by_all_three_approaches():
    found = identify([flight()], Options(axes=('roll',), effects=()))['roll']
    assert all(a.possible for a in found.selection.approaches)
    rows = {(r.step_a.model.approach, r.step_a.model.structure): r.step_a for r in found.rows}
    direct = rows['direct', 'BJ'].fit_validation_pct['square']
    for key in (('joint', 'BJ'), ('indirect', 'OE')):
        assert rows[key].fit_validation_pct['square'] > direct - 3.0, key


def test_a_change_of_gains_within_a_flight_is_a_run_of_its_own():
    record = flight()
    changed = FAST.to_mapping('roll', constants=True)
    both = dataclasses.replace(record, gains=(*record.gains, GainChange(30.7, changed)))
    loop = step_b.loop_of([both], 'roll')
    first, second = loop.flights
    assert loop.of_one_set
    assert first.signals == ('prbs',)
    assert second.signals == ('square',)
    assert (first.gains_changed, second.gains_changed) == (False, True)
    assert second.gains.angle_kp == 4.5


def test_the_text_fits_a_terminal_and_every_elimination_has_its_reason(answers):
    tree = document.document(answers, ['flight'])
    roll = tree['axes']['roll']
    roll['warnings'] = ['/imu/data: the clock was set back 1 times ' * 3]
    roll['not_tested'] = [{'name': f'shape:throttle/{i}', 'because': 'still'} for i in range(14)]
    lines = text.lines(tree)
    assert '  - /imu/data: the clock was set back' in '\n'.join(lines)
    assert '  not tested: 14 curves (shape:…): still' in lines
    assert max(map(len, lines)) <= 80
    assert lines[3].startswith('verdict')  # after the axis, and before all else
    assert lines.index('warnings') < next(i for i, line in enumerate(lines) if 'loop, %' in line)
    for model in roll['models']:
        gone = not (model['passed_first_step'] and model['passed_second_step'])
        assert gone == bool(model.get('eliminated_because')), model
    lines = text.lines({**tree, 'axes': {'roll': roll, 'pitch': roll}})  # once for both
    (place,) = [i for i, line in enumerate(lines) if line.startswith('  - /imu/data: the clock')]
    assert lines[place - 1] == 'warnings for several axes'


MODEL = dataclasses.replace(model_of(gyro_filter_hz=None, lag=0.04),
                            active_gains=SLOW.to_mapping('roll', constants=True))


def in_the_loop(*records: Record):
    return step_b.closed_loop(MODEL, step_b.loop_of(records, 'roll'), axis_data(records, 'roll'))


def test_the_true_model_in_the_loop_leaves_the_noise_wherever_the_excitation_acts():
    """The noise, and what of it the loop feeds back: 0.01 to 0.015 rad/s here.

    A flight counts under its own gains, and is left out without them, or where what acts behind
    C1 was not recorded; a lost reference is held.
    """
    calm = {'trim': 0.0, 'torque': 0.0}
    first, second = flight(**calm), flight(2, FAST, **calm)
    reference = first.attitude_setpoint.copy()
    reference[[0, 6500, 6501], 0] = np.nan
    held = dataclasses.replace(first, attitude_setpoint=reference)
    bare = dataclasses.replace(first, gains=())
    behind = [flight(injection=name, **calm) for name in ('rate', 'control')]
    for records in ([first], [first, second, bare], [held], *([one] for one in behind)):
        found = in_the_loop(*records)
        assert NOISE < found.rms_after < 1.6 * NOISE
        assert found.time_s[0] == pytest.approx(23.0)
        assert (np.diff(found.time_s) > 0.0).all()
        assert found.time_s.size == (2 if len(records) > 1 else 1) * 3500
    wrong = dataclasses.replace(second, gains=first.gains)
    assert in_the_loop(first, wrong).rms_after > 2.5 * NOISE
    assert in_the_loop(bare) is None
    assert in_the_loop(dataclasses.replace(behind[1], excitation=None)) is None
