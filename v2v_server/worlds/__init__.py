"""Photographs that move, drawn, rendered and known exactly: numbers in, arrays out; no file, no frame rate.

world   a draw: the paths of the camera and of the patches in front of the photograph
render  the photograph from fine to coarse, and the world's pictures at any times
truth   where each point goes, and what hides it: flow, masks, tracks
"""
