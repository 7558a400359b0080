"""The link under load: virtual STM32, bridge, logger and a subscriber as processes of their own.

    make bench-link ARGS='--seconds 250=300,500=120,1000=60,excite=60,attack=60'

Per rate: cycles lost from wire to bag, CPU of each process and how long it waited for it, latency
from the last byte of a cycle's frame to the subscriber's callback, memory. Beside them, at the
same time, bare rclpy in a domain of its own: a publisher of the same five messages at the same
rate, as bytes, from objects that are used again and from new ones, and a raw subscriber.
`--inside` has the bridge log itself. The case `excite` has a running excitation, `attack` whatever
anybody may say to the bridge, with what of it was obeyed and how the aircraft moved. The last line
is one JSON object. The processes' own part is link_load_roles.py, the attacker's
link_load_attack.py.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader

os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
ROLES = str(Path(__file__).with_name('link_load_roles.py'))
ATTACK = str(Path(__file__).with_name('link_load_attack.py'))
NODE = 'from quad_bridge.start import {0}; {0}()'
CYCLE_TOPICS = (
    '/imu/data', '/motors/command', '/control/wrench', '/setpoint/attitude', '/setpoint/rates',
)  # fmt: skip
TICK_HZ = os.sysconf('SC_CLK_TCK')


def cpu_s(pid: int) -> float:
    fields = Path(f'/proc/{pid}/stat').read_text().rsplit(')', 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / TICK_HZ


def waited_s(pid: int) -> float:
    """Time, s, for which its threads were ready and others had the processor."""
    tasks = Path(f'/proc/{pid}/task').glob('*/schedstat')
    return sum(int(task.read_text().split()[1]) for task in tasks) * 1e-9


def memory_mb(pid: int) -> float:
    lines = Path(f'/proc/{pid}/status').read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith('VmRSS'))


class Processes:
    """Processes by name; SIGINT ends them in the order of their start."""

    def __init__(self) -> None:
        self.running: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, name: str, *command: str, domain: int = 0) -> None:
        environment = {**os.environ, 'ROS_DOMAIN_ID': str(1 + 2 * (os.getpid() % 100) + domain)}
        self.running[name] = subprocess.Popen(
            [sys.executable, *command], env=environment,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip

    def node(self, name: str, settings: dict[str, object]) -> None:
        given = [word for key, value in settings.items() for word in ('-p', f'{key}:={value}')]
        self.start(name, '-c', NODE.format(name), '--ros-args', *given)

    def end(self, *names: str) -> None:
        for name in names:
            process = self.running.pop(name, None)
            if process is None:
                continue
            process.send_signal(signal.SIGINT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(timeout=15.0)
            process.kill()
            process.wait()

    def measure(self, seconds: float) -> dict[str, dict[str, float]]:
        """CPU in % of a core, waiting for one, memory after a fifth of the time and at its end."""
        pids = {name: process.pid for name, process in self.running.items()}
        before, began_s = {n: cpu_s(p) for n, p in pids.items()}, time.monotonic()
        waited = {n: waited_s(p) for n, p in pids.items()}
        time.sleep(0.2 * seconds)
        early = {n: memory_mb(p) for n, p in pids.items()}
        time.sleep(0.8 * seconds)
        passed_s = time.monotonic() - began_s
        return {
            name: {
                'cpu_percent': round(100.0 * (cpu_s(pid) - before[name]) / passed_s, 1),
                'waited_percent': round(100.0 * (waited_s(pid) - waited[name]) / passed_s, 1),
                'memory_mb': round(memory_mb(pid), 1),
                'grown_mb': round(memory_mb(pid) - early[name], 1),
            }
            for name, pid in pids.items()
        }


def wait_for(folder: Path, pattern: str, least_bytes: int = 0, seconds: float = 180.0) -> None:
    deadline = time.monotonic() + seconds
    while not any(path.lstat().st_size >= least_bytes for path in folder.glob(pattern)):
        if time.monotonic() > deadline:
            raise TimeoutError(f'{folder}/{pattern}: has not appeared in {seconds:g} s')
        time.sleep(0.2)


def quantiles(values: np.ndarray) -> dict[str, float]:
    return {
        'median_ms': round(float(np.median(values)), 3),
        'p99_ms': round(float(np.percentile(values, 99)), 3),
        'max_ms': round(float(values.max()), 3),
    }


def latency(folder: Path, rate: float) -> dict[str, float]:
    """Quantiles of the time from the write of a cycle's last byte to the callback, ms."""
    wire, ears = np.load(folder / 'wire.npy'), np.load(folder / 'ears.npy')
    # cycle k begins k periods after the start; the one written soonest tells when that was
    start_ns = int((wire - np.arange(len(wire)) * (1e9 / rate)).min())
    number = np.rint((ears[:, 0] - start_ns) * 1e-9 * rate).astype(int)
    inside = (number >= 0) & (number < len(wire))
    found = 1e-6 * (ears[inside, 1] - wire[number[inside]])
    return quantiles(found)


