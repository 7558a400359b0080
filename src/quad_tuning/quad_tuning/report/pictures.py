"""Bode, Nyquist and step of a gain design, before and after, with the band over the ensemble.

Each picture shows the nominal loop as a line and all loops of the ensemble as a band. assess.py
has the figures as numbers.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.loop.cascade import CascadeGains, open_loop, reference_response
from quad_sysid.loop.from_model import loop_plant
from quad_sysid.loop.plant import ComplexArray
from quad_sysid.loop.simulation import simulate_cascade
from quad_sysid.model import AxisModel
from quad_tuning import ensemble as ensembles
from quad_tuning.assess import SQUARE_AMPLITUDE_RAD, reference_square
from quad_tuning.designer import SEED
from quad_tuning.ensemble import Ensemble
from quad_tuning.objective import Requirements

BEFORE, AFTER = '#b5651d', '#1f5fa8'
BAND = 0.18
STEP_DRAWS = 40
"""Drawn models whose step is simulated for the band."""
STEP_S = 1.6
NYQUIST_REACH = 3.0

Sets = tuple[tuple[str, CascadeGains, str], ...]


def write_pictures(model: AxisModel, wanted: CascadeGains, folder: Path) -> tuple[Path, ...]:
    """`<axis>_bode.png`, `_nyquist.png` and `_step.png` in `folder`; BadInputError if it fails."""
    loops = ensembles.build(model, np.random.default_rng(SEED))
    active = CascadeGains.from_mapping(model.active_gains, model.axis)
    sets: Sets = (('flown gains', active, BEFORE), ('new gains', wanted, AFTER))
    figures = {'bode': _bode(sets, loops), 'nyquist': _nyquist(sets, loops),
               'step': _step(sets, model)}
    paths = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, figure in figures.items():
            path = folder / f'{model.axis}_{name}.png'
            FigureCanvasAgg(figure)
            figure.savefig(path, dpi=110)
            paths.append(path)
    except OSError as error:
        raise BadInputError(str(folder), 'cannot be written', error.strerror) from error
    return tuple(paths)


def _bode(sets: Sets, loops: Ensemble) -> Figure:
    figure = Figure(figsize=(7.5, 6.5), layout='constrained')
    gain, phase, closed = figure.subplots(3, 1, sharex=True)
    omega, dt = loops.omega, loops.cycle.dt
    for name, gains, colour in sets:
        loop = open_loop(gains, loops.response, omega, dt)
        whole = reference_response(gains, loops.response, omega, dt)
        angle = np.degrees(np.unwrap(np.angle(loop), axis=-1))
        angle -= 360.0 * np.rint((angle[:, :1] + 180.0) / 360.0)
        _band(gain, omega, _decibel(loop), loops.nominal, colour, name)
        _band(phase, omega, angle, loops.nominal, colour, name)
        _band(closed, omega, _decibel(whole), loops.nominal, colour, name)
    gain.axhline(0.0, color='0.4', lw=0.8)
    phase.axhline(-180.0, color='0.4', lw=0.8)
    phase.set_ylim(-360.0, 0.0)
    gain.set_ylim(-60.0, 60.0)
    closed.set_ylim(-60.0, 12.0)
    for axes, label in ((gain, 'loop gain, dB'), (phase, 'loop phase, deg'),
                        (closed, 'angle / reference, dB')):
        axes.set(xscale='log', ylabel=label)
        axes.grid(which='both', color='0.9')
    closed.set_xlabel('frequency, rad/s')
    gain.legend(frameon=False)
    return figure


def _nyquist(sets: Sets, loops: Ensemble) -> Figure:
    figure = Figure(figsize=(6.0, 6.0), layout='constrained')
    axes = figure.subplots()
    for name, gains, colour in sets:
        loop = open_loop(gains, loops.response, loops.omega, loops.cycle.dt)
        for row in loop[:: max(1, loop.shape[0] // 60)]:
            axes.plot(row.real, row.imag, color=colour, lw=0.5, alpha=BAND)
        row = loop[int(np.flatnonzero(loops.nominal)[0])]
        axes.plot(row.real, row.imag, color=colour, lw=1.6, label=name)
    turn = np.linspace(0.0, 2.0 * np.pi, 200)
    radius = 1.0 / Requirements().peak_sensitivity
    axes.plot(-1.0 + radius * np.cos(turn), radius * np.sin(turn), color='0.3', lw=1.0, ls='--',
              label=f'sensitivity {Requirements().peak_sensitivity}')
    axes.plot(np.cos(turn), np.sin(turn), color='0.8', lw=0.8)
    axes.plot([-1.0], [0.0], '+', color='0.1', ms=10)
    axes.set(xlim=(-NYQUIST_REACH, 1.2), ylim=(-NYQUIST_REACH, 1.2), aspect='equal',
             xlabel='real part of the loop gain', ylabel='imaginary part')
    axes.grid(color='0.9')
    axes.legend(frameon=False, loc='lower right')
    return figure


def _step(sets: Sets, model: AxisModel) -> Figure:
    figure = Figure(figsize=(7.5, 5.5), layout='constrained')
    angle, command = figure.subplots(2, 1, sharex=True)
    reference = reference_square(model.dt)
    start = int(np.argmax(reference > 0.0))
    lead, n = round(0.1 / model.dt), round(STEP_S / model.dt)
    rows = slice(start - lead, start + n)
    time_s = np.asarray((np.arange(lead + n) - lead) * model.dt, dtype=np.float64)
    drawn = ensembles.draw_models(model, np.random.default_rng(SEED), STEP_DRAWS)
    for name, gains, colour in sets:
        runs = [
            simulate_cascade(loop_plant(one), gains, reference, model.dt,
                             initial_angle=-float(SQUARE_AMPLITUDE_RAD))
            for one in (model, *drawn)
        ]
        first = np.arange(len(runs)) == 0
        angles = np.degrees(np.stack([run.angle[rows] for run in runs]))
        _band(angle, time_s, angles, first, colour, name)
        controls = np.stack([run.control[rows] for run in runs])
        _band(command, time_s, controls, first, colour, name)
    angle.plot(time_s, np.degrees(reference[rows]), color='0.3', lw=0.9, ls='--')
    angle.set_ylabel('angle, deg')
    command.set(ylabel='command, norm.', xlabel='time since the step, s')
    for axes in (angle, command):
        axes.grid(color='0.9')
    angle.legend(frameon=False, loc='lower right')
    return figure


def _band(axes: Axes, x: FloatArray, y: FloatArray, nominal: npt.NDArray[np.bool_], colour: str,
          name: str) -> None:
    """The nominal row of y (p, n) as a line, all rows as a band."""
    axes.fill_between(x, y.min(axis=0), y.max(axis=0), color=colour, alpha=BAND, lw=0)
    axes.plot(x, y[int(np.flatnonzero(nominal)[0])], color=colour, lw=1.5, label=name)


def _decibel(response: ComplexArray) -> FloatArray:
    return np.asarray(20.0 * np.log10(np.maximum(np.abs(response), 1e-9)))
