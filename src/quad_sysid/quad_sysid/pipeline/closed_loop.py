"""The completed model flown through the simulated cascade on the recorded reference."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.errors import QuadSysidError
from quad_sysid.greybox.data import AxisData
from quad_sysid.loop.cascade import CascadeGains
from quad_sysid.loop.from_model import loop_plant
from quad_sysid.loop.simulation import simulate_cascade
from quad_sysid.model import AxisModel
from quad_sysid.pipeline.answer import AxisAnswer, ClosedLoop
from quad_sysid.record import Record


def closed_loop(answer: AxisAnswer, record: Record, data: AxisData) -> ClosedLoop | None:
    """Simulated against measured rate on the validation segments; None without reference or gains.

    The simulation runs on the recorded attitude reference alone, from the start of the record.
    """
    model = answer.model
    if model is None or record.attitude_setpoint is None or record.n != data.rate.size:
        return None
    reference = record.attitude_setpoint[:, data.index]
    if f'{model.axis}.rate.kp' not in model.active_gains or not np.isfinite(reference).all():
        return None
    gains = CascadeGains.from_mapping(model.active_gains, model.axis)
    plain = replace(model, base=model.plain or model.base, effects=())
    inside = np.concatenate([np.arange(a, b) for a, b in data.validation])
    measured = data.rate[inside]

    def flown(one: AxisModel) -> FloatArray:
        simulated: FloatArray = simulate_cascade(
            loop_plant(one), gains, reference, data.dt
        ).rate[inside]
        return simulated

    try:
        before, after = flown(plain), flown(model)
    except QuadSysidError:
        return None
    if not (np.isfinite(before).all() and np.isfinite(after).all()):
        return None
    return ClosedLoop(
        time_s=inside * data.dt,
        measured=measured,
        before=before,
        after=after,
        rms_before=float(np.sqrt(np.mean((before - measured) ** 2))),
        rms_after=float(np.sqrt(np.mean((after - measured) ** 2))),
    )
