"""The status of a server: built once from its parts, and shown by every view.

snapshot    the fields, with their units and metrics; the bottleneck of the last ten seconds; building and answering
client      requests a server's status
terminal    shows the status as text: lines of the running server, the shutdown summary, tables for a terminal
"""
