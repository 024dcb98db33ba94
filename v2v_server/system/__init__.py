"""What we ask of the operating system, and of libraries that ask it for us.

process         memory that stays, cores, long turns, children that die with their parent
isolate         a function applied to many items in processes of their own, where a crash costs one item
sandbox         what a process that decodes gives up: programs, networks, writing
compile_cache   where numba keeps compiled kernels
private         files that other users of the host cannot open
turn_away       has the kernel drop newcomers from some addresses
log             lines for whoever runs a service, as text or JSON
clock           a clock that stands still while its process does
opencv          OpenCV, loaded when it is first used
"""
