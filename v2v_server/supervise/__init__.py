"""Start workers, and start those again that die.

pool         the workers of a server: slots, restarts and their delays, surplus workers, hung and stalled ones
scaling      how many workers there should be, from waiting consumers and idle workers
host         the seam between the pool and what runs the processes
local_host   runs them on this host
ray_host     runs them on a Ray cluster; only this one imports Ray
child        one worker's process: its start, also before there is work, its state, what its end means
"""
