"""What modules of all folders share: the type of arrays of numbers, and gravity. Nothing else."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
GRAVITY_M_S2 = 9.80665
