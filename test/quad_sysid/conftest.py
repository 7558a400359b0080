"""Flights, bags and models that several tests of the analysis share."""

import fcntl
import hashlib
import math
import os
import pickle
from collections.abc import Callable, Iterator, Sequence
from dataclasses import astuple, replace
from pathlib import Path
from typing import Any

import pytest
from flown_axis import SHORT, Axis, fly
from threadpoolctl import threadpool_limits

from quad_sysid.bags import write_bag
from quad_sysid.effects import EFFECTS
from quad_sysid.errors import BadInputError
from quad_sysid.model import AxisModel, Designer, GainProposal
from quad_sysid.model.effect import Effect
from quad_sysid.pipeline.answer import AxisAnswer
from quad_sysid.pipeline.identify import Options, identify
from quad_sysid.record import Record


@pytest.fixture(scope='session', autouse=True)
def one_thread() -> Iterator[None]:
    """The matrices are narrow: more threads of BLAS only wait for each other."""
    with threadpool_limits(limits=1):
        yield


Identified = Callable[..., AxisAnswer]


@pytest.fixture(scope='session')
def identified(tmp_path_factory: pytest.TempPathFactory) -> Identified:
    """A function: what `identify` says of roll; made once in a run, whichever worker asks."""
    own = tmp_path_factory.getbasetemp()
    folder = own.parent if 'PYTEST_XDIST_WORKER' in os.environ else own

    def answer(
        flight: Record, effects: Sequence[Effect] = EFFECTS, designer: Designer | None = None
    ) -> AxisAnswer:
        # fields alone: a craft that was used before holds what was computed of it too
        asked = pickle.dumps((astuple(flight), [e.label for e in effects],
                              getattr(designer, '__qualname__', '')))
        file = folder / hashlib.sha256(asked).hexdigest()
        with file.with_suffix('.lock').open('w') as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not file.exists():
                options = Options(axes=('roll',), designer=designer, effects=tuple(effects))
                file.write_bytes(pickle.dumps(identify([flight], options)['roll']))
        return pickle.loads(file.read_bytes())  # noqa: S301

    return answer


@pytest.fixture(scope='session')
def plain_flight() -> Record:
    """30 s of the plain axis, 17 s of training and 11 s of validation."""
    return fly(Axis(), 11, SHORT)


@pytest.fixture(scope='session')
def plain_bag(plain_flight: Record, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same as a bag; nobody may change it."""
    return write_bag(plain_flight, tmp_path_factory.mktemp('plain') / 'flight')


@pytest.fixture(scope='session')
def plain_answer(plain_flight: Record, identified: Identified) -> AxisAnswer:
    """What `identify` says of it, asked for no effects."""
    return identified(plain_flight, ())


@pytest.fixture(scope='session')
def true_model(plain_answer: AxisAnswer) -> AxisModel:
    """A model of the plain axis with the true parameters and the noise that was found."""
    model = plain_answer.model
    truth = {'gain': 450.0, 'lag': 0.042, 'delay': 0.008, 'damping': 0.4, 'bias': 0.2}
    base = tuple(replace(p, value=truth[p.name]) for p in model.base)
    return replace(model, base=base, plain=())


@pytest.fixture(scope='session')
def study() -> Any:
    """The reference study of known_plants.py, whose loop is compiled."""
    from known_plants import reference_study

    return reference_study()


@pytest.fixture(scope='session')
def refusal() -> Callable[..., str]:
    """The one line with which a call refuses bad input."""

    def line_of(call: Callable[..., object], *arguments: object, **options: object) -> str:
        with pytest.raises(BadInputError) as caught:
            call(*arguments, **options)
        line = str(caught.value)
        assert '\n' not in line
        return line

    return line_of


@pytest.fixture(scope='session')
def rubbed_flight() -> Record:
    """The same axis with dry friction of 0.8 rad/s² in calm air."""
    rubbing = Axis(torque=lambda _t, rate, _a: -0.8 * math.tanh(rate / 0.004),
                   gyro_noise=0.004, torque_noise=0.02)
    return fly(rubbing, 1, SHORT)


@pytest.fixture(scope='session')
def rubbed_answer(rubbed_flight: Record, identified: Identified) -> AxisAnswer:
    """What `identify` says of it, with a designer that proposes always the same."""
    gains = {'roll.angle.kp': 4.0, 'roll.rate.kp': 0.12, 'roll.rate.ki': 0.0, 'roll.rate.kd': 0.0}
    figures = {'rise_time_s': 0.3, 'rise_time_s_before': 0.5}
    return identified(rubbed_flight, designer=lambda _: GainProposal(gains, figures=figures))
