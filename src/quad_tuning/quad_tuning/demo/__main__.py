"""`python -m quad_tuning.demo`."""

from __future__ import annotations

import sys

from quad_tuning.demo.main import main

if __name__ == '__main__':
    sys.exit(main())
