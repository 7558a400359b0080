"""Excitation: test signals, their design from a band, schedules of a flight, and its guard."""

from quad_sysid.signals.design import Design, design_excitation
from quad_sysid.signals.schedule import Part, Schedule, parse_schedule
from quad_sysid.signals.waveforms import SIGNALS, Waveform, prbs, prbs_bits, waveform

__all__ = ['SIGNALS', 'Design', 'Part', 'Schedule', 'Waveform', 'design_excitation',
           'parse_schedule', 'prbs', 'prbs_bits', 'waveform']
