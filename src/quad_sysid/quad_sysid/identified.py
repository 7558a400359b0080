"""The identified model of one axis as an object that runs: predictions, responses, exports.

    model = identify(u=u, y=y, dt=0.004).model
    model.simulate(u); model.compare(unseen); model.bode(); model.step(); model.to_control()

A polynomial model (blackbox.Model) has the same methods. The mathematics is imported where it is
called.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from quad_sysid.axes import EVERY
from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.model import AxisModel
from quad_sysid.record import IOData, Record
from quad_sysid.units import Units

if TYPE_CHECKING:
    import numpy.typing as npt

    from quad_sysid.blackbox import FrequencyResponse, ResidualTest
    from quad_sysid.discover.accept import Unseen
    from quad_sysid.estimate.stored import Stored
    from quad_sysid.loop.cascade import CascadeGains
    from quad_sysid.loop.simulation import LoopResponse
    from quad_sysid.model.data import AxisData
    from quad_sysid.model.effect import Effect


class Identified(AxisModel):
    """The completed model of one axis, which can be run.

    Arrays are in the units of the arrays that it was identified from (`units`), else a normalised
    command, rad/s and rad.
    """

    def simulate(self, u: npt.ArrayLike, x0: tuple[float, float] = (0.0, 0.0), *,
                 throttle: npt.ArrayLike | None = None,
                 battery_v: npt.ArrayLike | None = None) -> FloatArray:
        """(n,) rate for commands u (n,), one per cycle of `dt`, without noise and feedback.

        x0: rate and angle at the first command. Raises BadInputError for signals that do not fit;
        see pipeline.evaluate.simulate.
        """
        from quad_sysid.pipeline.evaluate import simulate

        units = self.units or Units()
        initial = x0[0] * units.per_rate, x0[1] * units.per_motion
        rate = simulate(self, units.command_of(np.asarray(u, dtype=np.float64)), initial,
                        throttle=throttle, battery_v=battery_v)
        return units.rate_in(rate)

    def predict(self, flight: Record | IOData | str | Path, horizon: float = 1) -> FloatArray:
        """(n,) predicted rate, `horizon` samples ahead; NaN where nothing is predicted.

        `math.inf`: the free run of each segment from the state a second after its start, on the
        recorded commands alone. Raises BadInputError where the flight does not suit the model.
        """
        from quad_sysid.model.data import SETTLE_S, Windows

        unseen, fitted, spans = self._filtered(flight)
        data = unseen.problem.data
        rate = np.full(data.rate.size, np.nan)
        if horizon == math.inf:
            settle = round(SETTLE_S / data.dt)
            for start, stop in spans:
                if stop - start > settle + 1:
                    windows = Windows(np.array([start + settle]), stop - start - settle)
                    inside = slice(start + settle, stop)
                    rate[inside] = data.rate[inside] + unseen.errors(fitted, windows)[0]
                    unseen.ran.clear()
        elif isinstance(horizon, int | float | np.number) and horizon >= 1 and horizon % 1 == 0:
            ahead = int(horizon) - 1
            starts = np.concatenate([np.arange(a, b - ahead) for a, b in spans])
            errors = unseen.errors(fitted, Windows(starts, ahead + 1))
            rate[starts + ahead] = data.rate[starts + ahead] + errors[:, -1]
        else:
            raise BadInputError('predict', 'horizon must be an integer >= 1 or math.inf', horizon)
        return (self.units or Units()).rate_in(rate)

    def compare(self, flight: Record | IOData | str | Path, horizon: float = math.inf) -> float:
        """Fit on a flight in per cent, 100 (1 - ||y - ŷ|| / ||y - mean y||); see `predict`."""
        from quad_sysid.blackbox import fit_percent

        measured = (self.units or Units()).rate_in(self._data_of(flight)[0].rate)
        return fit_percent(measured, self.predict(flight, horizon))

    def residuals(self, flight: Record | IOData | str | Path) -> ResidualTest:
        """Tests of the one-step errors on a flight: whiteness, and independence of the input."""
        from quad_sysid.blackbox import innovation_test

        unseen, fitted, spans = self._filtered(flight)
        data = unseen.problem.data
        z = IOData(np.nan_to_num(data.command), np.nan_to_num(data.rate), data.dt, segments=spans)
        return innovation_test(unseen.predict(fitted).innovation, z)

    def bode(self, w: npt.ArrayLike | None = None) -> FrequencyResponse:
        """Response from command to measured rate at w (m,), rad/s, in small motion, with effects.

        Its covariance is that of the base's parameters, first order. Default: 200 points up to
        the Nyquist frequency. Raises BadInputError where w is not within it.
        """
        from quad_sysid.loop.from_model import response_of

        nyquist = np.pi / self.dt
        grid = np.geomspace(0.1, 0.999 * nyquist, 200) if w is None else \
            np.atleast_1d(np.asarray(w, dtype=np.float64))
        if grid.ndim != 1 or not (np.isfinite(grid) & (grid > 0.0) & (grid <= nyquist)).all():
            raise BadInputError('bode', f'w must be (m,) within 0..{nyquist:.6g} rad/s')
        units = self.units or Units()
        scale = units.per_command / units.per_rate
        si = response_of(self, grid, EVERY[self.axis].trial.near_rest)
        return replace(si, response=scale * si.response, covariance=None
                       if si.covariance is None else scale**2 * si.covariance)

    def step(self, gains: CascadeGains | Mapping[str, float] | None = None,
             size: float = 0.2, seconds: float = 2.0) -> LoopResponse:
        """The angle's answer to a step of its reference (rad, m) in the cascade with these gains.

        `gains`: by the contract's names, such as those of a design; default: those that flew.
        Raises BadInputError where they are wrong.
        """
        from quad_sysid.loop.from_model import in_flight, loop_plant
        from quad_sysid.loop.simulation import simulate_cascade

        changed = {} if gains is None else gains
        if isinstance(changed, Mapping):
            from quad_sysid.loop.cascade import CascadeGains

            changed = CascadeGains.from_mapping({**self.active_gains, **changed}, self.axis)
        model = in_flight(self)
        reference = np.full(round(seconds / model.dt), size)
        return simulate_cascade(loop_plant(model), changed, reference, model.dt)

    def to_control(self, *, linear: bool = False) -> Any:
        """The model as a system of python-control; see exports.to_control."""
        from quad_sysid.exports import to_control

        return to_control(self, linear=linear)

    def export(self, path: str | Path, to: str = '') -> Path:
        """Write the model for python-control (`control`, .py) or MATLAB (`mat`); returns the path.

        `to` may be left out where the suffix says it. Raises BadInputError where the file exists.
        """
        from quad_sysid.exports import export

        return export({self.axis: self}, path, to)

    def to_json(self) -> str:
        """The model as text, without loss, as in model.json; own effects by their names."""
        from quad_sysid.report.model_file import tree_of_models

        return json.dumps(tree_of_models({self.axis: self}), allow_nan=False)

    @classmethod
    def from_json(cls, text: str, effects: Sequence[Effect] = ()) -> Identified:
        """A model from `to_json`, or from a model.json of one axis.

        `effects`: those of one's own that it names. Raises BadInputError naming the field.
        """
        from quad_sysid.report.model_file import models_of

        try:
            tree = json.loads(text)
        except ValueError as error:
            raise BadInputError('from_json', 'is no JSON', str(error)) from error
        models = models_of(tree, 'from_json', effects)
        if len(models) != 1:
            raise BadInputError('from_json', 'must hold one axis', ', '.join(models))
        return cls(**vars(next(iter(models.values()))))

    def _repr_html_(self) -> str:
        """HTML for a notebook: the ladder with its bars, and the parameters."""
        from quad_sysid.report.html import model_excerpt

        return model_excerpt(self, self.parameters)

    def _filtered(self, flight: Record | IOData | str | Path,
               ) -> tuple[Unseen, Stored, tuple[tuple[int, int], ...]]:
        """The flight behind the model's filter, the model, and the spans that count."""
        from quad_sysid.discover.accept import Unseen
        from quad_sysid.estimate.stored import completed
        from quad_sysid.pipeline.evaluate import check_signals, of_this_flight

        data, spans = self._data_of(flight)
        if not spans:
            raise BadInputError('flight', 'has no sample with both rate and command')
        unseen, model = Unseen(data, spans), completed(self)
        check_signals('flight', unseen, model, self.craft)
        return unseen, of_this_flight(unseen, model), spans

    def _data_of(self, flight: Record | IOData | str | Path,
                 ) -> tuple[AxisData, tuple[tuple[int, int], ...]]:
        from quad_sysid.loop.from_model import usual_signals
        from quad_sysid.model.data import axis_alone
        from quad_sysid.pipeline.evaluate import flight_of, flown_spans
        from quad_sysid.pipeline.usable import same_rate

        if isinstance(flight, str | Path):
            from quad_sysid.bags import read_bag

            flight = read_bag(flight)
        if not isinstance(flight, Record | IOData):
            raise BadInputError('flight', 'must be a Record, IOData or the path of a bag',
                                type(flight).__name__, 'make one with from_arrays(u=…, y=…, dt=…)')
        if isinstance(flight, Record):
            record, data = flight_of(self, flight)
            return data, flown_spans(record, data)
        if not same_rate(flight.dt, self.dt):
            raise BadInputError('flight', "sample rate must be the model's",
                                f'{1 / flight.dt:.6g} Hz, model {1 / self.dt:.6g} Hz')
        units = self.units or Units()
        u, y = units.command_of(np.nan_to_num(flight.u)), units.rate_of(flight.y)
        spans = tuple((int(a), int(b)) for a, b in flight.segments)
        data, usual = axis_alone(u, y, self.dt, spans, self.gyro_filter_hz), usual_signals(self)
        control = np.zeros((y.size, 4))
        control[:, 0] = usual['throttle']
        control[:, 1 + EVERY[self.axis].index] = u
        return replace(data, axis=self.axis, control=control, craft=self.craft,
                       motors=self.craft.commands(control),
                       battery_v=np.full(y.size, usual['battery'])), spans
