"""Who starts workers, and starts those again that die.

protocol     what the loop asks of a supervisor
local_pool   the processes of this host
"""
