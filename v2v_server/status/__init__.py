"""What the operator of a server sees.

line       the summary at the start, and a line every ten seconds
terminal   the same on a terminal, a few lines kept up to date
log        the same as a line that programs read
shutdown_summary  the last lines of the log
progress   how far the catalogue is
state      the one model of the service, which terminal, page and metrics read
snapshot   makes it from the server's parts
history    totals of the last ten seconds, from which rates and shares follow
bottleneck which part is the slow one, in one sentence
publisher  makes the state on request, and answers
client     requests a server's state
top        the state on a terminal
"""
