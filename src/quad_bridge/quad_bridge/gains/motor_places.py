"""Position and sense of rotation of each motor, by the signs with which it turns the axes. Pure.

The polarity check in flight asks it and the analysis of recordings, of which it is a part by a
link (`quad_sysid/motor_places.py`). It imports neither package.
"""

from __future__ import annotations

from collections.abc import Mapping

AXES = ('roll', 'pitch', 'yaw')
MOTORS = ('rear left', 'rear right', 'front right', 'front left')  # of the contract's motors 1..4
MIXER = ((1, 1, 1), (-1, 1, -1), (-1, -1, 1), (1, -1, -1))
"""Signs of U2, U3, U4 in the command of motors 1..4 (contract): a push of that motor alone."""


def where_motors_are(signs: Mapping[str, Mapping[str, int]]) -> tuple[dict[str, str], list[str]]:
    """Channel to what is known of it, in words, and the faults found.

    `signs` gives 1 or -1 for each of `motor_1` to `motor_4` and each axis that is known.
    """
    words, faults = {}, []
    for k, (name, wanted) in enumerate(zip(MOTORS, MIXER, strict=True), 1):
        found = signs.get(f'motor_{k}', {})
        level = [axis for axis in found if axis != 'yaw']
        fits = [
            place
            for place, row in zip(MOTORS, MIXER, strict=True)
            if all(found[axis] == row[AXES.index(axis)] for axis in level)
        ]
        here = words[f'motor_{k}'] = ' or '.join(fits) if found else 'unknown'
        bad = [axis for axis, sign in found.items() if sign != wanted[AXES.index(axis)]]
        if set(bad) & set(level):
            faults.append(f'motor_{k} drives the {here}, must be the {name}')
        elif bad:
            faults.append(f'motor_{k} turns the wrong way')
    return words, faults
