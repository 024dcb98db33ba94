"""The index: what probing each file has found, on disk and in memory.

file     the SQLite file
columns  very many records side by side
runs     the stretches between cuts, of the videos that have some, in columns too
copy     these columns in a file, which is read in a moment
parts    an index made on many hosts
"""
