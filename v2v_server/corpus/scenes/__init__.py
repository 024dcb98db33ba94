"""What the videos of a corpus show, and what is wrong with it: measured once, by decoding the beginning of each.

scene       the statistics of one video, and the pieces of one and of all
analysis    measuring them in one pass
runs        the runs of a spec that the pieces of videos form, and the sequences of a run
stretches   from figures of every frame to pieces: repeats, still, black and white stretches, fades, combing, bars
picture_check  all of it, said for people, of a sample of the videos
"""
