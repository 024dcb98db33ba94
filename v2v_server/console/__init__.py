"""What the operator of a server sees.

status     the summary at the start, and a line every ten seconds
terminal   the same on a terminal, a few lines kept up to date
status_log the same as a line that programs read
shutdown_summary  the last lines of the log
progress   how far the catalogue is
state      the one model of the service, which terminal, page and metrics read
survey     makes it from the server's parts
history    totals of the last ten seconds, from which rates and shares follow
waiting    who waits for whom, in one sentence
watch      makes the state when somebody looks, and answers
asking     the other end: asks a server for its state
top        the state on a terminal, for whoever asked
"""
