"""The lossless clip store: decoded luma on disk, of which a sample reads only the blocks of its crop.

format    what a file of the store looks like
pixels    the pixels of a block and the differences that are stored for them
packing   compressing these
writer    writing a file, frame by frame
reader    reading a crop of some frames
encoding  how a prepared corpus holds its pictures
used      how many bytes a folder holds that many processes fill
cache     a folder of pieces that fills itself
clips     the pixels of a video, wherever they are
"""
