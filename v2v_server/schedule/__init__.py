"""The schedule: a pure function from (catalogue, spec, seed, epoch, index) to a sequence of frames.

sequences     which sequences of which videos a spec may draw from
runs          those of videos that scene "auto" divides
permutation   a keyed permutation that is computed, never stored
epoch         which sequence each index of an epoch is made from, and its candidates
summary       what a corpus gives under a spec, for the operator
"""
