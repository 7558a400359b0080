"""What processes and workers of a fleet's tests do instead of an identification."""

import multiprocessing
import os
import signal
import time
from pathlib import Path

from quad_sysid.fleets.bag import look


def answer(job):
    return {'bag': job.name, 'aircraft': job.aircraft, 'status': 'answered', 'reason': '',
            'asked': job.asked, 'stamp': job.stamp, 'source': job.source, 'seconds': 0.0}


def trouble(job):
    """By the bag's name: it kills its process, hangs, ends its Dask worker once, or is worked."""
    if 'poison' in job.name:
        os._exit(7)
    if 'hung' in job.name:
        time.sleep(600.0)
    once = Path(job.out, 'once')
    if 'unlucky' in job.name and not once.exists():
        once.touch()
        os.kill(multiprocessing.parent_process().pid, signal.SIGKILL)
        time.sleep(600.0)
    return look(job) if 'flight' in job.name else answer(job)
