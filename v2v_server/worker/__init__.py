"""The server worker takes a lease, makes its sample, sends it, and takes the next.

conversation   what the worker says: a state machine without I/O
process        the process that does what the conversation says, with one decode for siblings, into its output buffer
job            what is to be made, read from a lease
making         from a job to its sample: plan, read, make
arrays         functions that fill each array; additional arrays are files beside it
scene_choice   which frames and which part of the picture are used, and which flow method a clip needs
warm_up        compiled kernels, compiled once on a host
logbook        a record of the lease in work that outlives the worker
"""