def lost(folder: Path, rate: float) -> dict[str, Any]:
    """Cycles missing in the bag between its first and last, worst of the five topics."""
    (bag,) = folder.glob('flight_*')
    with AnyReader([bag]) as reader:
        missing, cycles = 0, 0
        for topic in CYCLE_TOPICS:
            wanted = [c for c in reader.connections if c.topic == topic]
            stamps = []
            for connection, _, raw in reader.messages(wanted):
                message: Any = reader.deserialize(raw, connection.msgtype)
                stamp = message.header.stamp
                stamps.append(stamp.sec + 1e-9 * stamp.nanosec)
            number = np.rint((np.array(stamps) - stamps[0]) * rate).astype(int)
            missing = max(missing, int(number[-1]) + 1 - len(set(number.tolist())))
            cycles = max(cycles, len(stamps))
        told = said(reader)
    return {'cycles_in_bag': cycles, 'lost': missing, 'said': told}


def attacked(folder: Path) -> dict[str, Any]:
    """Answers to the attacker, final gains and excitation, and the largest rates, rad/s."""
    (bag,) = folder.glob('flight_*')
    with AnyReader([bag]) as reader:
        wanted = [c for c in reader.connections if c.topic in {'/imu/data', '/gains/active',
                                                               '/excitation/applied'}]  # fmt: skip
        heard: dict[str, list[Any]] = {connection.topic: [] for connection in wanted}
        for connection, _, raw in reader.messages(wanted):
            heard[connection.topic].append(reader.deserialize(raw, connection.msgtype))
    imu, calm = heard['/imu/data'], 5 * 250  # cycles; the attacker begins ten seconds after it
    rates = np.array([(m.angular_velocity.x, m.angular_velocity.y) for m in imu])
    sets = {str([(p.name, p.value.double_value) for p in m.changed_parameters])
            for m in heard.get('/gains/active', [])}  # fmt: skip
    return {
        **json.loads((folder / 'attack.json').read_text()), 'sets_of_gains': len(sets),
        'excited_cycles': len(heard.get('/excitation/applied', [])),
        'rms_before': round(float(np.sqrt((rates[:calm] ** 2).mean())), 4),
        'rms_attacked': round(float(np.sqrt((rates[4 * calm :] ** 2).mean())), 4),
    }  # fmt: skip


def said(reader: AnyReader) -> dict[str, str]:
    """The last counts of the nodes' losses in /diagnostics."""
    wanted = {
        'lost cycles', 'cycles held back', 'dropped writes', 'messages lost (middleware)',
        'messages dropped (disk)', 'restarts', 'bad CRC', 'round trips dropped',
    }  # fmt: skip
    found = {}
    connections = [c for c in reader.connections if c.topic == '/diagnostics']
    for connection, _, raw in reader.messages(connections):
        message: Any = reader.deserialize(raw, connection.msgtype)
        for status in message.status:
            found |= {v.key: v.value for v in status.values if v.key in wanted}
    return found


