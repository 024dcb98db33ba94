"""Messages between processes over ZeroMQ. Only the files of this folder import zmq.

dealer   one connection to a server, which reconnects by itself (I/O)
router   one listening socket of a server, with its limits (I/O)
guard    which connections there are, and the end of one (I/O)
user     which user of this host a connection comes from (I/O)
curve    encryption and authentication with keys (I/O)
"""
