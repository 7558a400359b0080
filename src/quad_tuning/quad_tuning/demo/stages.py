"""One function per stage of a flight campaign: connect, fly a schedule, identify, update gains.

Each starts the processes it needs, waits for what the topics say, and raises StageFailedError.
The order of the stages and their messages are in main.py.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from quad_sysid.excitation_settings import load_schedule
from quad_tuning.demo.observer import Observer
from quad_tuning.demo.processes import Child, Crew, StageFailedError, executable
from quad_tuning.history import changed

CONNECT_S, START_S, CLOSE_S, ACKNOWLEDGE_S, IDENTIFY_S = 40.0, 20.0, 20.0, 60.0, 600.0
"""Patience of the stages, s."""
IDENTIFICATION = 'identification: identification'
"""Its entry in the diagnostics."""
STREAM_S = 1.0
"""How long the stream must have flowed before a flight begins, in s of samples at 250 Hz."""


STALE_S = 1.5
"""Age of /imu/data that ends a flight: a simulation may stall on a busy host without danger."""


@dataclass(frozen=True)
class Aircraft:
    """Options of the virtual STM32 that is flown."""

    profile: str
    axis: str
    seed: int
    mount: str = 'rig'
    effect_module: Path | None = None
    qemu: bool = False
    """The STM32's own ELF in QEMU flies it, not the Linux build."""

    def command(self, link: Path, lockstep: Path | None = None) -> list[str | Path]:
        """The command line that starts it."""
        options = {'--profile': self.profile, '--mount': self.mount, '--axis': self.axis,
                   '--seed': self.seed, '--link': link, '--effect-module': self.effect_module,
                   '--lockstep': lockstep}
        arguments = [str(part) for option in options.items() if option[1] is not None
                     for part in option]
        return [executable('quad_bridge', 'virtual_stm32'), *arguments, *['--qemu'] * self.qemu]


@dataclass
class Campaign:
    """The processes and topics that all stages share."""

    crew: Crew
    observer: Observer
    say: Callable[[str], None]
    status: dict[str, Any] = field(default_factory=dict)
    requested_s: float = 0.0
    """Time at which the new gains were sent, s on the run's clock."""

    @property
    def folder(self) -> Path:
        """Folder of all files of the campaign."""
        return self.crew.folder

    def wait(self, stage: str, what: str, condition: Callable[[], bool], timeout_s: float) -> None:
        """Wait for a condition while all processes live, telling segments as they begin."""

        def meanwhile() -> None:
            self.crew.check(stage)
            segment = self.observer.segment
            if segment and segment != self.status.get('segment'):
                self.status['segment'] = segment
                if segment.get('signal') != 'none':
                    self.say('  {segment}: {signal} on {axis} ({injection})'.format(**segment))

        self.observer.wait_for(stage, what, condition, timeout_s, meanwhile)

    def start_node(self, stage: str, package: str, name: str, settings: Mapping[str, object], *,
                   called: str = '') -> Child:
        """Start a node; in lockstep nobody flies on until it is there."""
        self.crew.clock.hold()
        child = self.crew.start_node(package, name, settings, called=called)
        if self.crew.lockstep:
            self.wait(stage, f'node {name}', lambda: name in self.observer.nodes, CONNECT_S)
        self.crew.clock.release()
        return child


@dataclass(frozen=True)
class Flight:
    """A recorded flight and the gains that were in force."""

    bag: Path
    seconds: float
    gains: Mapping[str, float]


