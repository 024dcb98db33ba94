"""The index: what probing each file has found, on disk and in memory.

file     the SQLite file, and its parts made on many hosts
columns  its table of videos in memory, one array for each column
"""
