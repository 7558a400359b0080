"""A flight that says nothing of a stored model is refused in words, not answered in figures."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from quad_sysid.bags import write_bag
from quad_sysid.cli import main
from quad_sysid.errors import NotInformativeError
from quad_sysid.model import AxisModel, Parameter
from quad_sysid.pipeline.evaluate import evaluate
from quad_sysid.record import Record
from quad_sysid.report.model_file import save_models

NOISE = 0.01


@pytest.fixture(scope='module')
def flight(flown: Callable[..., Record], axis_type: type) -> Record:
    return flown(axis_type(), 11)


def model_of(record: Record, axis: str = 'roll') -> AxisModel:
    """Near enough to the flight's own plant."""
    values = {'gain': 450.0, 'lag': 0.042, 'delay': 0.01, 'damping': 0.4, 'bias': 0.0}
    base = tuple(Parameter(name, value, None, '') for name, value in values.items())
    return AxisModel(axis, record.dt, None, base, noise_rms=NOISE, correction=(0.3, 0.0, 0.0, 0.0))


def held(record: Record) -> Record:
    """Roll locked in a rig: the gyro's noise alone."""
    rates = record.rates.copy()
    rates[:, 0] = NOISE * np.random.default_rng(0).standard_normal(record.n)
    return replace(record, rates=rates)


def silent(record: Record) -> Record:
    return replace(record, rates=np.zeros_like(record.rates))


def flat_out(record: Record) -> Record:
    control = np.zeros_like(record.control)
    control[:, 0] = 1.0
    return replace(record, motors=np.ones((record.n, 4)), control=control)


@pytest.mark.parametrize(
    ('spoil', 'told'),
    [(held, 'does not move'), (silent, 'does not move'), (flat_out, 'at their limits')],
)
def test_what_says_nothing_of_the_model_has_no_figures(flight, spoil, told):
    with pytest.raises(NotInformativeError, match=told) as caught:
        evaluate(model_of(flight), spoil(flight))
    assert '\n' not in str(caught.value)


def test_a_flight_that_moves_is_evaluated(flight):
    found = evaluate(model_of(flight), flight)
    assert found.hold > 10.0 * NOISE
    assert found.before < found.hold


def test_the_command_answers_the_axes_it_can_and_names_the_others(flight, tmp_path: Path, capsys):
    write_bag(flight, tmp_path / 'bag')
    models = {axis: model_of(flight, axis) for axis in ('roll', 'pitch')}
    save_models(models, tmp_path / 'model.json')
    given = ['evaluate', str(tmp_path / 'model.json'), str(tmp_path / 'bag')]
    assert main([*given, '--json']) == 0
    said = capsys.readouterr()
    tree = json.loads(said.out)
    assert list(tree['axes']) == ['roll']
    assert 'pitch: the rate does not move' in tree['not_answered']['pitch']
    assert said.err.count('\n') == 1
    assert main([*given, '--axis', 'pitch']) == 3
    said = capsys.readouterr()
    assert said.out == ''
    assert 'does not move' in said.err
