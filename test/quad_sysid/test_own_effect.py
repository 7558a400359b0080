"""An effect that the package has never heard of, handed to `identify`: it goes all the way."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from flown_axis import SHORT, UNSEEN, Axis, fly

import quad_sysid as qs
from quad_sysid.loop.from_model import loop_plant
from quad_sysid.loop.plant import slopes_at


class Cogging(qs.Effect):
    """The magnets of a gimbal motor: a torque that goes round twelve times in a turn."""

    name = 'cogging'
    signals = ('angle',)
    parameters = (qs.Spec('torque', 'rad/s²'),)
    physics = '-T sin(12 angle): cogging of a motor on the axis'
    excite = 'slow square waves over several teeth'

    def torque(self, s, p, settings):
        del settings
        return -p[0] * np.sin(12.0 * s.angle)


pytestmark = pytest.mark.xdist_group('own effect')
TRUTH = 4.0
AXIS = Axis(torque=lambda _t, _rate, angle: -TRUTH * math.sin(12.0 * angle))
OWN = (*qs.EFFECTS, Cogging())


@pytest.fixture(scope='module')
def result():
    return qs.identify(fly(AXIS, 5, SHORT), axes='roll', effects=OWN)


def test_it_is_fitted_chosen_and_reported(result):
    assert [effect.name for effect in result.effects] == ['cogging']
    torque = result.effects[0].parameters[0]
    assert abs(torque.value - TRUTH) < 4.0 * torque.std
    assert result.errors['after'] < 0.5 * result.errors['before']
    assert 'cogging' in str(result)
    assert 'cogging' in result._repr_html_()
    assert result.plot('effect_shape').axes


def test_it_is_stored_read_back_simulated_and_judged(result, tmp_path):
    """A reader who does not hand it in is told so; one who does has the same model."""
    folder = result.save(tmp_path / 'out', pictures=False).folder
    assert 'cogging' in (folder / 'report.html').read_text()
    again = qs.read_model(folder, effects=OWN)
    u = 0.01 * np.sign(np.sin(np.arange(1500) * 0.02))
    np.testing.assert_allclose(again.simulate(u), result.model.simulate(u), rtol=1e-12)
    assert np.abs(again.simulate(u) - replace(again, effects=()).simulate(u)).max() > 0.1
    unseen = qs.evaluate(again, fly(AXIS, 6, UNSEEN))
    assert unseen.after < 0.6 * unseen.before
    with pytest.raises(qs.BadInputError, match='effects='):
        qs.read_model(folder).simulate(u)


def test_it_is_linearised_designed_for_and_separated(result):
    """In small motion a spring of 12 T; gains and the flight that tells it from a spring."""
    slope = slopes_at(loop_plant(result.model), 1e-3, 1e-3, 1e-3).angle
    assert slope == pytest.approx(-12.0 * TRUTH, rel=0.05)
    assert result.gains['roll.rate.kp'] > 0.0
    found = qs.separate(result.model, ('cogging', 'pendulum_stiffness'), 10.0)
    assert found.best.worst.nats > 0.0
    assert qs.separate('roll', ('cogging', 'nothing'), 10.0, effects=OWN).rows
