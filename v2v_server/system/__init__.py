"""Services of the operating system, and of libraries that use them.

process         memory that stays, cores, long time slices, children that die with their parent, locks, private files
isolate         a function applied to many items in processes of their own, so that a crash costs one item
sandbox         restrictions of a process that decodes: programs, networks, writing
compile_cache   where numba stores compiled kernels; OpenCV, imported on first use
log             what a service says: log lines, as text or JSON, and what each number of its status means
"""
