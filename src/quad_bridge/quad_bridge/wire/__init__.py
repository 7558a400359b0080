"""The wire, without I/O: MAVLink dialect, bytes to frames and back, clock, parameter writes."""

from quad_bridge.wire.codec import Counts, Decoder, Encoder

__all__ = ['Counts', 'Decoder', 'Encoder']
