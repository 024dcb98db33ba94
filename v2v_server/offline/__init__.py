"""Samples without a server.

leases.py   the leases that a server would send
remake.py   any sample of any stream again: ``v2v-simulate``, tests, bug reports
preview.py  what a recipe makes of a video, as pictures
motion.py   whole pictures without noise, and seeds whose cameras see motion
doctor.py, doctor_corpus.py, doctor_pictures.py, doctor_motion.py
            what is in the way on this machine, and in a corpus
ahead.py    a corpus catalogued before a server needs it, on one host or many
event_files.py  events as HDF5, npz, EVT 3, AEDAT 4
"""
