"""A flight campaign in lockstep that a test leads step by step."""

from collections.abc import Callable
from typing import Any


class Turns:
    """Simulated time of a crew: it stands still while a test acts, and passes while it waits.

    Between two looks little passes, so that nothing that lasts is over before the test sees it,
    however slow the test is beside the aircraft.
    """

    def __init__(self, crew: Any, probe: Any) -> None:
        self.crew, self.probe = crew, probe
        crew.clock.hold()

    def rest(self, seconds: float) -> None:
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
                self.rest(0.4)
            return found

        self.probe.until(met, what)

    def call(self, service: str, *kind: str, **request: Any) -> Any:
        """Call a service; time passes where it needs some for its answer."""
        return self.answer(self.probe.ask(service, *kind, **request))

    def answer(self, answer: Any) -> Any:
        self.until(answer.done, answer.words)
        return answer.result()
