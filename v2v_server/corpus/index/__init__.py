"""The index: what probing each file has found, on disk and in memory.

file     the SQLite file
columns  its table of videos in memory, one array for each column
parts    an index made on many hosts
"""
