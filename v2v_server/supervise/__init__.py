"""Start workers, and start those again that die.

pool         the workers of a server: slots, restarts and their delays, surplus workers, their number, hung workers
host         the seam between the pool and what runs the processes
local_host   runs them on this host: a process's start, also before there is work, its state, what its end means
ray_host     runs them on a Ray cluster; only this one imports Ray
"""
