"""The server worker: takes a lease, makes its sample, sends it, takes the next.

conversation   what it says: a state machine without I/O
process        the process that does what the conversation says
produce        from a lease to its sample: decode, view, simulate
arrays         what fills each array; those that others add are files beside it
decode_cache   one decode for siblings
output_buffer  the sample in memory shared with its consumer, or in a message
scene_choice   how much flow a clip needs
warm_up        compiled kernels, once on a host
logbook        which lease it is at, where that outlives it
"""
