"""The broker decides which worker makes which sample for which consumer. It handles no pixels and does no I/O.

state        what the broker knows, as one value; what it wants done, which the loop in ``serve.py`` does
dispatcher   messages and lost peers to actions: sessions opened, candidates refused, leases given, results checked
session      what each consumer has asked for, its credit, and which waiting consumer is served next
leases       requests, the workers, which of them holds which request, and what the loss of a worker says about it
"""
