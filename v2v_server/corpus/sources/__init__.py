"""Where the videos of a corpus come from: one file for each kind of source, named in ``source.SOURCE_KINDS``.

source        what every source can do
archives      tar and zip files whose members are videos where they lie
folder        a folder, a video or a list file on this host
prepared      a folder that v2v-prepare made, and its manifest
copies        an address in object storage
object_parts  parts of objects, read as streams
copy_folder   copies of files that lie elsewhere, in a folder of this host
listing       list files, files that nothing asks for, and asking about many files at a time
sidecars      files and folders beside a video that arrays are made from
"""
