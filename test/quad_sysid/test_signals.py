"""Test signals: exact properties, the design's equations, schedules and their errors."""

import math
from pathlib import Path

import numpy as np
import pytest
import yaml

from quad_sysid import signals
from quad_sysid.excitation_settings import load_schedule

CONFIG = Path(__file__).resolve().parents[2] / 'src/quad_sysid/config'
EXAMPLES = {
    'prbs': {'clock_s': 0.1, 'register_bits': 5}, 'square': {'period_s': 2.0},
    'chirp': {'f0_hz': 0.1, 'f1_hz': 4.0, 'sweep_s': 20.0},
    'multisine': {'f0_hz': 0.1, 'f1_hz': 3.0, 'period_s': 20.0}, '3211': {'unit_s': 0.3},
    'none': {}}


@pytest.mark.parametrize('bits', range(2, 16))
def test_a_prbs_is_a_maximal_sequence(bits):
    signal = signals.prbs_bits(bits, seed=bits)
    length = 2**bits - 1
    assert len(signal) == length
    assert np.count_nonzero(signal > 0) == 2 ** (bits - 1)
    spectrum = np.fft.fft(signal)
    correlation = np.rint(np.fft.ifft(np.abs(spectrum) ** 2).real)
    assert correlation[0] == length
    assert (correlation[1:] == -1).all()


def test_seeds_shift_the_sequence_and_a_generator_draws_them(refusal):
    one, other = signals.prbs_bits(7, 1), signals.prbs_bits(7, 2)
    assert (one != other).any()
    assert any((np.roll(one, k) == other).all() for k in range(127))
    drawn = signals.prbs(7, 3, 0.2, np.random.default_rng(4))
    np.testing.assert_array_equal(drawn, signals.prbs(7, 3, 0.2, np.random.default_rng(4)))
    assert drawn.shape == (381,)
    assert set(np.unique(drawn)) == {-0.2, 0.2}
    assert 'register_bits' in refusal(signals.prbs_bits, 16)
    assert 'clock_samples' in refusal(signals.prbs, 5, 0, 1.0)


@pytest.mark.parametrize('name', sorted(signals.SIGNALS))
def test_every_signal_stays_within_one_and_uses_it(name):
    shape = signals.waveform(name, EXAMPLES[name], 'test')
    values = np.array([shape.at(t) for t in np.arange(0.0, 60.0, 0.004)])
    assert np.abs(values).max() <= 1.0
    if name != 'none':
        assert np.abs(values).max() > 0.95
        assert abs(values.mean()) < 0.1


def test_a_multisine_has_its_power_in_its_lines_only():
    shape = signals.waveform('multisine', EXAMPLES['multisine'], 'test')
    values = np.array([shape.at(t) for t in np.arange(5000) * 0.004])
    power = np.abs(np.fft.rfft(values)) ** 2
    assert power[2:61].sum() > 0.999999 * power.sum()
    assert power[2:61].min() == pytest.approx(power[2:61].max(), rel=1e-6)
    assert np.abs(values).max() / values.std() < 2.0
    many = {'f0_hz': 0.05, 'f1_hz': 10.0, 'period_s': 2000.0}  # 19,901 lines
    assert abs(signals.waveform('multisine', many, 'test').at(1.0)) <= 1.0


def test_a_chirp_sweeps_from_f0_to_f1():
    shape = signals.waveform('chirp', {'f0_hz': 0.5, 'f1_hz': 4.0, 'sweep_s': 20.0}, 'test')
    values = np.array([shape.at(t) for t in np.arange(20_000) * 0.001])
    ups = np.flatnonzero((values[:-1] <= 0) & (values[1:] > 0)) * 0.001
    assert 1.0 / (ups[1] - ups[0]) == pytest.approx(0.5, rel=0.12)
    assert 1.0 / (ups[-1] - ups[-2]) == pytest.approx(4.0, rel=0.05)


def test_3211_holds_its_levels():
    shape = signals.waveform('3211', {'unit_s': 1.0}, 'test')
    assert [shape.at(k + 0.5) for k in range(20)] == [
        1, 1, 1, -1, -1, 1, -1, 0, 0, 0, -1, -1, -1, 1, 1, -1, 1, 0, 0, 0,
    ]  # fmt: skip


def test_the_papers_band_gives_what_its_equations_say():
    design = signals.design_excitation(0.1, 20.0)
    assert (design.clock_s, design.length) == (0.092, 511)
    assert 0.0 <= 0.3 * 2 * math.pi / 20.0 - design.clock_s < 0.004
    assert 3.0 <= design.period_s / 10.0 <= 5.0
    assert design.covered_rad_s[1] >= 20.0
    assert (design.order(1e3), design.order(9.2)) == (511, 100)
    for figure in ('0.09425', '0.092', '511', '0.03 s', '424', 'eq. (9)', 'eq. (10)'):
        assert figure in design.text()


def schedule_of(design, *words):
    return signals.parse_schedule(yaml.safe_load(design.to_schedule_yaml(*words)), 'design')


@pytest.mark.parametrize(('low', 'high', 'rate'), [(0.1, 20, 250), (0.5, 40, 500), (1, 6, 100)])
def test_a_design_is_a_schedule_that_can_be_flown(low, high, rate):
    design = signals.design_excitation(low, high, rate)
    schedule = schedule_of(design, 'pitch', 10.0)
    train = schedule.parts[1]
    assert (train.axis, train.signal) == ('pitch', 'prbs')
    assert train.parameters['clock_s'] == pytest.approx(design.clock_s)
    assert train.amplitude == pytest.approx(math.radians(10.0))
    assert train.duration_s >= min(design.period_s, 120.0)
    assert 'which does not reach LOW' in design.text()
    ratio = design.period_s * low
    assert 4.0 / math.sqrt(2.1) < ratio < 4.0 * math.sqrt(2.1)


