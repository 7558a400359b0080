"""Crafts of any number of motors through bag and identification; motors known by their speeds."""

import math
from dataclasses import replace

import numpy as np
import pytest
from flown_craft import DT, Airframe, fly

from quad_sysid.bags import read_bag, write_bag
from quad_sysid.craft import Craft, Motor
from quad_sysid.effects import EFFECTS
from quad_sysid.inspection.content import content
from quad_sysid.pipeline.evaluate import evaluate
from quad_sysid.pipeline.identify import Options, identify
from quad_sysid.record import Record, Segment
from quad_sysid.report.model_file import load_models, save_models
from quad_sysid.rotors import rotors_of

pytestmark = pytest.mark.usefixtures('quick')
HEXA = Airframe(((90, -1), (-90, 1), (-30, -1), (150, 1), (30, 1), (-150, -1)),
                lags_s={3: 0.16})
"""Its fourth motor, rear right, is slow."""
OCTO = Airframe(((45, 1), (-45, -1), (-135, 1), (135, -1), (-45, 1), (45, -1), (135, 1),
                 (-135, -1)), lag_s=0.06, push=(400.0, 300.0, 60.0), damping=(9.0, 9.0, 2.0),
                squared=True, torque_noise=0.6)
"""Coaxial pairs; thrust follows the square of the speed, and much damping hides behind the lag."""
QUAD = Airframe(((135, -1), (45, 1), (-135, 1), (-45, -1)), lag_s=0.03, reaction_s=0.12)
"""Betaflight's order, propellers in, whose rotors' own reaction leads the yaw."""
SEGMENTS = tuple(Segment(role, 'prbs', axis, 'rate', start, end)
                 for role, start, end in (('train', 1.0, 12.0), ('validation', 12.5, 20.0))
                 for axis in ('roll', 'yaw'))


def described(airframe: Airframe) -> Craft:
    """The airframe as its own builder would describe it, arms of 0.25 m."""
    return Craft('its builder', tuple(
        Motor(0.25 * math.cos(math.radians(a)), -0.25 * math.sin(math.radians(a)), spin)
        for a, spin in airframe.motors))


def recorded(airframe: Airframe, seed: int, *, speeds: bool = False) -> Record:
    flown, craft = fly(airframe, seed, 20.0), described(airframe)
    return Record('a flight', DT, flown['rates'], craft.control(flown['motors']),
                  motors=flown['motors'], speeds=flown['speeds'] if speeds else None,
                  craft=craft, segments=SEGMENTS, t0_ns=10**18)


@pytest.fixture(scope='module')
def hexa() -> Record:
    return recorded(HEXA, 3)


def model_of(record: Record, *names: str, axis: str = 'roll'):
    few = tuple(effect for effect in EFFECTS if {effect.name, effect.label} & {*names})
    return identify([record], Options(axes=(axis,), effects=few))[axis].model


def test_a_hexacopter_with_a_slow_motor_is_a_bag_like_any_other(hexa, tmp_path, refusal):
    record = read_bag(write_bag(hexa, tmp_path / 'hexa'))
    assert (record.craft.count, record.motors.shape[1], record.warnings) == (6, 6, ())
    model = model_of(record, 'motor_lag')
    assert [(e.name, e.variant) for e in model.effects] == [('motor_lag', 'motor 4')]
    assert model.value('gain') == pytest.approx(400.0, rel=0.03)
    assert model.value('lag') == pytest.approx(0.04, rel=0.06)
    assert model.value('motor_lag.slow_time_constant') == pytest.approx(0.16, rel=0.1)
    save_models({'roll': model}, tmp_path / 'model.json')
    stored = load_models(tmp_path / 'model.json')['roll']
    assert stored.craft.signs == record.craft.signs
    assert evaluate(stored, record, ((12.5, 20.0),)).after < 0.03
    fewer = replace(record.craft, motors=record.craft.motors[:4])
    other = replace(record, craft=fewer, motors=record.motors[:, :4])
    assert 'motor_lag of the model needs the motors of its craft' in refusal(
        evaluate, stored, other)


