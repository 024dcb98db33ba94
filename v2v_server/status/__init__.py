"""The status of a server: built once from its parts, and shown by every view.

parts       the fields, with their units and metrics; where each is in JSON
snapshot    builds a status from the server's parts on request, and answers
bottleneck  which part was the slow one in the last ten seconds, in one sentence
client      requests a server's status
terminal    shows the status as text: lines of the running server, the shutdown summary, tables for a terminal
"""
