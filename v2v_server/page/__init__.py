"""The status page of a service, its metrics and its health, over HTTP, in a process of its own beside the server's.

child      the server's end: listens, starts and restarts the process, ends it
__main__   the process, and which users it serves: python -m v2v_server.page
app        the answer for each path: which requests are answered, from the newest status, also as metrics
"""
