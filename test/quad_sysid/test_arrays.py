"""Arrays of one's own: that every form of them is the same, what they give, what is refused."""

import copy
import json
import math
import pickle
import re
from pathlib import Path

import control
import numpy as np
import pytest
from autopilot_logs import text_table
from flown_axis import SHORT, Axis, fly

import quad_sysid as qs
from quad_sysid.arrays import records_of
from quad_sysid.bags import read_bag, split_segments
from quad_sysid.cli import main
from quad_sysid.comparison import trims
from quad_sysid.loop.cascade import SWITCHED_OFF, CascadeGains
from quad_sysid.pipeline.usable import together
from quad_sysid.result import _flown
from quad_sysid.units import COMMAND, Units, scale

PAGE = Path(__file__).resolve().parents[2] / 'docs/python.md'
DT, N = 0.004, 2000
RNG = np.random.default_rng(3)
U = np.round(np.repeat(RNG.choice([-100, 100], 50), 40) / 1024.0, 6)
Y = np.round(np.cumsum(U) * 0.1 * 1024.0) / 1024.0


def record(**changes):
    return qs.from_arrays(**({'u': U, 'y': Y, 'dt': DT} | changes))


def same(one, other):
    """Whether two records hold the same to the last digit, so that every answer is the same."""
    for name in ('rates', 'control', 'angles', 'dt', 'segments', 'attitude_setpoint', 'battery_v'):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


@pytest.mark.parametrize('changes', [
    {'y': np.asfortranarray(Y[:, None])}, {'y': Y.astype(np.float32)}, {'y': list(Y)},
    {'u': np.round(U * 1024).astype(int), 'units': {'u': 1.0 / 1024.0}},
    {'y': np.ma.masked_array(Y, np.zeros(N, bool))}, {'y': Y.astype(object)},
    {'u': np.repeat(U, 2)[::2]}, {'dt': None, 't': DT * np.arange(N)},
    {'dt': None, 't': np.datetime64('2026-01-01') + (4_000_000 * np.arange(N)).astype('m8[ns]')},
    {'dt': 4.0, 'units': {'t': 'ms'}}, {'y': 180.0 / math.pi * Y, 'units': {'y': 'deg/s'}},
], ids=['Fortran', 'float32', 'list', 'integers', 'masked', 'objects', 'view', 'times', 'dates',
        'ms', 'degrees'])
def test_every_form_of_one_experiment_is_the_same_record(changes):
    U.flags.writeable = Y.flags.writeable = False
    wanted = record()
    np.testing.assert_array_equal(wanted.rates[:, 0], Y)
    np.testing.assert_array_equal(wanted.control[:, 1], U)
    if 'y' in (changes.get('units') or {}):
        np.testing.assert_allclose(record(**changes).rates, wanted.rates, rtol=1e-12)
    elif 'u' in (changes.get('units') or {}):
        np.testing.assert_allclose(record(**changes).control[:, 1], U, atol=1e-3)
    else:
        same(record(**changes), wanted)
    with pytest.raises(ValueError, match='read-only'):
        wanted.rates[0, 0] = 1.0


def test_missing_samples_are_nan_or_masked():
    gap = slice(500, 520)
    y = Y.copy()
    y[gap] = np.nan
    wanted = record(y=y)
    assert np.isnan(wanted.rates[gap, 0]).all()
    masked = np.ma.masked_array(Y, np.zeros(N, bool))
    masked[gap] = np.ma.masked
    same(record(y=masked), wanted)
    same(record(y=[None if math.isnan(value) else value for value in y]), wanted)


def test_samples_missing_here_and_there_leave_the_interval_as_it_is():
    lost = np.random.default_rng(0).random(N) < 0.1
    lost[0] = False
    seen = record(y=np.where(lost, np.nan, Y))
    assert seen.dt == DT
    np.testing.assert_array_equal(seen.rates[:, 0], np.where(lost, np.nan, Y)[:seen.n])
    seen = record(u=np.where(np.arange(N) % 500 == 250, np.nan, U))
    assert any('u is missing in 4 of 2000 samples' in line for line in seen.warnings)
    late = np.where(np.arange(N) < 250, np.nan, 0.1 * Y)  # measured from 1 s on
    seen = record(signals={'pitch_rate': late}, train=slice(500, 1250))
    assert [(s.start_s, s.end_s) for s in seen.segments if s.role == 'train'] == [
        (pytest.approx(1.0), pytest.approx(4.0))]


