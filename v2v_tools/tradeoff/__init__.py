"""`v2v-tradeoff`: speed against disk space, accuracy and diversity, measured on a user's own clips.

command    the command line
settings   the ways to serve a corpus that are compared, and the corpus in each of its forms
measures   errors of forms, resemblance of the samples of one decode, processor time
rendered   errors at the true rate: frames of the clips that move as the clips do
report     settings that no other setting dominates, the best one for a wish, and the tables
"""
