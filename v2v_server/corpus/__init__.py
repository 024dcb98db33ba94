"""The catalogue: which videos there are, under stable names, and what each of them holds.

catalogue        the snapshot that everything else works from
videos           its videos in columns
sources          where the videos come from
corpus           the files of a corpus, before one of them is opened
sidecars         the fingerprints of files beside the videos
probe            probing many files in processes of their own
index            what probing found, on disk and in memory
refresh          bring the index up to date
scenes           what the videos show, and what is wrong with it
manifest         what a prepared folder states about itself
"""
