"""The broker decides which worker makes which sample for which consumer. It handles no pixels. Only one file does I/O.

dispatcher        takes messages and lost peers, returns actions
actions           what the dispatcher wants done; the loop in ``serve.py`` does it
transport         the protocol of the two sockets, and its implementation (I/O)
session           what each consumer has asked for, and its credit; turns a Hello into a session
fair_queue        which waiting consumer is served next
leases            requests, which worker holds which of them, and what the loss of a worker says about them
grants            gives waiting requests to free workers: the content of a lease, and the checks on its result
worker_registry   which workers are connected, have free credit, or are silent
candidates        which sequence a request is made from, and when the next one is tried
counters          totals since the start
"""
