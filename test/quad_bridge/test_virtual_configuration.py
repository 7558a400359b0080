"""Profiles from YAML: what is shipped loads, what is wrong is one line with file and key."""

import dataclasses

import pytest

from quad_bridge.virtual.airframe import Airframe
from quad_bridge.virtual.effects import Effects
from quad_bridge.virtual.errors import ConfigurationError
from quad_bridge.virtual.process import main
from quad_bridge.virtual.profile import FOLDER, Profile, load_profile, profile_names


def written(folder, **texts):
    """YAML files; the path of the last."""
    for name, text in texts.items():
        path = folder / f'{name}.yaml'
        path.write_text(f'{text}\n', encoding='utf-8')
    return path


def test_plain_is_the_default_profile_lists_every_key_and_has_no_effect_on():
    assert load_profile('plain') == Profile()
    assert Profile().effects == Effects()
    assert Profile().airframe == Airframe()
    text = (FOLDER / 'plain.yaml').read_text(encoding='utf-8')

    def keys(value):
        for field in dataclasses.fields(value):
            yield field.name
            inner = getattr(value, field.name)
            if dataclasses.is_dataclass(inner):
                yield from keys(inner)

    assert [key for key in keys(Profile()) if f'{key}:' not in text] == []


@pytest.mark.parametrize('name', profile_names())
def test_every_profile_loads(name):
    profile = load_profile(name)
    assert profile.effects.thrust_curve.enabled == name.startswith('paper')
    assert (profile.mount == 'hover') == name.endswith('hover')


@pytest.mark.parametrize(
    ('text', 'said'),
    [
        ('airframe: {motors: {lagg_s: 0.1}}', 'airframe.motors.lagg_s: unknown key'),
        ('airframe: {mass_kg: -1}', 'mass_kg must be positive'),
        ('airframe: {mounts: {rig: {bias_torque_nm: 0}}}', 'rig.damping_per_s: is missing'),
        ('receiver: {events: [{time_s: 1, channel: wing, value: 1}]}', 'channel must be one of'),
        ('firmware: {physics_steps_per_cycle: 2}', 'less than 1 kHz'),
        ('extends: nobody', 'no such profile'),
        ('firmware: {physics_steps_per_cycle: 1000}', 'must be at most 20: 1000'),
        ('firmware: {gains: {roll.rate.kq: 0}}', 'gains: unknown roll.rate.kq'),
        ('- 1', 'must be a mapping of keys'), ('a: [', 'is not YAML')],
)
def test_a_wrong_profile_is_one_line_that_names_file_and_key(tmp_path, refused, text, said):
    path = written(tmp_path, mine=text)
    error = refused(main, '--profile', path)
    assert said in error
    assert str(tmp_path) in error


def test_a_profile_extends_another_by_name_or_beside_it(tmp_path):
    path = written(
        tmp_path, base='airframe: {mass_kg: 2.0, arm_m: 0.3}',
        mine='extends: base\nairframe: {arm_m: 0.4}')
    airframe = load_profile(path).airframe
    assert (airframe.mass_kg, airframe.arm_m) == (2.0, 0.4)
    other = written(tmp_path, other='extends: paper\nmount: hover')
    assert load_profile(other).effects.thrust_curve.enabled
    circle = written(tmp_path, one='extends: two', two='extends: one')
    with pytest.raises(ConfigurationError, match='circle'):
        load_profile(circle)
    with pytest.raises(ConfigurationError, match=r'nothing.*plain'):  # the known ones are listed
        load_profile('nothing')
