"""The one error of the demo: a stage that could not do its part. No handling here."""

from __future__ import annotations


class StageFailedError(Exception):
    """A stage of the demo ended without its result; `str()` is the one line for the user."""

    def __init__(self, stage: str, reason: str) -> None:
        super().__init__(f'{stage}: {" ".join(reason.split())}')
        self.stage = stage
        self.reason = reason
