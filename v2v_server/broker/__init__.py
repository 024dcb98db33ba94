"""The broker: who gets which sample from which worker. It knows no pixels, and all but three files do no I/O.

dispatcher        the mind: messages and deaths in, actions out
actions           what it wants done; the loop in ``serve.py`` does it
transport         the way in and out: its protocol, and the two ZeroMQ sockets (I/O)
door             which consumers are cut off, and which have gone (I/O)
admission         from a consumer's Hello to its session
session           what each consumer has asked for, its credit, whose turn it is
leases            requests, and which worker has which of them
terms             what a lease says, and what its answer must be
worker_registry   who is there, has room, is silent
candidates        which sequence a request is made from; what moves it to the next
blame             what the death of a worker says about the sample it was at
quarantine        what workers died of, in numbered snapshots (a file)
counters          what happened so far, in numbers
"""
