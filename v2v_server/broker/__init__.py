"""The broker decides which worker makes which sample for which consumer. It handles no pixels. Only three files do I/O.

dispatcher        takes messages and lost peers, returns actions
actions           what the dispatcher wants done; the loop in ``serve.py`` does it
transport         the protocol of the two sockets, and its ZeroMQ implementation (I/O)
door              limits on consumer connections, and which connections have ended (I/O)
admission         turns a consumer's Hello into a session
session           what each consumer has asked for, its credit, and the order of service
leases            requests, and which worker holds which of them
grants            gives waiting requests to free workers: the content of a lease, and the checks on its result
worker_registry   which workers are connected, have free credit, or are silent
candidates        which sequence a request is made from, and when the next one is tried
blame             what the loss of a worker says about the sample in work
quarantine        sequences that brought workers down, in numbered snapshots (a file)
counters          totals since the start
"""