def test_mappings_responses_and_iodata_are_the_same_record():
    wanted, t = record(), DT * np.arange(N)
    columns = {'volts': U, 'speed': Y, 't': t}
    same(qs.from_arrays(columns, u='volts', y='speed', t='t'), wanted)
    response = control.forced_response(control.ss(0.9, 0.1, 1.0, 0.0, DT), t, U)
    same(qs.from_arrays(response), record(y=response.outputs))
    same(qs.from_arrays(qs.IOData(U, Y, DT)), wanted)
    same(qs.from_arrays((U, Y), dt=DT), wanted)
    same(qs.from_arrays(u=U, y=Y, dt=DT, units={'y': 'mm'}),
         qs.from_arrays(u=U, angle=Y, dt=DT, units={'angle': 'mm'}))


@pytest.mark.others
@pytest.mark.parametrize('library', ['pandas', 'polars', 'xarray'])
def test_what_other_libraries_hold_is_the_same_record(library):
    other, wanted, t = pytest.importorskip(library), record(), DT * np.arange(N)
    y = Y.copy()
    y[500:520] = np.nan
    lost = record(y=y)
    if library == 'pandas':
        frame = other.DataFrame({'volts': U, 'speed': Y, 't': t})
        same(qs.from_arrays(frame, u='volts', y='speed', t='t'), wanted)
        dated = frame.set_index(other.Timestamp('2026-01-01') + other.to_timedelta(t, unit='s'))
        same(qs.from_arrays(dated, u='volts', y='speed'), wanted)
        same(qs.from_arrays(u=dated['volts'], y=dated['speed']), wanted)
        frame['speed'] = other.array(Y, dtype='Float64')
        frame.loc[500:519, 'speed'] = other.NA
        same(qs.from_arrays(frame, u='volts', y='speed', t='t'), lost)
    elif library == 'polars':
        frame = other.DataFrame({'volts': U, 'speed': Y, 't': t})
        same(qs.from_arrays(frame, u='volts', y='speed', t='t'), wanted)
        gone = other.Series([None if np.isnan(value) else value for value in y])
        same(qs.from_arrays(frame.with_columns(speed=gone), u='volts', y='speed', t='t'), lost)
    else:
        data = other.Dataset({'volts': ('time', U), 'speed': ('time', y)}, {'time': t})
        same(qs.from_arrays(data, u='volts', y='speed', t='time'), lost)
        same(qs.from_arrays(u=data['volts'], y=data['speed']), lost)


@pytest.mark.parametrize(('option', 'column', 'unit', 'name'), [
    ('--angle', 'position', 'mm', 'angle'), ('--rate', 'speed', 'm/s', 'y')])
def test_a_bag_of_the_same_numbers_gives_the_same_record(
    tmp_path, printed, option, column, unit, name
):
    """A position with its reference in mm, so that units and derivative are in it, and a rate."""
    t, bag = DT * np.arange(N), tmp_path / 'bag'
    columns = {'t': t, 'volts': 10.0 * U, 'position': 100.0 * np.sin(3.0 * t), 'speed': Y}
    table = text_table(tmp_path / 'slide.csv', columns)
    gains = {'roll.rate.kp': 0.05, 'roll.angle.kp': 5.0, 'roll.rate.d_on': 'error'}
    printed(main, 'import', table, '--axis', 'roll', '--time', 't', '--control', 'volts', option,
            column, '--unit', 'volts=V', '--unit', f'{column}={unit}', '--out', bag,
            *(f'--gain={name}={value}' for name, value in gains.items()))
    mine = qs.from_arrays(u=columns['volts'], dt=DT, units={'u': 'V', name: unit}, gains=gains,
                          **{name: columns[column]})
    stored = split_segments(read_bag(bag), axes=('roll',))
    assert mine.gains_at(0.0).items() <= stored.gains_at(0.0).items()
    assert CascadeGains.from_mapping(mine.gains_at(0.0), 'roll') == CascadeGains(
        5.0, 0.05, 0.0, 0.0, d_on_error=True, **SWITCHED_OFF)  # what is not stated is not there
    np.testing.assert_array_equal(mine.rates, stored.rates)
    np.testing.assert_array_equal(mine.control, stored.control)
    assert mine.dt == stored.dt
    assert [(s.role, s.start_s, s.end_s) for s in mine.segments] == \
        [(s.role, s.start_s, s.end_s) for s in stored.segments]


