"""Read recordings of event cameras, form by form.

items.py         what readers yield: sensor size, chunks of events, pictures, flow
forms.py         the known forms, and which of them a path has
ijrr.py          IJRR: text and PNGs in a zip or folder; or one text file
evaid.py         EVAID-R: text and pictures in a zip or folder
mvsec.py         MVSEC: HDF5
bag.py           ROS 1 bags
faery_reader.py  aedat4, EVT 2 and 3, DAT, by the package faery
text_events.py   text files of events
archive.py       a zip file or a folder, through one interface
hdf5.py          refuse HDF5 files that refer to other files
"""
