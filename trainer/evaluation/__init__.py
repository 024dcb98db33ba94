"""How well a network reconstructs real recordings: readers, voxel grids, metrics, tables, pictures."""
