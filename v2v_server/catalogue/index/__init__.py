"""The index: what probing each file has found, on disk and in memory.

file     the SQLite file
columns  very many records side by side
copy     these columns in a file, which is read in a moment
parts    an index made on many hosts
"""
