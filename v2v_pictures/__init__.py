"""Pictures and films of event data, drawn one way everywhere: preview, demo, training, benchmarks.

    canvas.py    a page: text, panels, bars, arrows, hatching; the palette
    colours.py   event counts, grey pictures and flow as RGB, and one scale for all panels of a page
    camera.py    one simulated clip as its virtual camera saw it: activity over time, pauses, moments worth showing
    sheet.py     a page of cameras: activity over the clip, frame, bins, flow, labels, with headings and legend
    grids.py     voxel grids alone, as `simulate` returns them
    film.py      the same clips as a film
    files.py     PNG, GIF, MP4, and one HTML file that holds both

NumPy arrays in, RGB arrays out, [height, width, 3] uint8. Nothing here knows a server, a trainer or a socket.
"""
