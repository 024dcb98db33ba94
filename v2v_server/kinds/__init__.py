"""What a video of a corpus is: one file for each kind, named in ``registry.KIND_FILES``.

kind          what every kind has and what its callers ask; its own flags are its fields
registry      all kinds: which one owns an id, which one a user asks for, and the flags of all of them
videos        a file that is decoded
sequences     numbered pictures in a folder or an archive
photographs   a picture that the camera moves over
recordings    a recording of an event camera
"""
