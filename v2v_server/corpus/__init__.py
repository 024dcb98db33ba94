"""The catalogue: which videos there are, under stable names, and what each of them holds.

catalogue        the snapshot that everything else works from
videos           its videos, in columns
corpus           the files of a corpus, before one of them is opened
survey           probing many files in processes of their own
index            what probing found, on disk and in memory
refresh          bringing that up to date
changed          which files are new or changed since
scene            what a video shows, in a few numbers
look             the look that finds these numbers
scenes           the numbers of a whole corpus
manifest         what a prepared folder says of itself
manifest_writer  writing that
sources          where the videos come from
"""
