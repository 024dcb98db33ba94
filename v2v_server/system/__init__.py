"""Services of the operating system, and of libraries that use them.

process         memory that stays, cores, long time slices, children that die with their parent, locks, private files
isolate         a function applied to many items in processes of their own, so that a crash costs one item
sandbox         restrictions of a process that decodes: programs, networks, writing
compile_cache   where numba stores compiled kernels; OpenCV, imported on first use
status_fields   what each number of the status means
log             log lines, as text or JSON, and how long each step of a start takes
"""
