"""Colour of a video.

chroma  the colour differences of decoded frames
rgb     red, green and blue from grey and colour differences
"""
