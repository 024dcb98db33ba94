"""The catalogue: which videos there are, under stable names, and what each of them holds.

catalogue        the snapshot that everything else works from: listed, indexed, opened
videos           its videos in columns
sources          where the videos come from
members          the members of archives, which the index knows
probe            reading many files in processes of their own: videos, their scenes, their sidecars
index            what probing found, on disk
scenes           what the videos show, and what is wrong with it
"""