@pytest.mark.parametrize(('changes', 'train', 'validation'), [
    ({'train': 0.6}, (0.0, 4.8), (4.8, 8.0)),
    ({'validate': 0.25}, (0.0, 6.0), (6.0, 8.0)),
    ({'train': slice(0, 1200), 'validate': slice(1500, None)}, (0.0, 4.8), (6.0, 8.0)),
    ({'train': np.arange(N) < 1000}, (0.0, 4.0), (4.0, 8.0)),
    ({'train': (1.0, 4.0), 'validate': (5.0, 8.0)}, (1.0, 4.0), (5.0, 8.0)),
], ids=['fraction', 'last', 'slices', 'mask', 'seconds'])
def test_training_and_validation_are_what_was_asked_for(changes, train, validation):
    spans = {s.role: (s.start_s, s.end_s) for s in record(**changes).segments}
    assert spans['train'] == pytest.approx(train)
    assert spans['validation'] == pytest.approx(validation)


def test_a_narrow_oscillation_of_few_samples_is_warned_of():
    for samples, warned in ((9, True), (60, False)):
        y = np.sin(2.0 * np.pi * np.arange(N) / samples) + 0.1 * RNG.standard_normal(N)
        assert ('9 samples per oscillation' in ' '.join(record(y=y).warnings)) == warned
    assert 'oscillation' not in ' '.join(record(y=RNG.standard_normal(N)).warnings)


def test_several_experiments_are_lists_and_share_the_scale_of_the_input():
    one, other = records_of(u=[30.0 * U, 3.0 * U], y=[Y, Y[::-1]], dt=DT, units={'u': 'A'},
                            train=[True, False], validate=[False, True])
    assert {s.role for s in one.segments} == {'train'}
    assert {s.role for s in other.segments} == {'validation'}
    both = _flown([one, other], ('roll',), [0.6, (1.0, 4.0)], [0.4, (5.0, 8.0)], print)
    assert [(s.start_s, s.end_s) for flight in both for s in flight.segments
            if s.role == 'train'] == [(0.0, pytest.approx(4.8)), (1.0, 4.0)]
    scale = one.units.per_command
    assert scale == other.units.per_command == 2.0 ** round(math.log2(scale))
    np.testing.assert_array_equal(other.control[:, 1], scale * 3.0 * U)
    assert 0.25 < np.abs(one.control[:, 1]).max() <= 0.5


def test_parameters_are_shown_in_the_units_of_the_arrays():
    units = record(y=Y, units={'u': 'V', 'y': 'deg/s'}).units
    degree = math.pi / 180.0
    for unit, (name, factor) in {
        'rad/s² per unit command': ('deg/s² per V', 1.0 / 20.0 / degree),
        'rad/s² per (rad/s)²': ('deg/s² per (deg/s)²', degree), 's': ('s', 1.0),
        'rad/s² per rad': ('deg/s² per deg', 1.0), 'normalised command': ('V', 20.0),
        'rad/s² per rad³': ('deg/s² per deg³', degree**2), '1/rad': ('1/deg', degree),
        'rad/s²/(rad/s)': ('deg/s²/(deg/s)', 1.0),
    }.items():
        assert units.parameter(unit) == (name, pytest.approx(factor)), unit


