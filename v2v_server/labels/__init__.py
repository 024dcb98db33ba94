"""Labels of a video, read from the files beside it, and how a virtual camera sees them.

formats  the boxes of one video, and readers of COCO-VID, MOT and YOLO files; class masks
views    crop, resize and mirror boxes and masks like the pictures
"""
