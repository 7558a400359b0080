"""Which motor stands where and turns which way, by the signs with which it turns the axes. Pure.

The polarity check in flight asks it and the analysis of recordings, of which it is a part by a
link (`quad_sysid/motor_places.py`). It imports neither package.
"""

from __future__ import annotations

from collections.abc import Mapping

AXES = ('roll', 'pitch', 'yaw')
MOTORS = ('rear left', 'rear right', 'front right', 'front left')
"""Of the contract's motors 1..4."""
MIXER = ((1, 1, 1), (-1, 1, -1), (-1, -1, 1), (1, -1, -1))
"""Signs of U2, U3, U4 in the command of motors 1..4 (contract): a push of that motor alone."""


def where_motors_are(signs: Mapping[str, Mapping[str, int]]) -> tuple[dict[str, str], list[str]]:
    """Channel to what is known of it, in words, and the faults found.

    `signs` gives 1 or -1 for each of `motor_1` to `motor_4` and each axis that is known.
    """
    words, faults = {}, []
    for k in range(4):
        name = f'motor_{k + 1}'
        found = signs.get(name, {})
        wanted = dict(zip(AXES, MIXER[k], strict=True))
        fits = [
            MOTORS[j]
            for j in range(4)
            if all(
                sign == MIXER[j][AXES.index(axis)] for axis, sign in found.items() if axis != 'yaw'
            )
        ]
        words[name] = ' or '.join(fits) if found else 'unknown'
        bad = [axis for axis, sign in found.items() if sign != wanted[axis]]
        if 'roll' in bad or 'pitch' in bad:
            faults.append(f'{name} drives the {words[name]}, must be the {MOTORS[k]}')
        elif bad:
            faults.append(f'{name} turns the wrong way')
    return words, faults
