"""The schedule: a pure function from (catalogue, spec, seed, epoch, index) to a sequence of frames.

sequences     which sequences of which videos a spec may draw from, also of videos that scene "auto" divides
epoch         which sequence each index of an epoch is made from, and its candidates: a permutation that is computed
"""
