"""What makes false events or empty grids of ordinary footage, found in its luma. Pure, in integer arithmetic.

defect    one finding
steps     duplicated frames and their pattern, still and black stretches
bars      letterbox and pillarbox bars
finder    all of them, from the frames of a video
"""
