"""Pictures between two frames of a video, along the motion: arrays in, arrays out.

A pixel model that sees two frames takes its light to change evenly in between. Where an edge moves by more than a pixel
that is wrong: the pixels on its way brighten and darken again. So a step in which things move is divided into sub-steps
(``substep_px`` of the spec), and the levels between them are made of both frames, moved along.

    pyramid.py   a picture from fine to coarse
    matching.py  block motion between two pictures
    plane.py     the motion along a video
    warping.py   the pictures between
    lanes.py     vector code for both
    measure.py   what moves in a clip, and whether blocks follow it
    clip.py      the levels of a clip: which steps are divided, into how many parts

All of it but what is measured is integer arithmetic, so that every host makes the same bytes.
"""

from v2v_server.motion.clip import cells_of, levels_between, levels_of, load, substeps
from v2v_server.motion.matching import Vectors, motion
from v2v_server.motion.plane import MotionOfCuts, motions
from v2v_server.motion.pyramid import Cells, Pyramid

__all__ = [
    "Cells",
    "MotionOfCuts",
    "Pyramid",
    "Vectors",
    "cells_of",
    "levels_between",
    "levels_of",
    "load",
    "motion",
    "motions",
    "substeps",
]
