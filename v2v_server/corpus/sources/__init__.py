"""Where the videos of a corpus come from: one file for each kind of source, named in ``source.SOURCE_KINDS``.

source    what every source can do, and asking it about many files at a time
folder    a folder, a video or a list file on this host
prepared  a folder that v2v-prepare made
copies    object storage, by way of a folder of copies on this host
bucket    an address in object storage
listfile  list files like the paper's; which names are videos', and how a name is shown
sidecar   files and folders beside videos, such as labels
"""
