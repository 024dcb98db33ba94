"""The status of a server: built once from its parts, and shown by every view.

parts       the fields, with their units and metrics; where each is in JSON
snapshot    builds a status from the server's parts
history     totals of the last ten seconds, from which rates and shares follow
bottleneck  which part is the slow one, in one sentence
publisher   builds a status on request, and answers
client      requests a server's status
text        a line of figures, and the shutdown summary
terminal    shows the status of the running server on standard error
top         tables for a terminal
"""
