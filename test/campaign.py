"""A flight campaign in lockstep, in a process of its own; its outcome is a file of JSON.

`Turns` is for a test that leads one step by step instead.

`python campaign.py FOLDER` reads FOLDER/wanted.json and writes FOLDER/outcome.json: the bag, the
report, the gains before and after, or why it failed.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

TIMEOUT_S = 1500.0
"""A bound that no busy machine reaches; measures nothing."""


class Turns:
    """Simulated time of a crew: it stands still while a test acts, and passes while it waits.

    Between two looks little passes, so that nothing that lasts is over before the test sees it,
    however slow the test is beside the aircraft.
    """

    def __init__(self, crew: Any, probe: Any, turn_s: float = 0.4) -> None:
        self.crew, self.probe, self.turn_s = crew, probe, turn_s
        crew.clock.hold()

    def rest(self, seconds: float) -> None:
        """Let simulated time pass."""
        clock = self.crew.clock
        end_s = clock.now_s() + seconds
        clock.release()
        self.probe.until(
            lambda: self.crew.check('wait') or clock.now_s() >= end_s, 'time', pause_s=0.001
        )
        clock.hold()
        self.probe.nodes()  # it has heard what there was to hear

    def until(self, condition: Callable[[], object], what: object) -> None:
        def met() -> object:
            found = condition()
            if not found:
                self.rest(self.turn_s)
            return found

        self.probe.until(met, what)

    def call(self, service: str, *kind: str, **request: Any) -> Any:
        """Call a service; time passes where it needs some for its answer."""
        return self.answer(self.probe.ask(service, *kind, **request))

    def answer(self, answer: Any) -> Any:
        self.until(answer.done, answer.words)
        return answer.result()


def campaign(folder: Path, **wanted: Any) -> Any:
    """Connect an aircraft and fly; `schedule` (YAML), `module` (Python), `profile`, `seed`,

    `identify`, `auto_update`, `again` (a second flight's schedule) and `qemu` (the STM32's ELF,
    emulated) say how. The outcome's fields are those of `flown` below.
    """
    folder.mkdir(exist_ok=True)
    (folder / 'wanted.json').write_text(json.dumps(wanted))
    done = subprocess.run(
        [sys.executable, __file__, folder], capture_output=True, text=True, check=False,
        timeout=TIMEOUT_S,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(
        (folder / 'outcome.json').read_text(), object_hook=lambda pairs: SimpleNamespace(**pairs)
    )


def flown(folder: Path, wanted: dict[str, Any]) -> dict[str, Any]:
    from quad_tuning.demo import stages
    from quad_tuning.demo.observer import Observer
    from quad_tuning.demo.processes import Crew, StageFailedError, own_domain

    schedule, module = folder / 'schedule.yaml', folder / 'effect.py'
    schedule.write_text(wanted['schedule'])
    if 'module' in wanted:
        module.write_text(wanted['module'])
    aircraft = stages.Aircraft(
        wanted.get('profile', 'plain'), 'roll', wanted.get('seed', 1),
        effect_module=module if 'module' in wanted else None, qemu=bool(wanted.get('qemu')),
    )  # fmt: skip
    outcome: dict[str, Any] = {'failed': ''}
    with (
        own_domain() as domain,
        Crew(folder, domain, lockstep=True) as crew,
        Observer(domain, crew.clock) as observer,
    ):
        run = stages.Campaign(crew, observer, lambda _: None)
        try:
            stages.connect(run, aircraft)
            if wanted.get('identify'):
                update = bool(wanted.get('auto_update'))
                stages.start_identification(run, auto_update=update, axes=['roll'])
            flight = stages.fly(run, 'flight', schedule)
            outcome |= {'bag': str(flight.bag), 'before': list(flight.gains.items())}
            if wanted.get('identify'):
                outcome['report'] = str(stages.await_report(run))
            if wanted.get('auto_update'):
                stages.await_new_gains(run, flight.gains)
            if 'again' in wanted:
                schedule.write_text(wanted['again'])
                outcome['again'] = str(stages.fly(run, 'again', schedule).bag)
            outcome['after'] = list(observer.active_gains.items())
            outcome['update'] = run.status.get('update')
        except StageFailedError as failed:
            outcome['failed'] = str(failed)
    return outcome


if __name__ == '__main__':
    place = Path(sys.argv[1])
    found = flown(place, json.loads((place / 'wanted.json').read_text()))
    (place / 'outcome.json').write_text(json.dumps(found))