def test_an_octocopters_lag_comes_from_its_rotors_and_leaves_the_damping_to_the_rate(tmp_path):
    record = read_bag(write_bag(recorded(OCTO, 5, speeds=True), tmp_path / 'octo'))
    np.testing.assert_allclose(record.control, described(OCTO).control(record.motors))
    told, alone = (model_of(one) for one in (record, replace(record, speeds=None)))
    assert told.value('lag') == pytest.approx(0.06, rel=0.05)
    assert told.value('damping') == pytest.approx(9.0, rel=0.12)
    (damping,), (wide,) = ([p.std for p in m.base if p.name == 'damping'] for m in (told, alone))
    assert damping < wide


def test_yaw_shows_the_lead_of_heavy_rotors():
    """It draws the base so far away that no small step leads from there to the truth."""
    model = model_of(recorded(QUAD, 2), 'mode:rotor_lead', 'mode:lead', 'motor_lag',
                     axis='yaw')
    assert [e.name for e in model.effects] == ['mode:rotor_lead']
    for name, true in (('gain', 60.0), ('lag', 0.03), ('damping', 0.5),
                       ('mode:rotor_lead.lead_time', 0.12)):
        assert model.value(name) == pytest.approx(true, rel=0.15 if name == 'damping' else 0.05)


def test_a_lead_shorter_than_the_lag_is_not_called_a_slow_motor():
    """It acts as if a share of the motors had no lag, which is the less probable cause."""
    record = recorded(replace(QUAD, lag_s=0.05, reaction_s=0.03), 2)
    model = model_of(record, 'mode:rotor_lead', 'motor_lag', axis='yaw')
    assert [e.name for e in model.effects] == ['mode:rotor_lead']
    assert model.effects[0].probability > 0.9


def test_a_motor_that_stops_slips_or_lags_is_named(tmp_path):
    flown = recorded(replace(HEXA, stops=(1, 12.0, 12.3)), 4, speeds=True)
    speeds = flown.speeds.copy()
    speeds[2000:2200, 4] *= 0.6  # from 8 s on, for 0.8 s
    speeds[:, 0] *= 0.85
    held = content(write_bag(replace(flown, speeds=speeds), tmp_path / 'hexa'))
    assert 'motor_4 rear right counter-clockwise' in held.craft
    text = '; '.join(held.rotors)
    for words in ('with a lag of 40 ms', 'motor_4 lags: it answers with 16', 'the others with 40',
                  'motor_2 stands still for 0.', 's from 12.', 'motor_5 slips for 0.',
                  's from 8.0 s', 'motor_1 turns 15 % slower'):
        assert words in text, text
    assert text.count('motor_') == 4
    assert rotors_of(replace(flown, speeds=None)).lines == ()


def test_a_description_says_where_motors_are_or_is_left_aside(hexa, tmp_path, refusal):
    four = Craft('four', hexa.craft.motors[:4])
    bag = write_bag(replace(hexa, craft=four), tmp_path / 'too few')
    assert '/motors/command is of 6 motors, /robot_description is of 4' in refusal(read_bag, bag)
    shown = write_bag(replace(hexa, motors=None, wrench=hexa.control), tmp_path / 'wrench')
    clipped = read_bag(shown)
    np.testing.assert_allclose(
        clipped.control, hexa.craft.control(hexa.craft.commands(hexa.control)), atol=1e-12)
    unknown = replace(hexa, motors=None, wrench=3.0 * hexa.control, desaturation='none')
    raw = read_bag(write_bag(unknown, tmp_path / 'none'))
    np.testing.assert_array_equal(raw.control, unknown.wrench)
    assert (raw.motors, raw.desaturation) == (None, 'none')
    assert 'as it was commanded' in ' '.join(raw.warnings)