def connect(campaign: Campaign, aircraft: Aircraft) -> None:
    """Power the aircraft, open the port, start the logger, wait until data and gains flow."""
    link = campaign.folder / 'stm32'
    campaign.crew.start('virtual_stm32', aircraft.command(link, campaign.crew.socket))
    campaign.wait('connect', 'pseudo-terminal of the virtual STM32', link.exists, CONNECT_S)
    settings = {'port': str(link), 'state_folder': str(campaign.folder / 'aircraft')}
    campaign.start_node('connect', 'quad_bridge', 'serial_bridge', settings)
    campaign.start_node('connect', 'quad_bridge', 'bag_logger',
                        {'folder': str(campaign.folder), 'prefix': 'flight'})
    observer = campaign.observer
    observer.count_imu(on=True)
    campaign.wait('connect', '/imu/data', lambda: observer.imu_count > 250 * STREAM_S, CONNECT_S)
    observer.count_imu(on=False)
    campaign.wait('connect', '/gains/active', lambda: bool(observer.active_gains), CONNECT_S)
    # its first report: in lockstep it knows the time from then on, before it refuses to record
    statuses = observer.diagnostics
    campaign.wait('connect', 'logger', lambda: any(n.startswith('bag_logger: ') for n in statuses),
                  CONNECT_S)


def fly(campaign: Campaign, name: str, schedule: Path) -> Flight:
    """Record one flight of a schedule; the bag is complete on return."""
    observer = campaign.observer
    planned, gains = load_schedule(schedule).duration_s, dict(observer.active_gains)
    observer.call(name, '/bag_logger/start', START_S)
    began_s = campaign.crew.clock.now_s()
    observer.segment = {}
    settings = {'schedule': str(schedule), 'autostart': True, 'exit_when_done': True}
    if not campaign.crew.lockstep:
        settings['imu_stale_s'] = STALE_S
    child = campaign.start_node(name, 'quad_sysid', 'excitation', settings,
                                called=f'{name}_excitation')
    child.may_end = True
    campaign.wait(name, 'end of the schedule', lambda: child.ended, planned + START_S)
    seconds = campaign.crew.clock.now_s() - began_s
    bag = Path(observer.call(name, '/bag_logger/stop', CLOSE_S))
    return Flight(bag, seconds, gains)


def start_identification(campaign: Campaign, *, auto_update: bool, axes: Sequence[str]) -> None:
    """Start the node that waits for a complete bag and writes the report."""
    settings = {'out': str(campaign.folder / 'report'), 'auto_update': auto_update,
                'axes': list(axes), 'folder': str(campaign.folder)}
    campaign.start_node('identify', 'quad_sysid', 'identification', settings)
    # gains are sent only for a recording that it has seen begin
    campaign.wait('identify', f'diagnostics of {IDENTIFICATION}',
                  lambda: IDENTIFICATION in campaign.observer.diagnostics, CONNECT_S)


def await_report(campaign: Campaign) -> Path:
    """Wait for the answer about the bag that was just completed; path of its report.json."""
    diagnostics = campaign.observer.diagnostics
    node = IDENTIFICATION

    def state() -> str:
        return diagnostics[node][2].get('state', '') if node in diagnostics else ''

    campaign.wait('identify', 'answer', lambda: state() in {'done', 'failed'}, IDENTIFY_S)
    _, text, values = diagnostics[node]
    if state() == 'failed':
        raise StageFailedError('identify', text)
    campaign.status |= {name: values.get(name, '') for name in ('update', 'gains')}
    campaign.requested_s = campaign.crew.clock.now_s()
    return Path(values['report'])


def await_new_gains(campaign: Campaign, old: Mapping[str, float]) -> float:
    """Wait until gains were sent and the STM32 has read them back; s from sending to that."""
    observer = campaign.observer
    if not str(campaign.status.get('update')).startswith('sent'):
        raise StageFailedError('update', f'no gains were sent: {campaign.status.get("update")}')
    target = {name: float(value) for name, value in json.loads(campaign.status['gains']).items()}
    if not changed(old, target):
        raise StageFailedError('update', 'the gains that were sent are the ones already flown')
    campaign.wait('update', 'acknowledgement on /gains/active',
                  lambda: not changed(observer.active_gains, target), ACKNOWLEDGE_S)
    return max(0.0, observer.gains_time - campaign.requested_s)
