"""The wire, without I/O: MAVLink dialect, bytes to frames and back, signing, axes."""

from quad_bridge.wire.codec import Decoder, Encoder
from quad_bridge.wire.framing import Counts

__all__ = ['Counts', 'Decoder', 'Encoder']
