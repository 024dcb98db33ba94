"""Services of the operating system, and of libraries that use them.

process         memory that stays, cores, long time slices, children that die with their parent
isolate         a function applied to many items in processes of their own, so that a crash costs one item
sandbox         restrictions of a process that decodes: programs, networks, writing
compile_cache   where numba stores compiled kernels
private         files that other users of the host cannot open
status_fields   what each number of the status means
locks           locks on files that processes share
start_times     how long each step of a start takes
log             log lines, as text or JSON
opencv          OpenCV, imported on first use
"""
