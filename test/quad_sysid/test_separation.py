"""Which flight tells two rivals apart: the closed loop is exact, the order makes sense, it works.

The first part holds the compiled loop against the table of effects, entry by entry. The last flies
what is recommended with the virtual STM32's physics, which the design knows nothing of.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import yaml

from quad_bridge.virtual.profile import load_profile
from quad_bridge.virtual.simulation import Excited
from quad_bridge.virtual.simulation import fly as fly_virtual
from quad_sysid.cli import main
from quad_sysid.contract import control_from_motors
from quad_sysid.effects.discover import discover
from quad_sysid.effects.shapes import SHAPES
from quad_sysid.effects.table import EFFECTS
from quad_sysid.errors import BadInputError, NotInformativeError
from quad_sysid.greybox.data import AxisData, axis_data
from quad_sysid.greybox.noise import predicted_rms
from quad_sysid.greybox.simulate import Simulator
from quad_sysid.greybox.structure import Effect, Structure
from quad_sysid.model import AxisModel, EffectEstimate, Parameter
from quad_sysid.pipeline.advice import rivalry
from quad_sysid.record import GainChange, Record, Segment
from quad_sysid.report.model_file import save_models
from quad_sysid.separation import family, kernels, words
from quad_sysid.separation.aircraft import PAPER, paper_aircraft
from quad_sysid.separation.design import Separation, rivals_of, separate
from quad_sysid.separation.flight import Excitation, fly, surroundings
from quad_sysid.separation.measure import noise_of
from quad_sysid.separation.stages import stages_of
from quad_sysid.separation.strength import vector_of
from quad_sysid.session import separation
from quad_sysid.signals.schedule import Part, parse_schedule
from quad_sysid.signals.waveforms import waveform

ALL = EFFECTS + SHAPES
RATE_HZ = 250
INERTIA = 0.0135
"""Of roll in the profile `plain`, kg m²."""


def label(effect: Effect) -> str:
    return f'{effect.name} {effect.variant}'.strip()


def short_flight() -> Excitation:
    return replace(family.plain('roll', 12.0), throttle_steps=True, others_move=True)


def simulator(data: AxisData) -> Simulator:
    noise = noise_of(paper_aircraft('roll'), data)
    return Simulator(data, data.train, data.windows(data.train), noise.model.correction)


# ------------------------------------------------------------------------- the closed loop


@pytest.mark.parametrize('effect', ALL, ids=label)
def test_the_loop_flies_each_effect_as_the_free_run_knows_it(effect: Effect) -> None:
    aircraft, flight = paper_aircraft('roll'), short_flight()
    plain = fly(aircraft, Structure(), aircraft.theta, flight).data
    settings = effect.prepare(plain) if effect.prepare else {}
    assert not isinstance(settings, str), settings
    size, vector = vector_of(effect)
    structure = Structure().with_effect(effect, settings)
    theta = np.concatenate([aircraft.theta, vector(size, plain)])
    data = fly(aircraft, structure, theta, flight).data
    sim = simulator(data)
    # the model that flew predicts its own flight; a curve of the command is flown as a table
    assert sim.run(structure, theta).rms < (1e-4 if effect.name == 'shape:command' else 1e-9)
    assert sim.run(Structure(), aircraft.theta).rms > 1e-5
    if effect.command is not None:
        around = surroundings(aircraft, flight, data.rate.size)
        flown = kernels.staged(data.command, *stages_of(structure, theta, around))
        np.testing.assert_allclose(flown, sim.commands(structure, theta), atol=1e-5)


def test_two_effects_on_the_command_act_one_behind_the_other() -> None:
    aircraft, flight = paper_aircraft('pitch'), family.plain('pitch', 12.0)
    plain = fly(aircraft, Structure(), aircraft.theta, flight).data
    structure, theta = Structure(), aircraft.theta
    for name in ('dead_zone', 'backlash', 'coulomb_friction'):
        effect = next(e for e in ALL if e.name == name)
        structure = structure.with_effect(effect, {})
        theta = np.concatenate([theta, vector_of(effect)[1](2e-3, plain)])
    data = fly(aircraft, structure, theta, flight).data
    assert simulator(data).run(structure, theta).rms < 1e-9


def test_the_plain_loop_follows_its_reference() -> None:
    aircraft = paper_aircraft('roll')
    square = waveform('square', {'period_s': 8.0}, 'test')
    part = Part('train', 16.0, 'square', amplitude=0.2, waveform=square)
    data = fly(aircraft, Structure(), aircraft.theta, Excitation(part)).data
    assert data.angle is not None
    for edge_s, level in ((5.0, 0.2), (9.0, -0.2), (13.0, 0.2)):
        assert data.angle[round((edge_s - 0.1) * RATE_HZ)] == pytest.approx(level, abs=0.02)


def test_noise_over_a_window_agrees_with_the_prediction_of_its_rms() -> None:
    aircraft = paper_aircraft('roll')
    data = fly(aircraft, Structure(), aircraft.theta, family.plain('roll', 12.0)).data
    noise = noise_of(aircraft, data)
    length = noise.covariance.shape[0]
    expected = predicted_rms(noise.model, float(aircraft.theta[3]), data, length)
    assert noise.rms == pytest.approx(expected, rel=0.01)
    assert np.all(np.linalg.eigvalsh(noise.covariance) > 0.0)
    assert noise.covariance[-1, -1] > noise.covariance[0, 0]


# ---------------------------------------------------------------------------- the order


@pytest.fixture(scope='module')
def springs() -> Separation:
    return separate(paper_aircraft('roll'), ('pendulum_stiffness', 'cubic_stiffness'), 40.0)


def test_springs_are_told_apart_by_larger_angles_than_the_plain_prbs(springs: Separation) -> None:
    assert springs.best.peak_angle > 1.4 * springs.plain.peak_angle
    assert springs.best.worst.score > 1.8 * springs.plain.worst.score
    scores = [row.worst.score for row in springs.rows]
    assert scores == sorted(scores, reverse=True)


def test_friction_and_drag_are_told_apart_both_ways() -> None:
    found = separate(paper_aircraft('roll'), ('coulomb_friction', 'quadratic_drag'), 40.0)
    best, plain = found.best, found.plain
    assert best.first is not None
    assert best.second is not None
    assert min(best.first.score, best.second.score) > 1.3 * plain.worst.score
    # friction is seen at any rate, drag wants large ones
    assert best.rate_rms > 0.5 * plain.rate_rms
    assert best.worst.over(60.0).probability > 0.98


def test_sag_shows_where_the_throttle_moves() -> None:
    found = separate(paper_aircraft('roll'), ('battery_sag', 'nothing'), 40.0)
    assert found.best.excitation.throttle_steps
    assert found.best.second is None
    assert found.best.worst.score > 2.0 * found.plain.worst.score
    assert 'the pilot steps the throttle' in words.why(found)


def test_nothing_flown_goes_near_the_angle_that_ends_a_flight(springs: Separation) -> None:
    assert max(math.degrees(row.peak_angle) for row in springs.rows) <= 22.5


def test_longer_flights_tell_more_and_the_time_asked_for_is_enough(springs: Separation) -> None:
    one = springs.plain.worst
    assert one.over(4.0 * one.seconds).distance == pytest.approx(2.0 * one.distance)
    needed = one.seconds_for(0.95)
    assert one.over(needed).probability == pytest.approx(0.95)


# ------------------------------------------------------------------------ words and command


def test_the_table_fits_the_terminal_and_says_why(springs: Separation) -> None:
    text = words.text(springs)
    assert max(len(line) for line in text.splitlines()) <= 80
    assert 'Fly ' in text
    assert 'cubic_stiffness' in text


def test_the_node_reads_the_schedule(springs: Separation) -> None:
    schedule = parse_schedule(yaml.safe_load(words.schedule(springs)), 'schedule')
    train = [part for part in schedule.parts if part.role == 'train']
    assert sum(part.duration_s for part in train) == pytest.approx(40.0, abs=0.2)
    assert train[-1].signal == springs.best.excitation.part.signal
    assert train[-1].amplitude == pytest.approx(springs.best.excitation.part.amplitude, rel=1e-4)
    assert [part.role for part in schedule.parts].count('validation') >= 1


@pytest.mark.parametrize('row', [*family.ATTITUDE, *family.SLOW, *family.CONTROL], ids=str)
def test_every_candidate_can_be_written_and_read(
    row: family.Row, springs: Separation
) -> None:
    injection = 'control' if row in family.CONTROL else 'attitude'
    wanted = next(
        (e for e in (found.excitation for found in springs.rows)
         if e.part.signal == row[0] and dict(e.part.parameters) == dict(row[1])
         and e.part.injection == injection), None,
    )
    if wanted is None:
        pytest.skip('not safe for this pair')
    best = replace(springs.best, excitation=wanted)
    made = replace(springs, rows=(best, *springs.rows))
    schedule = parse_schedule(yaml.safe_load(words.schedule(made)), 'schedule')
    assert schedule.parts[-2].role == 'validation'


def model_with_rival(probability: float) -> AxisModel:
    base = tuple(
        Parameter(name, value, 0.01, '')
        for name, value in zip(
            ('gain', 'lag', 'delay', 'damping', 'bias'), PAPER['roll'], strict=True
        )
    )
    friction = EffectEstimate(
        'coulomb_friction', 'named', ('rate',), (Parameter('torque', 0.12, 0.01, 'rad/s²'),),
        probability=1.0 - probability, rivals=(('quadratic_drag', probability),),
    )
    names = ('gain', 'lag', 'delay', 'damping', 'bias', 'coulomb_friction.torque')
    return AxisModel(
        'roll', 0.004, 42.0, base, (friction,), names, noise_rms=0.005, torque_noise=0.015,
    )


def test_a_model_brings_its_effect_and_its_nearest_rival(
    tmp_path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, out = tmp_path / 'model.json', tmp_path / 'schedule.yaml'
    save_models({'roll': model_with_rival(0.3)}, model)
    told = main(['design-excitation', '--separate', '--model', str(model), '--seconds', '20',
                 '--out', str(out)])
    printed = capsys.readouterr().out
    assert told == 0
    assert 'coulomb_friction (torque 0.12 rad/s²)' in printed
    assert 'quadratic_drag (coefficient' in printed
    assert parse_schedule(yaml.safe_load(out.read_text()), 'x').parts


@pytest.mark.parametrize(
    ('arguments', 'words_in'),
    [
        (['--separate', 'stickiness', 'nothing'], 'unknown effect'),
        (['--separate', 'coulomb_friction'], 'needs two effects or none'),
        (['--separate', 'mode', 'mode'], 'two different effects'),
        (['--separate'], 'without effects needs --model'),
        (['--separate', 'mode', 'nothing', '--seconds', '1'], 'must be from 10'),
        (['--separate', 'mode', 'nothing', '--model', 'absent.json'], 'cannot be read'),
    ],
)
def test_what_cannot_be_designed_is_said_in_one_line(
    arguments: list[str], words_in: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(['design-excitation', *arguments]) == 2
    said = capsys.readouterr().err
    assert words_in in said
    assert said.count('\n') == 1


def test_a_model_that_cannot_fly_or_has_no_rivals_is_refused(tmp_path) -> None:
    lonely = model_with_rival(0.0)
    with pytest.raises(NotInformativeError, match='no effect of this model has a rival'):
        rivals_of(lonely)
    backwards = replace(
        lonely, base=(Parameter('gain', -400.0, 1.0, ''), *lonely.base[1:])
    )
    save_models({'roll': backwards}, tmp_path / 'model.json')
    with pytest.raises(BadInputError, match='gain is not positive'):
        separation(('mode', 'nothing'), str(tmp_path / 'model.json'), None, 20.0)


def test_the_report_advises_the_flight_where_a_rival_is_near() -> None:
    near = list(rivalry(model_with_rival(0.3)))
    assert len(near) == 1
    assert '--separate coulomb_friction quadratic_drag --axis roll' in near[0]
    assert list(rivalry(model_with_rival(0.05))) == []
    assert list(rivalry(None)) == []


# --------------------------------------------------------------------------------- it works


def discovered(parts: list[Part], seed: int) -> float:
    """Probability of the true spring after a flight of the virtual aircraft; 0: not found."""
    profile = load_profile('plain')
    spring = replace(
        profile.effects.pendulum_stiffness, enabled=True, stiffness_nm_rad=(0.18 * INERTIA,) * 3
    )
    profile = replace(profile, effects=replace(profile.effects, pendulum_stiffness=spring))
    pieces = [
        np.array([p.at(k / RATE_HZ) for k in range(round(p.duration_s * RATE_HZ))]) for p in parts
    ]
    samples = np.concatenate(pieces)
    seconds = samples.size / RATE_HZ
    f = fly_virtual(profile, [Excited(1.0, samples)], seconds + 1.0, seed)
    record = Record(
        'flight', f.dt, f.rates, control_from_motors(f.motors), angles=f.angles, motors=f.motors,
        battery_v=f.battery_v, gains=(GainChange(0.0, f.gains),),
        segments=(Segment('train', 'prbs', 'roll', 'attitude', 1.0, seconds + 1.0),),
    )
    springs = tuple(e for e in EFFECTS if e.name in ('pendulum_stiffness', 'cubic_stiffness'))
    found = discover(axis_data([record], 'roll'), springs, np.random.default_rng(0))
    return dict(found.rivals.get('pendulum_stiffness', ())).get('pendulum_stiffness', 0.0)


def test_flown_for_real_the_right_one_is_surer_than_with_the_plain_prbs(
    springs: Separation,
) -> None:
    schedule = parse_schedule(yaml.safe_load(words.schedule(springs)), 'schedule')
    best = [part for part in schedule.parts if part.role == 'train']
    plain = [replace(springs.plain.excitation.part, duration_s=40.0)]
    seeds = (0, 2)
    surer = [discovered(best, seed) for seed in seeds]
    before = [discovered(plain, seed) for seed in seeds]
    assert min(surer) > 0.95
    assert np.mean(before) < np.mean(surer) - 0.1
