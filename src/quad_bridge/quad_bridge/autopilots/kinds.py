"""What differs between PX4 and ArduPilot, a row each: another autopilot is one more row. Pure.

Modes, how one is asked for, which gains there are, how integers are encoded, how thrust is meant,
what must come over the line, and what a ready aircraft has set.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from quad_bridge.autopilots.system_id import LEFT_ON
from quad_bridge.autopilots.table import (
    ARDUPILOT,
    OF_MOTORS,
    PX4,
    Table,
    Units,
    ardupilot_units,
    px4_units,
)
from quad_bridge.autopilots.takeover import Means
from quad_bridge.craft import Craft
from quad_bridge.wire import frames as f

DO_SET_MODE = 176
STOPS_THE_MOTORS = (6, 7)  # values of COM_OBL_RC_ACT: terminate, disarm
GUID_THROTTLE = 3  # bit of GUID_OPTIONS: a thrust is a throttle
CUSTOM_MODE = 1.0  # MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
OF_FLIGHT_HZ = {'ATTITUDE_TARGET': 50.0, 'LOCAL_POSITION_NED': 20.0, 'EXTENDED_SYS_STATE': 5.0}
"""Messages that say how it flies, beside those of the topics."""
Values = Mapping[str, float]
Advice = tuple[str, bool, str]
"""What was found, whether it is as it should be, and what to change."""


@dataclass(frozen=True)
class Kind:
    """One autopilot."""

    number: int
    """MAV_AUTOPILOT of its heartbeat."""
    name: str
    table: Table
    bytewise: bool
    """Whether an integer's bytes lie in the float of PARAM_SET and PARAM_VALUE."""
    pilot_modes: Mapping[int, str]
    """Modes in which the pilot flies, by custom_mode."""
    means: Means
    units: Callable[[Craft, Values], Units]
    requested_hz: Mapping[str, float]
    """Messages beside those of the topics."""
    reads: tuple[str, ...]
    """Parameters beside the gains."""
    advice: Callable[[Values, tuple[int, int]], list[Advice]]
    log_suffix: str
    fetches_armed: bool
    """Whether it sends logs while it is armed; they are requested after landing all the same."""
    log_closes_s: float
    """Time after landing until it no longer writes to the log. An earlier request cuts the log
    short, and ArduPilot then begins another one."""
    logs_by_time: bool = False
    """Whether its list of logs is in no order: PX4 lists a directory as it finds it."""
    modes: Mapping[int, str] = field(default_factory=dict)
    system_id: bool = False

    def mode_name(self, mode: int | None) -> str:
        """A mode in words."""
        if mode is None:
            return 'unknown'
        return {**self.modes, **self.pilot_modes, self.means.mode: self.means.name}.get(
            mode, f'mode {mode}'
        )


def _px4_mode(mode: int) -> f.Command:
    main, sub = mode >> 16 & 0xFF, mode >> 24 & 0xFF
    return f.Command(DO_SET_MODE, (CUSTOM_MODE, float(main), float(sub)))


def _ardupilot_mode(mode: int) -> f.Command:
    return f.Command(DO_SET_MODE, (CUSTOM_MODE, float(mode)))


def _px4_units(craft: Craft, known: Values) -> Units:
    del known
    x, y = ([getattr(m, axis) for m in craft.motors] for axis in 'xy')
    return px4_units(np.asarray(craft.mixer), x, y)


def _seen(
    known: Values, words: str, name: str, is_right: Callable[[float], bool], remedy: str,
    unit: str = '',
) -> Advice:  # fmt: skip
    """What a parameter is; one that is not answered is not as it should be."""
    if name not in known:
        return (f'{words}{name} is not answered', False,
                'listen for longer by --seconds, or look at it with a ground station')
    return f'{words}{name} {known[name]:.9g}{unit}', is_right(known[name]), remedy


def _px4_advice(known: Values, version: tuple[int, int]) -> list[Advice]:
    advice = [
        _seen(known, 'log ', 'SDLOG_PROFILE', lambda bits: int(bits) & 24 == 24,
              'set SDLOG_PROFILE to 25 (bits 3 system identification, 4 high rate) and restart'),
        _seen(known, 'airmode ', 'MC_AIRMODE', lambda mode: not mode,
              'set MC_AIRMODE to 0 while tuning'),
        _seen(known, 'external set-points ', 'MAV_FWDEXTSP', bool, 'set MAV_FWDEXTSP to 1'),
        _seen(known, 'sticks leave OFFBOARD: ', 'COM_RC_OVERRIDE', lambda bits: int(bits) & 2 > 0,
              'set COM_RC_OVERRIDE to 3: else the bridge alone gives the mode back'),
        _seen(known, 'loss of OFFBOARD ', 'COM_OF_LOSS_T', lambda seconds: seconds <= 1,
              'set COM_OF_LOSS_T to 1 or less', ' s'),
        _seen(known, 'and then ', 'COM_OBL_RC_ACT', lambda then: then not in STOPS_THE_MOTORS,
              'set COM_OBL_RC_ACT to 0, Position: this value stops the motors in flight'),
    ]
    if version >= (1, 15):
        advice.append(("parameters in the processor's flash are stored once disarmed", True, ''))
    return advice


