"""The status page of a service, its metrics and its health, over HTTP, in a process of its own beside the server's.

child   the server's end: listens, starts and restarts the process, ends it
app     the process: which users it serves, the answer for each path, from the newest status, also as metrics
"""