BAD = {
    'u must be': ({'u': U[:-1]}, 'y must be as long as u: found 2000 and 1999'),
    'two channels': ({'y': np.stack([Y, Y], axis=1)}, 'y must be (n,), one channel: found shape'),
    'constant u': ({'u': 0.0 * U}, 'u never changes: found 0 throughout'),
    'negative dt': ({'dt': -0.1}, 'dt must be a positive number of seconds: found -0.1'),
    'dt is text': ({'dt': '4 ms'}, "dt must be a positive number of seconds: found '4 ms'"),
    'no dt': ({'dt': None}, 'lack dt or t'),
    'dt and t': ({'t': DT * np.arange(N)}, 'take dt or t, not both'),
    'slow': ({'dt': 1.0}, 'dt has intervals that are too long: found 1 s; at most 0.05 s, since'),
    'empty': ({'u': [], 'y': []}, 'need 100 samples at least: found 0'),
    'texts': ({'y': ['a'] * N}, 'y must hold real numbers'),
    'objects': ({'y': [object()] * N}, 'y must hold real numbers: found objects'),
    'complex': ({'y': Y + 1j}, 'y must hold real numbers: found complex128'),
    'infinity': ({'y': np.where(np.arange(N) == 7, np.inf, Y)}, 'y holds infinity: found sample'),
    'only NaN': ({'u': np.full(N, np.nan)}, 'u holds no number: found NaN throughout'),
    'time runs back': ({'dt': None, 't': DT * np.abs(np.arange(N) - 9.0)}, 't must increase'),
    't is dt': ({'dt': None, 't': DT}, 't must be (n,) times: found 0.004; the interval is dt=…'),
    'short t': ({'dt': None, 't': DT * np.arange(N - 1)}, 't must be as long as u'),
    't holds NaN': ({'dt': None, 't': np.full(N, np.nan)}, 't holds NaN: found sample 0'),
    'unknown unit': ({'units': {'u': 'furlong'}}, "units: u is no known unit: found 'furlong'"),
    'other unit': ({'units': {'y': 'V'}}, "units: y is not a unit of it: found 'V'; use rad/s"),
    'unit of none': ({'units': {'z': 'V'}}, "units names what is no argument: found 'z'"),
    'no output': ({'y': None}, 'lack y or angle'), 'no input': ({'u': None}, 'lack u, the input'),
    'strange signal': ({'signals': {'wind': Y}}, "signals holds an unknown one: found 'wind'"),
    'short signal': ({'signals': {'battery': Y[:9]}}, 'signals: battery must be as long as u'),
    'short mask': ({'train': np.ones(9, bool)}, 'train must be a mask as long as u: found (9,)'),
    'fraction': ({'train': 1.5}, 'train as a fraction must be between 0 and 1: found 1.5'),
    'no dict of gains': ({'gains': [0.1]}, 'gains must be a dict of name and number: found list'),
    'gain of another axis': ({'gains': {'yaw.rate.kp': 1}}, 'gains: yaw.rate.kp is no gain of'),
    'gain is NaN': ({'gains': {'roll.rate.kp': np.nan}}, 'gains: roll.rate.kp must be a number'),
    'no name of a gain': ({'gains': {3: 1}}, 'gains: 3 is no gain of roll: found 1; there are'),
    'd_on between both': ({'gains': {'roll.rate.d_on': 0.5}}, 'must be measurement or error'),
    'd_on is a list': ({'gains': {'roll.rate.d_on': ['error']}}, 'must be measurement or error'),
    'gyro filter': ({'gains': {'sensor.gyro_filter_hz': -40}}, 'gyro_filter_hz must not be neg'),
    'angle.kp alone': ({'gains': {'roll.angle.kp': 5}}, 'gains: roll.rate.kp is missing'),
    'rate.kp alone': ({'gains': {'roll.rate.kp': 5}}, 'roll.angle.kp is missing; state it too; 0'),
    'negative limit': ({'gains': {'roll.rate.kp': 1, 'roll.angle.kp': 5, 'roll.rate.output_limit':
                                  -1}}, 'rate.output_limit: must be positive: found -1'),
    'overlap': ({'train': 0.7, 'validate': 0.7}, 'train and validate overlap: found 800 samples'),
    'no part': ({'train': slice(10, 10)}, 'train holds no sample'),
    'no column': ({'u': 'volts'}, "u names a column of no frame: found 'volts'"),
    'no axis': ({'axis': 'bank'}, "axis must be one of roll, pitch, yaw: found 'bank'"),
    'lists': ({'u': [U, U], 'y': [Y, Y, Y]}, 'needs lists of as many experiments: found u has 2'),
    'one dt': ({'u': [U, U], 'y': [Y, Y], 'dt': [DT]}, 'u has 2, y has 2, dt has 1'),
    'unit of a signal': ({'signals': {'throttle': U}, 'units': {'throttle': 'furlong'}},
                         "units: throttle is no known unit: found 'furlong'; use 1, percent")}


@pytest.mark.parametrize('name', BAD)
def test_bad_arrays_are_refused_in_one_line(refusal, name):
    changes, words = BAD[name]
    assert words in refusal(record, **changes)


