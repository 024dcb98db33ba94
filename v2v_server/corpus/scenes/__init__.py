"""What the videos of a corpus show, and what is wrong with it: measured once, by decoding the beginning of each.

scene       the statistics of one video, and the pieces of one and of all
analysis    measuring them in one pass
stretches   from figures of every frame to pieces: repeats, still, black and white stretches, fades, combing, bars
findings    all of it, said for people
collect     the statistics of all videos of a corpus
picture_check  a look at the pictures of a sample of the videos
"""
