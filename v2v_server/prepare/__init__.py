"""`v2v-prepare`: decode a corpus once, and store what training needs.

prepare    a run over a corpus, and what earlier runs left
transcode  one video into its prepared form, verified
"""
