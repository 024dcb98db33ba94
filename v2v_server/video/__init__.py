"""One video file: from its bytes to luma.

source       opening it, for sequential reading, and what its container states beyond that
probe        what it holds, and which frames decode
packets      what a packet says without being decoded
frame_index  which frames it has, and where decoding may begin
decode       a range of frames, exactly
collect      the asked frames of one pass of a decoder
colour       colour of the frames
luma         which grey is meant
full_range   limited range to full range, compiled
orientation  how a stored picture must be turned
rows         which rows may be used
fingerprint  which file it is
"""
