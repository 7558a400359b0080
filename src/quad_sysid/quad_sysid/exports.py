"""`quad-sysid export`: models as files for other tools, MATLAB .mat and python-control.

The linear plant as matrices, with held command, delay and gyro filter. Nonlinear effects are
listed by name, with parameters and units.
"""

from __future__ import annotations

import argparse
import io
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from quad_sysid.arguments import Commands, command, effects_option, own_effects
from quad_sysid.axes import EVERY
from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.files import check_new, write_whole
from quad_sysid.units import COMMAND, Units, scale

if TYPE_CHECKING:
    from quad_sysid.model import AxisModel

OUTPUTS = ('rate', 'angle')
"""Outputs: rate after the gyro filter, and angle."""


def matrices(model: AxisModel) -> dict[str, Any]:
    """A model's linear part in MATLAB's names: base, gyro filter, slow motors and modes.

    A, B, C are continuous behind `delay_s`; Ad, Bd, Cd are one control cycle of `dt_s`, with the
    delay as states. From command to measured rate and angle in the model's units, no curves.
    """
    from scipy.linalg import logm  # slow to import

    from quad_sysid.loop.from_model import loop_plant
    from quad_sysid.loop.linear import STILL, linear_part, loops_of
    from quad_sysid.model.plant import LEAST_LAG

    flying = linear_part(loop_plant(model))
    lag_s, delay_s, dt = flying.plant.p[1], flying.plant.p[2], flying.dt
    p = flying.plant.p.copy()
    p[1], p[2] = max(lag_s, LEAST_LAG * dt), 0.0
    prompt = replace(flying, plant=replace(flying.plant, p=p))
    loop, prompt_loop = loops_of([(flying, STILL)]), loops_of([(prompt, STILL)])
    n = prompt_loop.b.shape[1]
    block = np.eye(n + 1)
    block[:n, :n], block[:n, n] = prompt_loop.a[0], prompt_loop.b[0]
    rates = np.real(logm(block)) / dt
    units = model.units or Units()
    per_output = np.array([[units.per_rate], [units.per_motion]])
    return {'A': rates[:n, :n], 'B': units.per_command * rates[:n, n:],
            'C': prompt_loop.c[0] / per_output, 'delay_s': delay_s, 'Ad': loop.a[0],
            'Bd': units.per_command * loop.b[0][:, None], 'Cd': loop.c[0] / per_output, 'dt_s': dt}


def _signals(model: AxisModel) -> list[str]:
    """Command, rate and angle with their units."""
    return [scale(model.units, name, unit).label.replace(', ', ' (') + ')' for name, unit in (
        ('command', COMMAND), ('rate', 'rad/s'), ('angle', 'rad'))]


NOTE = (
    'Linear part: d(rate)/dt = gain * (command behind delay and lag) - damping * rate + bias, the '
    'measured rate behind the gyro filter where that is known. The bias and all effects that are '
    'not linear are not in the matrices.'
)


def _warning(model: AxisModel, head: str = '') -> str:
    """What whoever designs with a model must know of its data, behind a head; '' for nothing."""
    because = model.no_gains_because
    return because and f'{head}do not design gains with it: {because}'


def as_mat(models: Mapping[str, AxisModel]) -> bytes:
    """All axes as a MATLAB file of version 5: one struct per axis.

    `sys = ss(roll.A, roll.B, roll.C, 0, 'InputDelay', roll.delay_s)`, or of `roll.Ad` … with
    `roll.dt_s`.
    """
    from scipy.io import savemat

    content: dict[str, Any] = {'note': NOTE}
    for axis, model in models.items():
        content[axis] = {
            **matrices(model), 'outputs': list(OUTPUTS), 'signals': _signals(model),
            **({'warning': _warning(model)} if model.no_gains_because else {}),
            'mixer': model.craft.mixer, 'mixer_inverse': model.craft.inverse,
            'base': {p.name.replace('.', '_'): model.in_units(p).value for p in model.base},
            'effects': {e.name.replace(':', '_'): {p.name: model.in_units(p).value
                                                   for p in e.parameters} for e in model.effects},
        }
    stream = io.BytesIO()
    savemat(stream, content, oned_as='column', long_field_names=True)
    return stream.getvalue()


def as_control(models: Mapping[str, AxisModel]) -> bytes:
    """A Python file that needs numpy and control alone, and defines `axes`: name to system."""
    lines = ['"""Identified by quad-sysid; for python-control.', '', NOTE, '"""', '',
             'import control', 'import numpy as np', '', 'axes = {}']
    for axis, model in models.items():
        system, (u, rate, angle) = matrices(model), _signals(model)
        mixed = '' if model.units not in (None, EVERY['climb'].units) else (
            f'# command = {model.craft.inverse[1 + EVERY[axis].index].tolist()} @ motors')
        lines += [
            '', f'# {axis}: {u} to {rate} and {angle}, held over {system["dt_s"]:g} s,',
            f'# the delay of {system["delay_s"]:.6g} s as states',
            *filter(None, [mixed, _warning(model, '# ')]),
            *(f'# {name} = {p.value:.6g} {p.unit}' for name, p in model.parameters.items()),
            f'axes[{axis!r}] = control.ss(',
            *(f'    np.array({system[name].tolist()}),' for name in ('Ad', 'Bd', 'Cd')),
            f'    0.0, {system["dt_s"]!r},',
            f"    inputs=['command'], outputs={list(OUTPUTS)!r}, name={axis!r},", ')',
        ]
    return ('\n'.join(lines) + '\n').encode()


