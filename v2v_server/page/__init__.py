"""The status page of a service, its metrics and its health, over HTTP, in a process of its own beside the server's.

child      the server's end: listens, starts and restarts the process, ends it
__main__   the process, and whom it serves: python -m v2v_server.page
app        the answer for each path
guard      which requests are answered, and what a browser may do with the answer
source     the newest status, requested on demand
metrics    the status as Prometheus metrics
"""
