"""The catalogue: which videos there are, under stable names, and what each of them holds.

catalogue        the snapshot that everything else works from: listed, indexed, opened
videos           its videos in columns
sources          where the videos come from
probe            probing many files in processes of their own
index            what probing found, on disk
figures          what the index holds beside that of all videos: statistics of their scenes, files beside them
scenes           what the videos show, and what is wrong with it
"""
