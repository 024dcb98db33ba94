"""Who starts workers, and starts those again that die.

protocol     what the loop asks of a supervisor
child        one worker's process: its start, what it is at, what its end means
restarts     how long to wait after a death, and when there is no use in another start
scaling      how many workers there should be, by who waits and who is idle
local_pool   the processes of this host
ray_workers  those of a Ray cluster
ray_actor    what ray_workers has on each node; nothing but these two imports Ray
engines      which of the two a server has
"""
