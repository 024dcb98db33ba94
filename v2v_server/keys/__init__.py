"""The keys that a server accepts.

folder   the keys that were given out: created, listed, revoked (files)
"""
