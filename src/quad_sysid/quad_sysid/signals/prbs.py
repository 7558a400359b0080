"""Pseudo-random binary sequences from a shift register.

A register of n bits with a primitive feedback polynomial runs through all its 2^n - 1 non-zero
states, so one level occurs 2^(n-1) times and the other once less, and the periodic autocorrelation
of the ±1 sequence is N at shift 0 and -1 elsewhere. Source: Golomb, Shift Register Sequences;
paper, section 4 (N = 2^n - 1).
"""

from __future__ import annotations

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError

TAPS: dict[int, tuple[int, ...]] = {
    2: (2, 1), 3: (3, 2), 4: (4, 3), 5: (5, 3), 6: (6, 5), 7: (7, 6), 8: (8, 6, 5, 4),
    9: (9, 5), 10: (10, 7), 11: (11, 9), 12: (12, 6, 4, 1), 13: (13, 4, 3, 1),
    14: (14, 5, 3, 1), 15: (15, 14),
}
"""Stages whose sum is fed back; primitive polynomials over GF(2)."""


def prbs_bits(register_bits: int, seed: int = 1) -> FloatArray:
    """One period (2^n - 1,) of ±1; `seed` picks the register's first state, the rest follows.

    Sequences of one register with other seeds are shifts of each other; take another number of
    bits where two records must not repeat. Raises BadInputError outside 2..15 bits.
    """
    if register_bits not in TAPS:
        raise BadInputError(
            'prbs', 'register_bits must be a whole number from 2 to 15', register_bits
        )
    length = 2**register_bits - 1
    state = (seed * 2_654_435_761) % length + 1
    taps = [stage - 1 for stage in TAPS[register_bits]]
    out = np.empty(length)
    for i in range(length):
        out[i] = 1.0 if state >> (register_bits - 1) & 1 else -1.0
        feedback = 0
        for tap in taps:
            feedback ^= state >> tap & 1
        state = (state << 1 | feedback) & length
    return out


def prbs(
    register_bits: int, clock_samples: int, amplitude: float, rng: np.random.Generator | int = 1
) -> FloatArray:
    """One period ((2^n - 1) * clock_samples,) of ±amplitude, each bit held `clock_samples`.

    `rng` is a generator that draws the first state, or a seed.
    """
    if clock_samples < 1:
        raise BadInputError('prbs', 'clock_samples must be at least 1', clock_samples)
    seed = rng if isinstance(rng, int) else int(rng.integers(1, 2**31))
    return amplitude * np.repeat(prbs_bits(register_bits, seed), clock_samples)
