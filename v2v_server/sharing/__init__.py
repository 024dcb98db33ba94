"""Finished samples, kept for consumers that ask for equal ones.

ring   the newest samples, up to a limit, in memory that consumers of this host can read and no process can write
"""
