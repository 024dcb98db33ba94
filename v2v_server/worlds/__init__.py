"""Photographs that move, drawn, rendered and known exactly: numbers in, arrays out; no file, no frame rate.

world   a draw: the paths of the camera and of the patches in front of the photograph
render  the photograph from fine to coarse, the pictures at any times, and the truth: flow, masks, tracks
clip    the clip of a sample, with what it asks for
"""
