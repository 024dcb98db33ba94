"""What the videos of a corpus show: statistics that are measured once, by decoding the beginning of each.

scene     the statistics of one video
analysis  measuring them
runs      the frames between shot boundaries, of all videos
collect   the statistics of all videos of a corpus
"""
