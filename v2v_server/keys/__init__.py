"""Who may talk to the server: whose key is good, where keys are asked for, and who comes too often.

folder   the keys that were given out: made, listed, revoked (files)
zap      answers ZeroMQ's question whether a key may come in, in a thread of its own (I/O)
callers  how many connections each address may open without saying anything (pure)
"""