def _ardupilot_advice(known: Values, version: tuple[int, int]) -> list[Advice]:
    del version
    bits, has_sid = int(known.get('LOG_BITMASK', 0)), 'SID_AXIS' in known
    blocked = int(known.get('FLTMODE_GCSBLOCK', 0))  # which older ones have not, and block nothing
    return [
        _seen(known, 'log ', 'LOG_BITMASK', lambda bits: int(bits) & 3 == 3,
              f'set LOG_BITMASK to {bits | 3} (bits 0, 1 fast and medium attitude)'),
        (f'motors in the log (bit 17) {"yes" if bits & 1 << 17 else "no"}', True, ''),
        (f'SYSTEM ID {"is there" if has_sid else "is not answered"}', has_sid,
         'boards of 1 MB flash lack it from 4.5 on, and GUIDED_NOGPS too'),
        *([_seen(known, '', 'SID_AXIS', lambda axis: not axis, LEFT_ON)] if has_sid else []),
        (f'FLTMODE_GCSBLOCK {blocked}', not blocked & 1 << 20,
         'clear bit 20: DO_SET_MODE may not enter SYSTEM ID'),
        _seen(known, '', 'GUID_OPTIONS', lambda bits: not int(bits) & 1 << GUID_THROTTLE,
              f'clear bit {GUID_THROTTLE}: with it no climb in GUIDED_NOGPS is half throttle'),
        _seen(known, 'a silent bridge is noticed after ', 'GUID_TIMEOUT',
              lambda seconds: seconds <= 3,
              'set GUID_TIMEOUT to 3 or less: the last attitude is held for so long', ' s'),
        _seen(known, '', 'MOT_HOVER_LEARN', lambda learns: not learns,
              'set it to 0 after a minute of hover: the unit of the gains follows what it learns'),
    ]


KINDS = (
    Kind(
        PX4.number, 'PX4', PX4, bytewise=True,
        pilot_modes={7 << 16: 'Stabilized', 2 << 16: 'Altitude', 3 << 16: 'Position'},
        means=Means(6 << 16, 'OFFBOARD', _px4_mode),
        units=_px4_units,
        requested_hz=OF_FLIGHT_HZ,
        reads=('SDLOG_PROFILE', 'MC_AIRMODE', 'MAV_FWDEXTSP', 'COM_RC_OVERRIDE', 'COM_OF_LOSS_T',
               'COM_OBL_RC_ACT', 'IMU_GYRO_RATEMAX', 'IMU_INTEG_RATE'),
        advice=_px4_advice, log_suffix='.ulg', fetches_armed=True, log_closes_s=2.0,
        logs_by_time=True, modes={1 << 16: 'Manual', 5 << 16: 'Acro'},
    ),
    Kind(
        ARDUPILOT.number, 'ArduPilot', ARDUPILOT, bytewise=False,
        pilot_modes={0: 'Stabilize', 1: 'Acro', 2: 'AltHold', 5: 'Loiter', 16: 'PosHold'},
        means=Means(20, 'GUIDED_NOGPS', _ardupilot_mode, climb=True,
                    throttle_bit=('GUID_OPTIONS', GUID_THROTTLE)),
        units=lambda craft, known: ardupilot_units(np.asarray(craft.mixer), known),
        requested_hz=OF_FLIGHT_HZ,
        reads=(*OF_MOTORS, 'MOT_HOVER_LEARN', 'LOG_BITMASK', 'FLTMODE_GCSBLOCK', 'SCHED_LOOP_RATE',
               'SID_AXIS', 'GUID_OPTIONS', 'GUID_TIMEOUT'),
        advice=_ardupilot_advice, log_suffix='.bin', fetches_armed=False, log_closes_s=16.0,
        modes={25: 'SYSTEM ID', 9: 'Land', 6: 'RTL'}, system_id=True,
    ),
)
BY_NUMBER: Mapping[int, Kind] = {kind.number: kind for kind in KINDS}