def test_a_length_of_the_training_reaches_the_low_end_of_the_band(refusal):
    told = signals.design_excitation(0.1, 20.0).text()
    assert 'covers 0.208 to 20.49 rad/s, which does not reach LOW (0.1 rad/s)' in told
    assert '--seconds 100 does' in told
    design = signals.design_excitation(0.1, 20.0, train_s=100.0)
    train = schedule_of(design).parts[1]
    assert train.duration_s == 100.0
    assert (2 ** train.parameters['register_bits'] - 1) * design.clock_s >= 2.0 * math.pi / 0.1
    assert 'training 100 s: covers 0.0997 to 20.49 rad/s' in design.text().split('\n')
    assert 'raise LOW' in signals.design_excitation(1e-4, 20.0).text()
    for wrong in (-5.0, 0.3, 0.99):  # the ramps alone take a second
        assert '--seconds' in refusal(signals.design_excitation, 0.1, 20.0, 250.0, wrong)
    for high, least in ((20.0, 1.0), (5.0, 2.0)):
        design = signals.design_excitation(0.1, high, train_s=least)
        train = schedule_of(design).parts[1]
        assert train.duration_s == least
        assert design.flown_low_rad_s < high


@pytest.mark.parametrize(('low', 'high'), [(5.0, 100.0), (0.01, 0.5)])
def test_a_design_of_an_odd_band_trains_long_enough_and_its_square_turns(low, high):
    """A fit takes 5 s; a level that is held for 16 s is no square wave."""
    design = signals.design_excitation(low, high)
    _, train, *_, square, _ = schedule_of(design).parts
    assert train.duration_s >= 10.0
    assert square.duration_s >= 2.0 * square.parameters['period_s']
    assert 'too short for a fit' not in design.text()
    assert 'too short for a fit' in signals.design_excitation(low, 100.0, train_s=4.0).text()


@pytest.mark.parametrize(('name', 'seconds'), [('rig', 83), ('demo', 60), ('hover', 156)])
def test_the_shipped_schedules_are_in_order(name, seconds):
    schedule = load_schedule(CONFIG / f'schedule_{name}.yaml')
    assert schedule.duration_s == pytest.approx(seconds)
    assert schedule.mount == ('hover' if name == 'hover' else 'rig')
    roles = [part.role for part in schedule.parts]
    assert roles[0] == roles[-1] == 'idle'
    train = {(p.axis, p.parameters['register_bits']) for p in schedule.parts if p.role == 'train'}
    for part in schedule.parts:
        if part.role == 'validation' and part.signal == 'prbs':
            assert (part.axis, part.parameters['register_bits']) not in train
    largest = max(abs(v) for t in np.arange(0, seconds, 0.01) for v in schedule.sample(t))
    assert largest <= math.radians(12.0)


def test_one_axis_at_a_time_with_ramps_and_rest():
    schedule = load_schedule(CONFIG / 'schedule_rig.yaml')
    assert schedule.sample(-1.0) == schedule.sample(1.0) == schedule.sample(1e4) == (0, 0, 0)
    part = schedule.parts[1]
    for t, share in ((0.1, 0.2), (20.0, 1.0), (part.duration_s - 0.25, 0.5)):
        assert abs(part.at(t)) == pytest.approx(share * part.amplitude)
    assert part.at(part.duration_s) == 0.0
    assert (schedule.index(3.0), schedule.index(83.0)) == (1, None)
    told = part.announcement()
    assert (told['segment'], told['register_bits']) == ('train', 9)
    assert told['amplitude'] == pytest.approx(math.radians(12.0))
    assert schedule.parts[0].announcement()['signal'] == 'none'


GOOD = {'segment': 'train', 'signal': 'square', 'period_s': 2.0, 'duration_s': 10.0}


@pytest.mark.parametrize(('injection', 'key', 'value', 'si'), [
    ('attitude', 'amplitude_deg', 10.0, math.radians(10.0)),
    ('rate', 'amplitude_deg_s', 90.0, math.radians(90.0)), ('control', 'amplitude', 0.05, 0.05),
])
def test_an_amplitude_has_the_unit_of_its_injection(injection, key, value, si):
    given = {'segments': [{**GOOD, 'injection': injection, key: value}]}
    (part,) = signals.parse_schedule({'schedule': given}, 'flight.yaml').parts
    assert part.amplitude == pytest.approx(si)


@pytest.mark.parametrize(
    ('change', 'named'),
    [
        ({'amplitud_deg': 3}, 'amplitud_deg'), ({'amplitude_deg': 25.0}, 'amplitude_deg'),
        ({'segment': 'trian'}, "'trian'"), ({'signal': 'sine'}, "'sine'"), ({'axis': 'x'}, "'x'"),
        ({'signal': 'prbs', 'clock_s': 0.1, 'register_bits': 99, 'period_s': None},
         'register_bits must be a whole number from 2 to 15: found 99'),
        ({'signal': 'prbs'}, 'period_s'), ({'segment': 'idle'}, 'idle'),
    ],
)
def test_a_wrong_segment_is_told_with_file_number_and_key(change, named, refusal):
    wrong = {key: value for key, value in (GOOD | change).items() if value is not None}
    segments = [{'segment': 'idle', 'duration_s': 1}, wrong]
    line = refusal(signals.parse_schedule, {'schedule': {'segments': segments}}, 'flight.yaml')
    assert line.startswith('flight.yaml, segment 2')
    assert named in line
