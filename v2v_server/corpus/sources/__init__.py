"""Where the videos of a corpus come from: one file for each kind of source, named in ``source.SOURCE_KINDS``.

source    what every source can do; sidecars, list files, and asking about many files at a time
folder    a folder, a video or a list file on this host
prepared  a folder that v2v-prepare made
copies    an address in object storage, and a folder of copies on this host
"""
