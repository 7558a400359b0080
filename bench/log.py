"""The log's figures in one run: rates without loss, what kills leave, how fast bags are read.

    make bench-log ARGS='--points 504 --minutes 60'

The last line is one JSON object. Parts: log_node.py, log_kills.py, log_reader.py.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
from pathlib import Path

import log_kills
import log_node
import log_reader

os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--points', type=int, default=504, help='recorders killed')
    parser.add_argument('--seconds', type=float, default=10.0, help='of load at each rate')
    parser.add_argument('--compared', type=float, default=60.0, help='s read beside rosbags')
    parser.add_argument('--minutes', type=float, default=60.0, help='of the long bag')
    parser.add_argument('--folder', default='.', help='whose disk is used')
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=given.folder) as name:
        folder = Path(name).resolve()
        # first, while this process has no threads: it forks
        points = log_kills.study(folder, given.points, 1)
        print('\n'.join(log_kills.table(points)))
        told = {
            'schema': 'quad_bridge/bench_log/1',
            'kills': log_kills.summary(points),
            'reader': log_reader.study(folder, given.minutes, given.compared),
            'node': log_node.study(folder, given.seconds),
        }
    print(json.dumps(told))


if __name__ == '__main__':
    main()
