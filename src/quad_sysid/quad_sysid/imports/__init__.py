"""Logs of other flight controllers → bags of the contract: PX4, ArduPilot, Betaflight."""

from quad_sysid.imports.kinds import Kind, kind_of, read_log
from quad_sysid.imports.log import ForeignLog, Mapped, Stream
from quad_sysid.imports.to_bag import Imported, import_log
from quad_sysid.imports.words import table

__all__ = [
    'ForeignLog', 'Imported', 'Kind', 'Mapped', 'Stream', 'import_log', 'kind_of', 'read_log',
    'table',
]
