"""Messages and data types that server, workers and consumers share.

Pure data: it uses the standard library, numpy and msgpack only. Nothing here opens a socket, a file or a clock.
"""

__version__ = "1.0.0"

PROTOCOL_VERSION = 8
"""Version of the messages on the wire. Peers of another version are refused with both numbers."""

NUMERICS_VERSION = 4
"""Version of everything that turns (spec, catalogue, seed, epoch, index) into bytes: permutation, draws,
kernel. It is part of a sample's identity; a change that alters any byte of any sample raises it."""
