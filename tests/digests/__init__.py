"""Digests of samples: what every recipe and spec makes, from a video, a store, a cache and a server.

clips    the videos, in whole numbers
rows     the streams, and how their samples are made
make     write the table, and say what changed
"""
