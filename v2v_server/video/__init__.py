"""One video file: from its bytes to luma.

source       opening it, for sequential reading, and what its container states beyond that
probe        what it holds, and which frames decode
packets      what a packet says without being decoded
frame_index  which frames it has, and where decoding may begin
decode       a range of frames, exactly: what is asked for, and the frames of each pass of a decoder
picture      what the samples of a decoded picture mean: luma, colour, orientation
picture_file one picture in a file: its head, its decoder, a check of what that delivers
levels       limited range to full range; red, green and blue from grey and colour: compiled
rows         which rows may be used
file_range   a part of a file that is a file itself
fingerprint  which file it is
"""
