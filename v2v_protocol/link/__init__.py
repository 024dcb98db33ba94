"""Messages between processes over ZeroMQ. Only the files of this folder import zmq.

dealer   one connection to a server, which reconnects by itself (I/O)
router   one listening socket of a server, with its limits (I/O)
guard    end connections that cost a server too much memory or too many descriptors (I/O)
curve    encryption and authentication with keys (I/O)
"""
