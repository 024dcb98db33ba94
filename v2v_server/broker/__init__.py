"""The broker decides which worker makes which sample for which consumer. It handles no pixels. Only one file does I/O.

state             what the broker knows, as one value: facts, sessions, leases, workers, counters, ring
dispatcher        takes messages and lost peers, returns actions; turns a Hello into a session
grants            what a request is made from, the worker that gets it: the content of a lease, the checks on its result
session           what each consumer has asked for, its credit, and which waiting consumer is served next
leases            requests, which worker holds which of them, and what the loss of a worker says about them
worker_registry   which workers are connected, have free credit, or are silent
actions           what the dispatcher wants done; the loop in ``serve.py`` does it
transport         the protocol of the two sockets, and its implementation (I/O)
"""
