"""Experiments that a log holds: what was added to which axis, and when → segments, excitation.

A reader (ardupilot.py, px4.py, betaflight.py) says what its firmware injected; here it is laid on
the record. Flights without one are stretches.py's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from quad_sysid.contract import AXES, FloatArray
from quad_sysid.imports.clock import Cycles, Stream
from quad_sysid.imports.log import Experiment
from quad_sysid.imports.stretches import MIN_DURATION_S, blocks
from quad_sysid.record import Record, Segment

PAUSE_S = 1.0
"""Time without an injection that ends an experiment."""


def apart(rows: np.ndarray, time_s: FloatArray) -> list[np.ndarray]:
    """The rows in parts, between which nothing was injected for PAUSE_S."""
    return np.split(rows, np.flatnonzero(np.diff(time_s[rows]) > PAUSE_S) + 1)


def runs_of(signal: str, injection: str, added: Stream) -> tuple[Experiment, ...]:
    """The experiments in a stream (n, 3) of what was added to each axis, zero outside them."""
    out = []
    for i, axis in enumerate(AXES):
        on = np.flatnonzero(added.values[:, i] != 0.0)
        if not on.size:
            continue
        for part in apart(on, added.time_s):
            rows = slice(part[0], part[-1] + 1)
            out.append(Experiment(axis, signal, injection, Stream(
                added.time_s[rows], added.values[rows, i : i + 1])))
    return tuple(sorted(out, key=lambda experiment: experiment.added.time_s[0]))


def with_experiments(
    record: Record, experiments: Sequence[Experiment], grid: Cycles
) -> tuple[Record, str]:
    """The record with segments and excitation, and a line that says so; '' where none is long.

    `grid` has the log's time of each sample. Each experiment is cut into blocks for training and
    validation, so that both have some of all frequencies.
    """
    excitation = np.full((record.n, len(AXES)), np.nan)
    segments: list[Segment] = []
    text = []
    for experiment in experiments:
        begin, end = map(grid.seconds, experiment.added.time_s[[0, -1]].tolist())
        begin, end = max(begin, 0.0), min(end, record.n * record.dt)
        if end - begin < MIN_DURATION_S:
            continue
        rows = slice(int(np.ceil(begin / record.dt)), int(end / record.dt))
        excitation[rows] = 0.0
        excitation[rows, AXES.index(experiment.axis)] = np.interp(
            grid.times[rows], experiment.added.time_s, experiment.added.values[:, 0])
        segments += [
            Segment(role, experiment.signal, experiment.axis, experiment.injection, begin + a,
                    begin + b, dict(experiment.parameters)) for role, a, b in blocks(end - begin)]
        text.append(f'{experiment.axis} {end - begin:.0f} s')
    if not segments:
        return record, ''
    segments.sort(key=lambda s: s.start_s)
    first = experiments[0]
    return replace(record, excitation=excitation, segments=tuple(segments)), (
        f'the log holds experiments ({first.signal}, {first.injection}): {", ".join(text)}; their '
        'segments train and validate')
