"""Recordings of event cameras in the form that is served.

blocks        the file: events in blocks, pictures and true flow, each found by its time
bins          arrays of a sample made of recorded events
convert       a raw recording of any form that v2v_recordings reads, written as such a file
"""
