"""Planes: named arrays beside the luma of a store file, each optional, with an entry for every frame."""
