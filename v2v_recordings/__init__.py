"""Read and write recordings of event cameras, form by form.

items.py         what readers yield: sensor size, chunks of events, pictures, flow
event_columns.py what the numbers of events mean, for all forms: polarities, coordinates, units, clocks
reading.py       the known forms; detects that of a recording, checks its size, puts its events on one clock
text_events.py   text files of events: IJRR and EVAID-R, with pictures in a zip or folder; or one text file
mvsec.py         MVSEC: HDF5
dsec.py          DSEC and v2v-simulate: HDF5, with frames in a folder
npy_columns.py   EVREAL's folders, and .npz
bag.py           ROS 1 bags
faery_reader.py  aedat4, Event Stream, by the package faery
prophesee.py     EVT 2, EVT 3, DAT
evt3.py          words of EVT 3 decoded and encoded
writers.py       a writer for each form, which takes events and pictures piece by piece
item_writer.py   what files written from items of any reader have in common: order, origin of time, size, notes
layout.py        the h5 layout of this project's recordings; layout_writer.py writes it from items
block_file.py    the form that is served: events in blocks, written from items
binning.py       events summed into the bins of a voxel grid
late_signals.py  Ctrl-C between two writes, not within one
limits.py        sizes and times that each form can hold
time_stamps.py   times of pictures in a text, whose unit may be open
archive.py       a zip file, a folder or a single file, through one interface
hdf5.py          open HDF5 files, refuse those that refer to other files; read columns of events, and pictures;
                 the layout that v2v-convert writes
"""
