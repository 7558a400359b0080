"""A unit or a sign that a table contradicts is refused with what helps; twins that fit pass."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from quad_sysid.bags import ImportOptions, import_csv, parse_units, read_bag
from quad_sysid.cli import main
from quad_sysid.errors import BadInputError

DT, N = 0.004, 1600
DEG = np.pi / 180.0


def flight(seed: int = 1) -> dict[str, np.ndarray]:
    """Noisy rates (biased) and angles of an excited flight, SI."""
    rng = np.random.default_rng(seed)
    t = DT * np.arange(N)
    angle = 0.15 * np.sin(5.0 * t) + 0.05 * np.sin(17.0 * t)
    rate = 0.75 * np.cos(5.0 * t) + 0.85 * np.cos(17.0 * t)
    return {
        't': t, 'u': 0.1 * np.sin(5.0 * t), 'angle': angle + 0.003 * rng.standard_normal(N),
        'rate': rate + 0.1 + 0.1 * rng.standard_normal(N),
        'ref': 0.15 * np.sin(5.0 * t + 0.3),
    }


def imported(folder: Path, scale: dict[str, float], units: list[str] = (), **names: str | None):
    """Import a flight with its columns times `scale`; the bag."""
    table = {name: values * scale.get(name, 1.0) for name, values in flight().items()}
    file = folder / 'log.csv'
    rows = '\n'.join(
        ','.join(f'{x:.10g}' for x in row) for row in zip(*table.values(), strict=True)
    )
    file.write_text(','.join(table) + '\n' + rows + '\n')
    columns = {'control': 'u', 'rate': 'rate', 'angle': 'angle', 'reference': 'ref', **names}
    return import_csv(ImportOptions(
        file=file, axis='roll', time='t', out=folder / 'bag', units=parse_units(list(units)),
        **columns,
    ))


def checks(bag: Path) -> list[str]:
    return [line for line in read_bag(bag).warnings if line.startswith('import check')]


def test_a_table_that_fits_is_not_remarked_on(tmp_path):
    assert checks(imported(tmp_path, {})) == []


@pytest.mark.parametrize(
    ('scale', 'units', 'advice'),
    [
        ({'rate': 1 / DEG}, [], '--unit rate=deg/s'),
        ({}, ['rate=deg/s'], '--unit rate=rad/s'),
        ({'angle': 1 / DEG}, ['angle=rad'], '--unit angle=deg'),
        ({}, ['angle=deg', 'rate=rad/s', 'ref=deg'], '--unit angle=rad'),
        ({'ref': 1 / DEG}, [], '--unit ref=deg'),
        ({}, ['ref=deg'], '--unit ref=rad'),
        ({'angle': 0.05 / DEG, 'rate': 0.05, 'ref': 0.05}, [], '--unit angle=deg'),
        ({'rate': -1.0}, [], '--unit rate=-1, or --unit angle=-1'),
        ({'angle': -1.0, 'ref': -1.0}, [], '--unit rate=-1, or --unit angle=-1'),
        ({'rate': -1 / DEG}, ['rate=deg/s'], '--unit rate=-0.0174533, or'),
        ({'rate': -1 / DEG}, [], '--unit rate=-0.0174533'),
        ({'t': 1e3}, [], '--unit t=ms (250 Hz), or --unit t=s'),
        ({'t': 1e6}, [], '--unit t=us (250 Hz)'),
        ({'t': 1e9}, [], '--unit t=ns (250 Hz)'),
        ({'t': 1e-3}, [], '--unit t=FACTOR'),
        ({'rate': 100.0 / DEG}, [], '--unit rate=deg/s'),
    ],
)
def test_what_cannot_be_is_refused_with_what_helps(tmp_path, scale, units, advice):
    if scale.get('rate') == 100.0 / DEG:
        with pytest.raises(BadInputError) as caught:
            imported(tmp_path, scale, units, angle=None, reference=None)
    else:
        with pytest.raises(BadInputError) as caught:
            imported(tmp_path, scale, units)
    line = str(caught.value)
    assert advice in line
    assert 'log.csv, column ' in line
    assert '\n' not in line
    assert not (tmp_path / 'bag').exists()


@pytest.mark.parametrize(
    ('scale', 'units'),
    [
        ({'rate': 1 / DEG}, ['rate=deg/s']),
        ({'rate': -1 / DEG}, ['rate=-0.0174533']),
        ({'angle': 1 / DEG}, ['angle=deg']),
        ({'rate': -1.0, 'angle': -1.0, 'ref': -1.0}, []),
        ({'t': 1e3}, ['t=ms']),
        ({'t': 1e6}, ['t=us']),
    ],
)
def test_what_was_advised_mends_it(tmp_path, scale, units):
    bag = imported(tmp_path, scale, units)
    assert checks(bag) == []
    sign = -1.0 if scale.get('rate') == -1.0 else 1.0
    np.testing.assert_allclose(read_bag(bag).rates[:, 0], sign * flight()['rate'], atol=2e-5)


@pytest.mark.parametrize('factor', [0.7, 1.4, 3.0])
def test_another_factor_is_told(tmp_path, factor):
    (told,) = checks(imported(tmp_path, {'rate': 1.0 / factor}))
    advised = float(told.rpartition('--unit rate=')[2])
    assert advised == pytest.approx(factor, rel=0.05)  # the noise of angle and rate


def test_a_factor_within_a_fifth_is_not_told(tmp_path):
    assert checks(imported(tmp_path, {'rate': 1.1})) == []


def test_a_rate_without_an_angle_is_told_in_both_units(tmp_path):
    (told,) = checks(imported(tmp_path, {}, angle=None, reference=None))
    rms = np.std(flight()['rate'])
    assert f'{rms:.3g} rad/s, {rms / DEG:.3g} deg/s' in told


def test_a_named_unit_of_time_holds_even_where_it_is_unusual(tmp_path):
    (told,) = checks(imported(tmp_path, {'t': 50.0}, ['t=s'], angle=None, reference=None,
                              control='u', rate='rate'))
    assert '5 Hz in s' in told


def test_an_angle_that_wraps_is_not_held_against_its_jumps(tmp_path):
    t = DT * np.arange(N)
    rate = 2.0 + np.sin(3.0 * t)
    angle = np.angle(np.exp(1j * (2.0 * t - np.cos(3.0 * t) / 3.0)))
    file = tmp_path / 'log.csv'
    rows = '\n'.join(f'{a:.9g},0,{b:.9g},{c:.9g}' for a, b, c in zip(t, rate, angle, strict=True))
    file.write_text(f't,u,r,a\n{rows}\n')
    bag = import_csv(ImportOptions(file, 'yaw', 't', tmp_path / 'bag', control='u', rate='r',
                                   angle='a'))
    assert checks(bag) == []


def test_the_command_says_what_comes_next(tmp_path, capsys):
    imported(tmp_path, {})
    arguments = ['import', str(tmp_path / 'log.csv'), '--axis', 'roll', '--time', 't', '--control',
                 'u', '--rate', 'rate', '--out', str(tmp_path / 'again')]
    assert main(arguments) == 0
    printed = capsys.readouterr().out
    assert f'next: quad-sysid inspect {tmp_path / "again"}' in printed
    assert 'import check: the unit of rate could not be checked' in printed
