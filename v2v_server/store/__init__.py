"""The lossless clip store: decoded luma on disk. A sample reads only the blocks of its crop.

format    layout of a store file
pixels    the pixels of a block and the differences that are stored for them
packing   compression of these differences
planes    named arrays beside the luma
chroma    the plane of colour
depth     levels of more than 8 bits
motion    the plane of motion: made, read, or computed from the pixels
writer    write a file, frame by frame
reader    read a crop of some frames
quota     a folder that many processes fill up to a limit: the cache, and copies of videos in object storage
cache     a folder of pieces that are stored when they are first decoded
clips     the pixels of a video, decoded or read from the store
"""