def to_control(model: AxisModel, *, linear: bool = False) -> Any:
    """A model as a system of python-control, a control cycle a step: command to rate and angle.

    An `nlsys` with all effects, at the flight's mean throttle and voltage, the other axes at rest;
    its states count from motors that hold the throttle, so that 0 is rest. `linear`: an `ss` of
    the plant as its margins are judged, at rest. `linearize`, `interconnect` and
    `input_output_response` take both. Signals are in the units of the model's arrays.
    """
    import control

    from quad_sysid.loop.from_model import loop_plant, whole_plant
    from quad_sysid.loop.linear import STILL, loops_of
    from quad_sysid.model.plant import flat, unflat

    units = model.units or Units()
    per_output = np.array([units.per_rate, units.per_motion])
    names: dict[str, Any] = {'inputs': ['command'], 'outputs': list(OUTPUTS), 'name': model.axis}
    if linear:
        loop = loops_of([(loop_plant(model), STILL)])
        return control.ss(loop.a[0], units.per_command * loop.b[0][:, None],
                          loop.c[0] / per_output[:, None], 0.0, model.dt, **names)
    flying = whole_plant(model)
    plant, start = flying.plant, flying.begin()
    rest = flat(start)

    def update(t: float, x: FloatArray, u: FloatArray, _: object) -> FloatArray:
        time = flying.around.time + t + 0.5 * model.dt  # its signals are those of mid-cycle
        now = replace(flying.around, time=time, sent=units.command_of(np.atleast_1d(u)))
        later = plant.step(unflat(x[:, None] + rest, start), plant.with_motors(now))
        return (flat(later) - rest)[:, 0]

    def output(_: float, x: FloatArray, __: FloatArray, ___: object) -> FloatArray:
        rate, angle = plant.measured(unflat(x[:, None] + rest, start))
        return np.asarray([rate[0], 0.0 if angle is None else angle[0]] / per_output)

    return control.nlsys(update, output, states=rest.shape[0], dt=model.dt, **names)


WRITERS: Mapping[str, tuple[Callable[[Mapping[str, AxisModel]], bytes], str]] = {
    'mat': (as_mat, '.mat'), 'control': (as_control, '.py'),
}
"""Format → its writer and the file's suffix."""


def export(models: Mapping[str, AxisModel], path: str | Path, to: str = '') -> Path:
    """Write models, by axis, in a format of WRITERS, by default that of the suffix.

    Raises BadInputError for an unknown format, and where the file exists.
    """
    place = Path(path)
    name = to or next((key for key, (_, suffix) in WRITERS.items() if suffix == place.suffix), '')
    if name not in WRITERS:
        suffixes = ' or '.join(suffix for _, suffix in WRITERS.values())
        raise BadInputError('export', 'must be to one of ' + ', '.join(WRITERS), to or str(path),
                            f'name it, or a suffix of {suffixes}')
    check_new(place)
    write_whole(place, WRITERS[name][0](models))
    return place


def add(commands: Commands) -> None:
    """Register the command."""
    parser = command(commands, 'export', _run,
                     'Write a model for python-control or MATLAB.',
                     'quad-sysid export result/model.json --to mat --out aircraft.mat',
                     writes='file')
    parser.add_argument('model', metavar='MODEL.json', type=Path,
                        help='written by quad-sysid identify, or its folder')
    parser.add_argument('--to', required=True, choices=sorted(WRITERS),
                        help='control: a Python file; mat: MATLAB')
    parser.add_argument('--axis', metavar='AXES', help='roll, pitch, yaw, surge, sway or climb, '
                        'several with commas between (default: every axis of the model)')
    parser.add_argument('--out', metavar='FILE', type=Path,
                        help='default: beside the model, with the suffix of the format')
    effects_option(parser)
    parser.add_argument('--quiet', action='store_true', help='print nothing but errors')


def _run(options: argparse.Namespace) -> int:
    from quad_sysid.report.model_file import load_models, located, pick

    model = located(options.model)
    models = pick(load_models(model, own_effects(options.effects)), options.axis, model)
    suffix = WRITERS[options.to][1]
    out = export(models, options.out or model.with_name(f'{model.stem}_export{suffix}'),
                 options.to)
    for axis, one in models.items():
        if _warning(one):
            print(_warning(one, f'quad-sysid export: {axis}: '), file=sys.stderr)
    if not options.quiet:
        print(f'{out}: {", ".join(models)}')
    return 0
