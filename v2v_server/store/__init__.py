"""The lossless clip store: decoded luma on disk. A sample reads only the blocks of its crop.

format       layout of a store file, and the compression of its blocks
differences  the pixels of a block and the differences that are stored for them
planes       named arrays beside the luma, each in a file: motion, detail, chroma
store_file   store files: opened, read as clips, and written frame by frame
pixels       what frames are read from: the protocol, and its kinds
video_file   a video, decoded
picture_sequence  a folder or archive of numbered pictures, decoded
verified     a decoded video whose file other programs may change in place
photograph   a photograph, whose frames are rendered for each sample
event_file   the file of a prepared recording, read
event_blocks  the events of a block of it, unpacked
recording    a prepared recording of an event camera, whose frames are marks
quota        a folder that many processes fill up to a limit: the cache, and copies of videos in object storage
cache        a folder of pieces that are stored when they are first decoded
"""
