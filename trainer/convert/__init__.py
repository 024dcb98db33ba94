"""Convert raw recordings of event cameras to the h5 layout that evaluation reads (:mod:`v2v_recordings.layout`)."""

from trainer.convert.conversion import Converted, convert
from v2v_recordings.items import EventChunk, Item, Picture, SensorSize

__all__ = ["Converted", "EventChunk", "Item", "Picture", "SensorSize", "convert"]
