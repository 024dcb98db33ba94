"""`v2v-prepare`: a corpus decoded once, and kept as what training needs.

prepare    a run over a corpus
transcode  one video into its prepared form, verified
encode     writing luma as H.264, for small disks
resume     what earlier runs left in a folder
report     what a run has done
"""