@pytest.mark.parametrize(('call', 'words'), [
    (lambda: qs.identify([]), 'has no flight'),
    (qs.identify, 'has no flight'),
    (lambda: qs.identify(U, Y, dt=DT), 'axes must be names: found ndarray; hand in arrays by'),
    (lambda: qs.identify(object()), 'are of a kind that cannot be read: found object'),
    (lambda: qs.identify('bag', u=U, y=Y, dt=DT),
     'flights or arrays, not both, and arrays of one axis: found bag; a flight holds its'),
    (lambda: qs.identify(u=U, y=Y, dt=DT, seconds=-1.0), 'seconds must be'),
    (lambda: qs.identify(u=U, y=Y, dt=DT, progress=3), 'progress must be'),
    (lambda: qs.from_arrays(np.zeros(9, [('t', float), ('v', float)]), u='i', y='v', dt=DT),
     "u names a column that is not there: found 'i'; there are t, v"),
    (lambda: qs.Record('mine', -1.0, np.zeros((9, 3)), np.zeros((9, 4))), 'Record: dt must be'),
    (lambda: qs.Record('mine', 0.1, np.zeros((9, 2)), np.zeros((9, 4))),
     'Record: rates must be (n, 3)'),
    (lambda: qs.Record('mine', 0.1, np.zeros((9, 3)), np.zeros((8, 4))),
     'control must be (n, 4) with n as in rates: found (8, 4) for n = 9'),
], ids=range(11))
def test_what_cannot_be_identified_is_said_in_one_line(refusal, call, words):
    assert words in refusal(call)


def in_volts_and_rpm(flight):
    """The arrays of a flight, 20 V for full command and its rate in turns a minute."""
    return {'u': 20.0 * flight.control[:, 1], 'y': 30.0 / math.pi * flight.rates[:, 0], 'dt': DT,
            'units': {'u': 'V', 'y': 'rpm'}}


@pytest.fixture(scope='module')
def result(quickly):
    """Dry friction, in turns a minute over volts, with the laws that it is told from."""
    flight = fly(Axis(torque=lambda _t, rate, _a: -6.0 * math.tanh(rate / 0.005)), 5, SHORT)
    lines = []
    with quickly():
        found = qs.identify(
            **in_volts_and_rpm(flight), effects=qs.EFFECTS[:2], progress=lines.append)
    assert any('structures, best so far' in line for line in lines)
    return found, flight


def test_the_model_speaks_the_units_of_its_arrays(result):
    found, flight = result
    assert found.verdict == 'effects_added'
    parameters = found.model.parameters
    turn = 2.0 * math.pi
    assert parameters['gain'].unit == 'rev/s² per V'
    assert parameters['gain'].value == pytest.approx(450.0 / 20.0 / turn, rel=0.02)
    assert parameters['coulomb_friction.torque'].value == pytest.approx(6.0 / turn, rel=0.05)
    error, given = found.errors, in_volts_and_rpm(flight)
    again = qs.evaluate(found.model, qs.from_arrays(**given))
    assert error['unit'] == again.unit == 'rpm'
    assert [rung[0] for rung in again.rungs if rung[-1]] == [('coulomb_friction',)]
    # 0.005 rad/s of the gyro, and what gusts do in a step
    assert again.one_step_after == pytest.approx(30.0 / math.pi * 0.006, rel=0.1)
    assert error['after'] == pytest.approx(
        30.0 / math.pi * found.answer.findings.verdict.after)
    assert re.search(r'gain +\S+ ± \S+ +\S+ ± \S+ +rev/s² per V', str(found))
    z = qs.IOData(given['u'], given['y'], DT)
    assert found.model.compare(z, 1) > 95.0
    assert qs.compare(z, found, horizon=1) == (found.model.compare(z, 1),)
    ahead = found.model.predict(z, 10)
    assert np.nanstd(ahead - z.y) < 0.2 * np.std(z.y)
    np.testing.assert_array_equal(qs.simulate(found, z.u[:500]), found.model.simulate(z.u[:500]))
    assert found.model.residuals(z).residual_uncorrelated_with_input in (True, False)


