"""The page to watch a service by, its metrics and its health, over HTTP, in a process of its own beside the server's.

child      the server's end: listens, starts the process, starts it again, ends it
__main__   the process: python -m v2v_server.page
app        what is answered to which path
guard      who may ask, and what a browser may do with the answer
silent     closes connections that send no request
source     the newest state, asked for when somebody wants it
metrics    the state as Prometheus wants it
"""
