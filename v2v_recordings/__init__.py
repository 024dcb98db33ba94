"""Read recordings of event cameras, form by form.

items.py         what readers yield: sensor size, chunks of events, pictures, flow
reading.py       detects the form of a recording, checks its size, puts its events on one clock
forms.py         the known forms, and which of them a path has
ijrr.py          IJRR: text and PNGs in a zip or folder; or one text file
evaid.py         EVAID-R: text and pictures in a zip or folder
mvsec.py         MVSEC: HDF5
dsec.py          DSEC and v2v-simulate: HDF5, with frames in a folder
layout_h5.py     the HDF5 that v2v-convert writes
npy_columns.py   EVREAL's folders, and .npz
bag.py           ROS 1 bags
faery_reader.py  aedat4, EVT 2 and 3, DAT, Event Stream, by the package faery
text_events.py   text files of events
archive.py       a zip file, a folder or a single file, through one interface
hdf5.py          open HDF5 files, refuse those that refer to other files; read columns of events, and pictures
"""
