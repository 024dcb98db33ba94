"""Start workers, and start those again that die.

pool         the workers of a server: slots, restarts, surplus and hung workers, their number; the seam to the hosts
local_host   runs them on this host: a process's start, also before there is work, its state, what its end means
ray_host     runs them on a Ray cluster; only this one imports Ray
"""
