"""What the operator of a server sees.

status     the summary at the start, and one live line
progress   how far the catalogue is
"""
