"""Keep sequences that brought workers down, so that every stream can be made again.

snapshots   numbered snapshots, and whether one refuses a sequence; pure
file        the file of a corpus that several servers and a person write to
"""
