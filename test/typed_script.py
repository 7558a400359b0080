"""A user's script: `make lint` has mypy --strict read it as written against the package."""

import numpy as np

import quad_sysid as qs

u: np.ndarray = np.zeros(500)
result: qs.Result = qs.identify(u=u, y=[1.0, 2.0], dt=0.01, units={'u': 'V'}, train=0.6,
                                signals={'battery': u}, validate=slice(300, 500))
record: qs.Record = qs.from_arrays(u=u, y=u, dt=0.01, train=u > 0.0)
model: qs.Identified = result.model
rate = model.simulate(u) + model.predict(record)
fit: float = model.compare(record)
gain: float = model.parameters['gain'].value
name: str = qs.identify(record, 'roll', extra_effects=(), seconds=3.0).verdict
magnitude = qs.bode(model).magnitude + model.bode([1.0]).phase
