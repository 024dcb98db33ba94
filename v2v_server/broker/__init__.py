"""Decide which worker makes which sample for which consumer, without I/O. Each file imports only those above it.

leases       requests, the workers, which of them holds which request, and what the loss of a worker says about it
session      what each consumer has asked for, its credit, and which waiting consumer is served next
state        what the broker knows, as one value; what it wants done, which the loop in ``serve.py`` does
candidates   a video that cannot be used: the request's next candidate, or an error for its consumer
shared       equal samples made once: requests that follow one in work, and samples that are finished
assignment   waiting requests to workers: which worker suits, and the leases that it gets
admission    what a consumer's Hello asks for, and its credit
consumers    what consumers say: sessions opened and forgotten, requests, faults
workers      what workers say: results checked, failures, and the leases of a worker that is gone
dispatcher   messages, lost peers, results of actions, and time: to actions
"""
