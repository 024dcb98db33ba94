"""Who may talk to the server, where keys are asked for.

folder   the keys that were given out: made, listed, revoked (files)
zap      answers ZeroMQ's question whether a key may come in, in a thread of its own (I/O)
"""
