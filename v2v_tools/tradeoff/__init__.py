"""`v2v-tradeoff`: speed against disk space, accuracy and diversity, measured on a user's own clips.

command    the command line
forms      the corpus as it is and prepared in several ways
settings   the ways to serve a corpus that are compared
speed      processor time of a sample, all settings in turns
errors     error measures between two voxel arrays
accuracy   errors of each form against exactly decoded frames
diversity  how alike the samples of one decode are
front      settings that no other setting dominates, and the best one for a wish
report     records, tables and the plot
"""
