"""Evaluate networks on real recordings: readers, voxel grids, metrics, tables, pictures."""
