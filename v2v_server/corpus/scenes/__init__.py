"""What the videos of a corpus show, and what is wrong with it: measured once, by decoding the beginning of each.

scene       the statistics of one video, and its pieces
analysis    measuring them in one pass
steps       repeated frames and their pattern
stretches   still, black and white stretches, fades, combing, bars
findings    all of it, said for people
pieces      the pieces of all videos
collect     the statistics of all videos of a corpus
"""
