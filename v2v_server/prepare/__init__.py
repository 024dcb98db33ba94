"""`v2v-prepare`: decode a corpus once, and store what training needs.

prepare    a run over a corpus
transcode  one video into its prepared form, verified
resume     what earlier runs left in a folder
report     the results of a run
"""
