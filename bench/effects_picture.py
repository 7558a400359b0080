"""Pictures of bench/effects.py: who was planted and who was named, and from which strength on."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from effects_judge import Row, detection, reliability

from quad_sysid.contract import FloatArray

mpl.use('Agg')
from matplotlib import pyplot as plt


def draw(rows: Sequence[Row], folder: Path) -> None:
    """effects_matrix.png and effects_detection.png in `folder`."""
    _matrix(rows, folder / 'effects_matrix.png')
    _detection(rows, folder / 'effects_detection.png')


def _matrix(rows: Sequence[Row], path: Path) -> None:
    single = [r for r in rows if r['kind'] != 'pair']
    planted = list(dict.fromkeys(r['planted'][0] if r['planted'] else 'nothing' for r in single))
    answers = [*planted[: planted.index('nothing')]] if 'nothing' in planted else list(planted)
    others = sorted({n for r in single for n in _said(r)} - set(answers))
    answers += others
    table = np.zeros((len(planted), len(answers)))
    for r in single:
        line = planted.index(r['planted'][0] if r['planted'] else 'nothing')
        for name in _said(r):
            table[line, answers.index(name)] += 1.0
    total = [sum((r['planted'][0] if r['planted'] else 'nothing') == p for r in single)
             for p in planted]
    share = table / np.array(total)[:, None]
    figure, axes = plt.subplots(figsize=(0.34 * len(answers) + 3.2, 0.3 * len(planted) + 2.6))
    axes.imshow(share, cmap='cividis', vmin=0.0, vmax=1.0, aspect='auto')
    for i, j in zip(*np.nonzero(table), strict=True):
        colour = 'black' if share[i, j] > 0.6 else 'white'
        axes.text(j, i, f'{table[i, j]:.0f}', ha='center', va='center', color=colour, fontsize=7)
    axes.set_xticks(range(len(answers)), answers, rotation=60, ha='right', fontsize=8)
    axes.set_yticks(
        range(len(planted)), [f'{p} ({n})' for p, n in zip(planted, total, strict=True)],
        fontsize=8,
    )
    axes.set_xlabel('answered')
    axes.set_ylabel('planted (flights)')
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _said(row: Row) -> list[str]:
    return list(row['named']) or [str(row['verdict'])]


def _wilson(share: FloatArray, count: FloatArray, z: float = 1.96) -> FloatArray:
    """(2, k) how far the 95 % interval reaches below and above shares of `count` (Wilson 1927)."""
    middle = (share + z**2 / (2.0 * count)) / (1.0 + z**2 / count)
    half = z * np.sqrt(share * (1.0 - share) / count + (z / (2.0 * count)) ** 2) \
        / (1.0 + z**2 / count)
    return np.maximum([share - middle + half, middle + half - share], 0.0)


def _detection(rows: Sequence[Row], path: Path) -> None:
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 3.6))
    points = detection(rows)
    if points:
        x, y, n = (np.array(column) for column in zip(*points, strict=True))
        left.errorbar(x, y, _wilson(y, n), marker='o', color='#0072b2', capsize=3)
        left.set_xscale('log')
        left.set_xticks([1, 1.5, 2, 3, 5], ['1', '1.5', '2', '3', '5'])
        left.minorticks_off()
    left.axvline(1.5, color='0.6', linestyle=':')
    left.set_ylim(-0.05, 1.05)
    left.set_xlabel('error of the base / error of the true structure, unseen flight')
    left.set_ylabel('share with the right name and no other')
    said = reliability(rows)
    if said:
        x, y, n = (np.array(column) for column in zip(*said, strict=True))
        right.errorbar(x, y, _wilson(y, n), marker='o', color='#d55e00', capsize=3)
    right.plot([0, 1], [0, 1], color='0.6', linestyle=':')
    right.set_ylim(-0.05, 1.05)
    right.set_xlabel('probability that was said')
    right.set_ylabel('share that was planted')
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)
