"""From a job to its sample, in three steps. Server workers and tools take the same ones, so they make equal samples.

plan   draws the camera of a sample, and says what it needs of its clip: frames, windows, margins, compiled kernels
read   gets that from the source, the store or the cache, once for siblings; opens the files beside the video
make   turns it into arrays and provenance: view, flow, simulation, and the functions of ``arrays``
"""