def test_experiments_of_one_unit_are_compared_in_it_whatever_their_largest_value(result, refusal):
    """Beyond 10 V one volt is a smaller share of full command."""
    found, flight = result
    given = in_volts_and_rpm(flight)
    u, y = given['u'], given['y']
    more = np.append(u[:-1], 30.0)
    wanted = qs.from_arrays(**given)
    other = qs.from_arrays(**{**given, 'u': more, 'y': y + 1e-9})
    assert other.units != wanted.units
    np.testing.assert_allclose(other.axis('roll').u, more)
    np.testing.assert_allclose(other.axis('roll').y, y, atol=1e-8)
    np.testing.assert_allclose(together([wanted, other])[1].control[:-1], wanted.control[:-1])
    errors = [qs.evaluate(found.model, one).after for one in (wanted, other)]
    assert errors[1] == pytest.approx(errors[0], rel=0.01)
    assert found.model.compare(other, 1) == pytest.approx(found.model.compare(wanted, 1), abs=0.1)
    of_both = [trims(one)['roll'] for one in (wanted, other)]
    assert of_both[0].unit == of_both[1].unit == 'V'
    assert of_both[1].value == pytest.approx(of_both[0].value, abs=0.02)
    milli = qs.from_arrays(**{**given, 'u': 1e3 * u, 'units': {'u': 'mV', 'y': 'rpm'}})
    assert 'found mV, the other V' in refusal(qs.evaluate, found.model, milli)
    sliding = qs.from_arrays(**{**given, 'units': {'u': 'V', 'y': 'mm/s'}})
    assert 'found mm/s, the other rpm' in refusal(qs.evaluate, found.model, sliding)


def test_the_units_of_arrays_are_those_of_their_own_axis_alone():
    beside = 0.1 * np.roll(U, 7)
    signals = {'throttle': 0.5 + 0.01 * U, 'pitch_command': beside, 'pitch_rate': Y}
    flight = record(u=20.0 * U, units={'u': 'V', 'y': 'rpm'}, signals=signals)
    np.testing.assert_allclose(flight.axis('roll').u, 20.0 * U)
    np.testing.assert_allclose(flight.axis('pitch').u, beside)
    np.testing.assert_allclose(flight.axis('pitch').y, Y)
    other = record(u=200.0 * U, units={
        'u': 'volts', 'throttle': 'percent', 'pitch_command': 'pulse_us'}, signals={
            'throttle': 50.0 + U, 'pitch_command': 1500.0 + 1000.0 * beside})
    assert other.units.command == flight.units.command  # though it is more than 10 V
    np.testing.assert_allclose(other.control[:, 0], flight.control[:, 0])
    np.testing.assert_allclose(other.control[:, 2], beside, atol=1e-12)
    found = trims(flight)
    assert {axis: mean.unit for axis, mean in found.items()} == {
        'roll': 'V', 'pitch': 'normalised command', 'climb': 'normalised command'}
    assert found['climb'].value == pytest.approx(0.5, abs=0.01)


def test_an_experiment_is_designed_in_the_units_of_the_arrays(result):
    found, _ = result
    design = qs.design_experiment(found, amplitude=2.0, seconds=2.0)
    known = found.model.parameters
    assert design.std_now['gain'] == pytest.approx(known['gain'].std)
    assert design.std_now['coulomb_friction.torque'] == pytest.approx(
        known['coulomb_friction.torque'].std)
    assert 0.1 * known['gain'].std < design.std_expected['gain'] <= known['gain'].std


def test_pictures_speak_the_units_of_the_arrays(result):
    found, flight = result
    labels = {'signals': ('time, s', 'rate, rpm'), 'free_run': ('time, s', 'rate, rpm'),
              'horizon': ('time since the start of the window, s', 'RMS error, rpm'),
              'left_out': ('rate, rpm', 'left out, rev/s²'),
              'effect_shape': ('rate, rpm', 'torque / inertia, rev/s²')}
    drawn = {name: found.plot(name) for name in labels}
    for name, (x, y) in labels.items():
        first, last = drawn[name].axes[0], drawn[name].axes[-1]
        assert (first.get_xlabel() or last.get_xlabel(), first.get_ylabel()) == (x, y), name
    rate, command = drawn['signals'].axes[0], drawn['signals'].axes[-1]
    assert command.get_ylabel() == 'command, V'
    np.testing.assert_allclose(command.lines[-1].get_ydata(), 20.0 * flight.control[:, 1])
    np.testing.assert_allclose(rate.lines[-1].get_ydata(), 30.0 / math.pi * flight.rates[:, 0])
    effect = drawn['effect_shape'].axes[0].lines[-2].get_ydata()
    assert np.abs(effect).max() == pytest.approx(6.0 / (2.0 * math.pi), rel=0.05)
    slide = Units('V', 0.05, 0.0, 'mm/s', 1e-3, 'mm', 1e-3)
    assert {scale(slide, name, unit).label: scale(slide, name, unit)(np.ones(1))[0]
            for name, unit in (('rate', 'rad/s'), ('torque / inertia', 'rad/s²'),
                               ('gain', f'rad/s per {COMMAND}'), ('error', '(rad/s)²/Hz'),
                               ('acting command', COMMAND))} == pytest.approx({
        'speed, mm/s': 1e3, 'acceleration, mm/s²': 1e3, 'gain, mm/s per V': 50.0,
        'error, (mm/s)²/Hz': 1e6, 'acting command, V': 20.0})


