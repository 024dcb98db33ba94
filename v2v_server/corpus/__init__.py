"""The catalogue: which videos there are, under stable names, and what each of them holds.

catalogue        the snapshot that everything else works from
videos           its videos, in columns
corpus           where a corpus lies, and which files it has
files            looking for them, and asking about many at a time
listfile         list files like the paper's
survey           probing many files in processes of their own
index            what probing found, on disk and in memory
refresh          bringing that up to date
changed          which files are new or changed since
scene            what a video shows, in a few numbers
look             the look that finds these numbers
scenes           the numbers of a whole corpus
manifest         what a prepared folder says of itself
manifest_writer  writing that
"""
