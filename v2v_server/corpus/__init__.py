"""The catalogue: which videos there are, under stable names, and what each of them holds.

catalogue        the snapshot that everything else works from: listed, indexed, opened
videos           its videos in columns
sources          where the videos come from
sidecars         the fingerprints of files beside the videos
probe            probing many files in processes of their own
index            what probing found, on disk
ahead            a corpus catalogued before a server needs it, on one host or many
scenes           what the videos show, and what is wrong with it
manifest         what a prepared folder states about itself
"""