def test_every_function_takes_what_the_others_return(result, tmp_path):
    found, flight = result
    model = found.model
    assert model.bode([1.0]).magnitude[0] == qs.bode(found, [1.0]).magnitude[0]
    settled = model.step({'roll.rate.kp': 0.06, 'roll.angle.kp': 3.0}).angle[-1]
    assert settled == pytest.approx(0.2, abs=0.1)  # it sticks before
    gains = qs.CascadeGains.from_mapping({}, 'roll')
    assert np.isfinite(qs.simulate_cascade(model, gains, np.full(50, 0.1), DT).angle).all()
    assert model.to_control().ninputs == 1
    assert qs.export(found, tmp_path / 'model.mat').stat().st_size > 100
    assert qs.inspect(flight).length_s == pytest.approx(SHORT.seconds)
    saved = found.save(tmp_path / 'out', html=False, pictures=False).folder
    (_, changes), = qs.compare(found, saved)
    assert not any(change.changed for change in changes)
    assert 'coulomb_friction' in model._repr_html_()
    box = qs.arx(flight.axis('roll', 'train'), 4, 4, 3)
    z = flight.axis('roll', 'validation')
    assert box.compare(z) == qs.compare(z, box)[0]
    assert qs.compare(flight, box) == qs.compare(flight.axis('roll'), box)
    assert box.to_control().dt == DT
    assert box.bode([3.0]).w[0] == 3.0


def test_result_and_model_are_copied_pickled_and_written_without_loss(
    result, refusal, tmp_path
):
    found, _ = result
    text = found.model.to_json()
    for again in (copy.deepcopy(found.model), pickle.loads(pickle.dumps(found.model)),  # noqa: S301
                  qs.Identified.from_json(text)):
        assert again.to_json() == text
        np.testing.assert_array_equal(again.simulate([1.0, 2.0, 3.0]),
                                      found.model.simulate([1.0, 2.0, 3.0]))
    whole = found.to_json()
    for one in (pickle.loads(pickle.dumps(found)), qs.Result.from_json(whole)):  # noqa: S301
        assert one.to_json() == whole
        assert str(one) == str(found)
        assert one.effects == found.effects
        assert one.gains == found.gains
        saved = one.save(tmp_path / 'out', html=False, pictures=False)
        assert one['roll'].errors == saved.errors == found.errors
    assert repr(found) == 'roll: effects_added coulomb_friction'
    assert 'a result of from_json has no pictures' in refusal(one.plot, 'free_run')
    assert 'no result' in refusal(qs.Result.from_json, json.dumps({}))


def test_a_result_of_several_axes_has_no_verdict_and_says_which_it_has(refusal):
    answers = dict.fromkeys(('roll', 'pitch'))
    several = qs.Result(answers, ('none',))
    assert not hasattr(several, 'verdict')
    assert 'has several axes' in refusal(getattr, several, 'verdict')


def test_the_page_for_scripts_runs_as_it_stands(result, tmp_path, monkeypatch):
    """With this result and small searches, which take seconds."""
    found, flight = result
    given = in_volts_and_rpm(flight)
    names = {'qs': qs, 'result': found, 'volts': given['u'], 'speed': given['y'],
             'volts2': given['u'], 'speed2': given['y']}
    monkeypatch.chdir(tmp_path)
    page = PAGE.read_text().partition('## Arrays of your own')[2].partition('## Black-box')[0]
    first, *blocks = re.findall(r'```python\n(.*?)```', page, re.DOTALL)
    assert first.startswith('result = qs.identify(u=volts, y=speed, dt=0.004')
    for block in blocks:
        exec(block.replace('qs.compare(result, unseen)', 'qs.compare(result, result)').replace(  # noqa: S102
            'base=motor)', 'base=motor, effects=())'), names)
    assert (tmp_path / 'motor.mat').exists()
