"""Messages between processes over ZeroMQ. Only the files of this folder import zmq.

dealer   one connection to a server, which reconnects by itself (I/O)
router   the two listening sockets of a server: who may connect, which connections there are, their limits (I/O)
user     which user of this host a connection comes from (I/O)
"""
