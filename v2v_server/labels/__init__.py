"""Labels of a video, read from the files beside it, and how a virtual camera sees them.

boxes    the boxes of one video, whatever file they come from
formats  readers of COCO-VID, MOT and YOLO files
masks    class masks, a PNG file for each frame
views    crop, resize and mirror boxes and masks like the pictures
"""
