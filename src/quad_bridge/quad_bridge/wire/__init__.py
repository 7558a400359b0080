"""The wire, without I/O: MAVLink dialect, bytes to frames and back, clock, parameter writes."""

from quad_bridge.wire.codec import Counts, Decoder, Encoder
from quad_bridge.wire.gain_names import CONTRACT_NAMES, WIRE_NAMES

__all__ = ['CONTRACT_NAMES', 'WIRE_NAMES', 'Counts', 'Decoder', 'Encoder']
