"""`v2v-doctor`: what is in the way, and what to change.

command         the command line; the installation and the machine
corpus          the videos and their labels
motion          what moves between its frames
"""