def link(rate: float, seconds: float, folder: Path, *, beside: str, inside: bool) -> Any:
    """The suite in one domain, bare rclpy in another, at once; `beside`: one more process."""
    run, bare = Processes(), folder / 'bare'
    bare.mkdir()
    logger = {'folder': folder, 'autostart': 'true', 'reserve_mb': 0}
    bridge = {'port': folder / 'tty', 'state_folder': folder / 'state'}
    if inside:
        bridge |= {'log': 'inside', **{f'bag_logger.{name}': x for name, x in logger.items()}}
    try:
        run.start('stm32', ROLES, 'stm32', str(folder), str(rate))
        run.start('bare', ROLES, 'bare', str(bare), str(rate), domain=1)
        wait_for(folder, 'tty')
        run.node('serial_bridge', bridge)
        if not inside:
            run.node('bag_logger', logger)
        run.start('ears', ROLES, 'ears', str(folder))
        run.start('raw', ROLES, 'raw', str(bare), domain=1)
        run.start('bare ears', ROLES, 'ears', str(bare), domain=1)
        if beside == 'attacker':
            run.start(beside, ATTACK, str(folder))
        elif beside:
            run.start(beside, ROLES, beside, str(folder))
        wait_for(folder, 'flight_*/*.mcap', least_bytes=1_000_000)
        figures = run.measure(seconds)
    finally:
        run.end(beside, 'bag_logger', 'ears', 'serial_bridge', 'stm32')
        run.end('raw', 'bare ears', 'bare')
    heard, wire = np.load(bare / 'ears.npy'), np.load(folder / 'wire.npy')
    sent_hz = 1e9 * (len(wire) - 1) / float(wire[-1] - wire[0])
    return {
        **({'attack': attacked(folder)} if beside == 'attacker' else {}),
        'processes': figures, **lost(folder, rate), 'latency': latency(folder, rate),
        'bare': quantiles(1e-6 * (heard[:, 1] - heard[:, 0])),
        'bare_us': json.loads((bare / 'bare.json').read_text()),
        'bridge_us': round(1e4 * figures['serial_bridge']['cpu_percent'] / sent_hz, 1),
        'sent_hz': round(sent_hz, 1),
        'raw_heard': int((bare / 'raw.count').read_text()),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seconds', default='250=300,500=120,1000=60,excite=60,attack=60')
    parser.add_argument('--inside', action='store_true', help='the bridge logs itself')
    given = parser.parse_args()
    told: dict[str, Any] = {'schema': 'quad_bridge/link_load/3', 'cores': os.cpu_count()}
    print('case      cycles  lost  bridge, µs   bytes  reused    anew  to reused  to anew'
          '  logger %  raw %  ratio   median  p99 ms   bare  p99')  # fmt: skip
    for part in given.seconds.split(','):
        name, _, seconds = part.partition('=')
        beside = {'excite': 'exciter', 'attack': 'attacker'}.get(name, '')
        rate = 250.0 if beside else float(name)
        load = os.getloadavg()[0]
        with tempfile.TemporaryDirectory() as place:
            found = link(rate, float(seconds), Path(place), beside=beside, inside=given.inside)
        late, bared = found['latency'], found['bare']
        cpu = {n: figures['cpu_percent'] for n, figures in found['processes'].items()}
        logger = cpu.get('bag_logger', 0.0)
        ours, others = found['bridge_us'], found['bare_us']
        print(
            f'{name:8} {found["cycles_in_bag"]:7d} {found["lost"]:5d} {ours:11.0f}'
            f' {others["bytes"]:7.0f} {others["reused"]:7.0f} {others["anew"]:7.0f}'
            f' {ours / others["reused"]:10.2f} {ours / others["anew"]:8.2f} {logger:9.1f}'
            f' {cpu["raw"]:6.1f} {logger / cpu["raw"]:6.2f} {late["median_ms"]:8.2f}'
            f' {late["p99_ms"]:7.2f} {bared["median_ms"]:6.2f} {bared["p99_ms"]:4.1f}',
            flush=True,
        )
        told[name] = {**found, 'load_before': load}
    print(json.dumps(told))


if __name__ == '__main__':
    main()
